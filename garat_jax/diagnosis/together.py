"""Which two candidates explain most together: by itself neither of them may come near the first.

Where two effects are missing, a third may do some of what both do, as a spring does for a displaced
scale of an encoder and a motor's dead band, and explain more than either. Screening has what every
candidate changes, and so what any two leave of the residual, before one of them is fitted.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from garat_jax.diagnosis.contend import LIKELY, Contender, best_of, fit_one, refines
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.robust import orthonormal
from garat_jax.diagnosis.screen import EQUIVALENT, Score, cosine
from garat_jax.diagnosis.starts import Fit
from garat_jax.effects import are_exclusive

FAR_LESS = 0.5
"""What two are expected to leave of the residual, relative to what the best candidate left when it
was fitted, below which the stronger is followed for the other."""
SAME = 1e-6
"""Square of the part of a direction that another candidate lacks, below which there is none."""


class Pair(NamedTuple):
    """Two candidates and the share of the residual's squares that they would explain together."""

    stronger: Score
    weaker: Score
    share: float


def best_pair(problem: Problem, scores: Sequence[Score]) -> Pair | None:
    """Return the two candidates that are expected to explain most together.

    Args:
        problem: The recordings and the model with every candidate.
        scores: What screening says, of one round.
    """
    likely = [score for score in scores if score.possible and score.share > LIKELY]
    likely.sort(key=lambda score: -score.share)
    if len(likely) < 2:
        return None
    bases = [orthonormal(score.changes) for score in likely]
    ends = np.cumsum([basis.shape[1] for basis in bases])
    own = np.split(np.arange(ends[-1]), ends[:-1])
    every = np.concatenate(bases, axis=1)
    common = every.T @ every
    along = np.stack([every.T @ score.contribution for score in likely])
    pairs = [
        Pair(likely[i], likely[j], _share(likely[i], along[i], along[j], own[i], own[j], common))
        for i, j in itertools.combinations(range(len(likely)), 2)
        if _are_two(problem, likely[i], likely[j])
    ]
    return max(pairs, key=lambda pair: pair.share, default=None)


def _share(
    one: Score, along: np.ndarray, other: np.ndarray, own: np.ndarray, others: np.ndarray, common
) -> float:
    """Return the share that a candidate and another explain together.

    Args:
        one: The candidate.
        along: How much of every direction it explains, [n].
        other: How much of them the other explains, [n].
        own: Which directions are its own, orthonormal, [k].
        others: Which are the other's, [l].
        common: Of every two directions, how much they are the same, [n, n].
    """
    between = common[np.ix_(own, others)]
    rest = other[others] - along[others]
    square, ways = np.linalg.eigh(np.eye(len(others)) - between.T @ between)
    more = np.sum((ways.T @ rest) ** 2 * (square > SAME) / np.maximum(square, SAME))
    return one.share * (1.0 + float(more) / float(along[own] @ along[own]))


def _are_two(problem: Problem, one: Score, other: Score) -> bool:
    """Say whether both may be missing, and are not two names or laws of the same."""
    laws = [problem.simulator.effects[score.effect] for score in (one, other)]
    owners = one.effect, other.effect
    are_related = refines(problem, *owners) or refines(problem, *owners[::-1])
    return not are_related and not are_exclusive(*laws) and cosine(one, other) <= EQUIVALENT


def with_paired(
    problem: Problem, current: Fit, scores: Sequence[Score], contenders: Sequence[Contender], say
) -> list[Contender]:
    """Mark the stronger of the best pair as paired, fitted if it is not yet.

    If both together are not expected to leave far less than the best contender does, there is none.

    Args:
        problem: The recordings and the model with every candidate.
        current: The fit of the effects selected so far.
        scores: What screening says.
        contenders: Those that were fitted.
        say: Told what is being done.
    """
    best, pair = best_of(contenders), best_pair(problem, scores)
    if best is None or pair is None:
        return [*contenders]
    left = best.fit.cost[problem.fitted].sum() / current.cost[problem.fitted].sum()
    if 1.0 - pair.share > FAR_LESS * left:
        return [*contenders]
    stronger, found = pair.stronger.effect, [*contenders]
    if all(c.score.effect != stronger for c in found):
        found.append(fit_one(problem, current, pair.stronger, np.inf, say))
    return [dataclasses.replace(c, is_paired=c.score.effect == stronger) for c in found]
