"""Which two candidates explain most together: by itself neither of them may come near the first.

Where two effects are missing, a third may do some of what both do, as a spring does for a displaced
scale of an encoder and a motor's dead band, and explain more than either. Screening has what every
candidate changes, and so what any two leave of the residual, before one of them is fitted.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from garat_jax.diagnosis.contend import LIKELY, Contender, best_of, refines
from garat_jax.diagnosis.names import twins
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.robust import orthonormal
from garat_jax.diagnosis.screen import EQUIVALENT, Score, cosine, simpler_law
from garat_jax.diagnosis.starts import Fit
from garat_jax.effects import are_exclusive

FAR_LESS = 0.5
"""What two are expected to leave of the residual, relative to what the best candidate left when it
was fitted, below which the stronger is followed for the other. Half is a guess: of the pair of
hidden effects for which this was made it was a hundredth."""
DISTINCT = 1e-6
"""Square of the part of a direction that another candidate lacks, below which there is none."""


class Pair(NamedTuple):
    """Two candidates and the share of the residual's squares that they would explain together."""

    stronger: Score
    weaker: Score
    share: float


def far_better_pair(
    problem: Problem, current: Fit, scores: Sequence[Score], contenders: Sequence[Contender]
) -> Pair | None:
    """Return the best pair if it is expected to leave far less than the best contender does.

    Args:
        problem: The recordings and the model with every candidate.
        current: The fit of the effects selected so far.
        scores: What screening says.
        contenders: Those that were fitted.
    """
    best = best_of(contenders)
    pair = best_pair(problem, scores) if best else None
    if best is None or pair is None:
        return None
    left = best.fit.cost[problem.fitted].sum() / current.cost[problem.fitted].sum()
    return pair if 1.0 - pair.share < FAR_LESS * left else None


def best_pair(problem: Problem, scores: Sequence[Score]) -> Pair | None:
    """Return the two candidates that are expected to explain most together.

    Of the names of one law, and of a law and one that refines it and explains hardly more, the
    first counts. A pair in which either would do the opposite of what it does alone is none: what
    is left of two that are much alike explains anything.

    Args:
        problem: The recordings and the model with every candidate.
        scores: What screening says of one round, best first.
    """
    likely = [score for score in scores if score.possible and score.share > LIKELY]
    likely = [score for score in likely if not simpler_law(problem, score, likely)]
    likely = [score for i, score in enumerate(likely) if not twins(score, likely[:i])]
    if len(likely) < 2:
        return None
    bases = [orthonormal(score.changes) for score in likely]
    ends = np.cumsum([basis.shape[1] for basis in bases])
    own = np.split(np.arange(ends[-1]), ends[:-1])
    every = np.concatenate(bases, axis=1)
    common = every.T @ every
    alone = [basis.T @ score.contribution for basis, score in zip(bases, likely, strict=True)]
    pairs = [
        Pair(*_by_share(likely[i], likely[j]), likely[i].share * more)
        for i, j in itertools.combinations(range(len(likely)), 2)
        if _are_two(problem, likely[i], likely[j])
        and (more := _more(alone[i], alone[j], common[np.ix_(own[i], own[j])]))
    ]
    return max(pairs, key=lambda pair: pair.share, default=None)


def _by_share(one: Score, other: Score) -> tuple[Score, Score]:
    """Return two scores, that of the larger share first."""
    return (one, other) if one.share >= other.share else (other, one)


def _more(one: np.ndarray, other: np.ndarray, between: np.ndarray) -> float:
    """Return how much two explain together, relative to the one; 0 if either turns round.

    Args:
        one: What it explains by itself, along orthonormal directions of its own, [k].
        other: What the other explains by itself, along its own, [l].
        between: Products of the one's directions and the other's, [k, l].
    """
    square, ways = np.linalg.eigh(np.eye(len(other)) - between.T @ between)
    rest = ways.T @ (other - between.T @ one)
    beside = ways @ (rest * (square > DISTINCT) / np.maximum(square, DISTINCT))
    own = one - between @ beside
    if own @ one <= 0.0 or beside @ other <= 0.0:
        return 0.0
    return 1.0 + float(beside @ (ways @ rest)) / float(one @ one)


def _are_two(problem: Problem, one: Score, other: Score) -> bool:
    """Say whether both may be missing, and are not much the same or laws of the same."""
    laws = [problem.simulator.effects[score.effect] for score in (one, other)]
    owners = one.effect, other.effect
    are_related = refines(problem, *owners) or refines(problem, *owners[::-1])
    return not are_related and not are_exclusive(*laws) and cosine(one, other) <= EQUIVALENT
