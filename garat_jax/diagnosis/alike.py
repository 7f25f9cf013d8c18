"""Which candidates do what the best contender does, as screened or at the size that it has.

Screening holds candidates against each other at sizes of its own. Where what an effect does changes
with its size and sign, as beside contacts, two that are the same force may look unlike there, and
what one of them does may not show at all.
"""

import dataclasses
from collections.abc import Callable, Collection, Sequence

import numpy as np

from garat_jax.diagnosis.contend import Contender, best_of, fit_one, likely_ones, refines, set_aside
from garat_jax.diagnosis.differences import cosines, is_erratic
from garat_jax.diagnosis.names import twins
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.screen import EQUIVALENT, Score, cosine, gather, simpler_law
from garat_jax.diagnosis.starts import Fit
from garat_jax.diagnosis.trials import UNEVEN

MATCHED = 2
"""How often a size is sought, at most, at which a candidate changes as much as a contender."""
AS_MUCH = 0.1
"""Difference of two norms, relative to the one, up to which two change as much."""


def with_alike(
    problem: Problem,
    current: Fit,
    scores: Sequence[Score],
    contenders: Sequence[Contender],
    say: Callable[[str], None],
    in_contact: bool = False,
) -> list[Contender]:
    """Add fits of the candidates that do what the best contender does: each may be meant.

    Those that do so at its size begin in its place, where it ended. In contact a fit from elsewhere
    may not come near, its initial states on the other side of many a contact; so one that was
    fitted is fitted again. A law that refines one that was added is fitted in its place only.

    Args:
        problem: What is fitted.
        current: The fit of the effects selected so far.
        scores: What screening says, best first.
        contenders: Those that were fitted.
        say: Told what is being done.
        in_contact: Look only at those of which few samples make what they change.
    """
    best = best_of(contenders)
    if best is None:
        return []
    fitted = {contender.score.effect: contender for contender in contenders}
    others = _others(problem, current, scores, best.score, fitted, in_contact)
    rival = best.fit.cost[problem.fitted].sum()
    as_screened, as_fitted = alike_as_fitted(problem, current, best.score, best.fit, others)
    in_place = set_aside(problem, best.fit, [best.score.effect])
    near = in_place if {*in_place.free} == {*current.free} else current
    for score in as_screened:
        if score.effect not in fitted:
            fitted[score.effect] = fit_one(problem, current, score, rival, say)
    for score in as_fitted:
        old, again = fitted.get(score.effect), fit_one(problem, near, score, rival, say)
        if not old or again.fit.cost.sum() < old.fit.cost.sum():
            shared = old.fit.residual if old else None  # by its other names, which go with it
            fitted = {e: c for e, c in fitted.items() if c.fit.residual is not shared}
            fitted[score.effect] = again
    return [*fitted.values()]


def _others(
    problem: Problem,
    current: Fit,
    scores: Sequence[Score],
    best: Score,
    fitted: Collection[int],
    in_contact: bool,
) -> list[Score]:
    """Return the candidates that may do what the best contender does, under one name each.

    Left out are other names of the best contender's law, and what was fitted, unless few samples
    make what it changes.
    """
    held = {problem.simulator.slots[j].effect for j in current.free}
    finer = {s.effect for s in scores if any(refines(problem, s.effect, i) for i in held)}
    scores = [s for s in scores if s.effect not in finer or s.effect not in fitted]
    likely = {score.effect for score in likely_ones(problem, scores)}
    like = [score for score in scores if score.effect == best.effect]
    others: list[Score] = []
    for score in scores:
        is_new = score.effect in likely and score.effect not in fitted and not in_contact
        has_simpler = score.effect in finer or bool(simpler_law(problem, score, scores))
        is_law = score.effect in likely or not has_simpler
        is_name = score.effect == best.effect or bool(twins(score, [*like, *others]))
        if not is_name and (is_new or (is_law and _is_uneven(problem, score))):
            others.append(score)
    return others


def _is_uneven(problem: Problem, score: Score) -> bool:
    """Say whether few samples make what a candidate changes, as in contact."""
    is_tried = score.possible and not score.excluded
    return is_tried and is_erratic(score.contribution, problem.num_signals, UNEVEN)


def alike_as_fitted(
    problem: Problem, current: Fit, score: Score, fitted: Fit, others: Sequence[Score]
) -> tuple[list[Score], list[Score]]:
    """Return those of some candidates that do what a contender does.

    They are held against it at the size at which they change as much. A law that lists several
    sizes is no multiple of itself and is held against it as screened only.

    Args:
        problem: What is fitted.
        current: The fit that was screened.
        score: What screening said of the contender.
        fitted: The contender's fit.
        others: What it said of the candidates.

    Returns:
        Those that do so as screened only, and those that do at the contender's size, with that.
    """
    alike = [other for other in others if cosine(score, other) > EQUIVALENT]
    scaled = [s for s in others if problem.num_listed(s.effect) == 1]
    if not scaled:
        return alike, []
    _, evidence, weight = gather(problem, current)

    def change(thetas: np.ndarray) -> np.ndarray:
        return weight[:, None] * evidence.change(thetas)

    changed = [*{*fitted.free} ^ {*current.free}]  # a refined law comes in a simpler one's place
    own = change(_moved(current, changed, fitted.theta[changed])[None])
    much, tried = np.linalg.norm(own), np.arange(len(scaled))
    does = np.stack([s.contribution for s in scaled], axis=1)
    times, thetas = np.ones(len(scaled)), np.tile(current.theta, (len(scaled), 1))
    is_same = np.zeros(len(scaled), bool)
    for _ in range(MATCHED):
        times[tried] *= much / np.linalg.norm(does[:, tried], axis=0)
        thetas[tried] = [_enlarged(problem, current, scaled[i], times[i]) for i in tried]
        does[:, tried] = change(thetas[tried])
        is_same = cosines(does, own) > EQUIVALENT
        is_off = np.abs(np.linalg.norm(does, axis=0) - much) > AS_MUCH * much
        tried = np.flatnonzero(is_off & ~is_same & does.any(axis=0))
        if not len(tried):
            break
    same = [
        dataclasses.replace(s, start={j: float(theta[j]) for j in s.columns})
        for s, theta, does_so in zip(scaled, thetas, is_same, strict=True)
        if does_so
    ]
    matched = {score.effect for score in same}
    return [score for score in alike if score.effect not in matched], same


def _enlarged(problem: Problem, current: Fit, score: Score, times: float) -> np.ndarray:
    """Return the current parameters with a candidate at a multiple of its expected size.

    Where the first of its parameters switches the others on, that one alone is multiplied.
    """
    columns = list(score.columns)
    none, size = problem.simulator.base[columns], np.asarray(score.size)
    is_multiplied = np.ones(len(columns), bool)
    is_multiplied[1:] = problem.simulator.effects[score.effect].independent
    values = np.where(is_multiplied, none + times * (size - none), size)
    return _moved(current, columns, problem.within_bounds(columns, values))


def _moved(current: Fit, columns: Sequence[int], values: np.ndarray) -> np.ndarray:
    """Return the current parameters with some at other values, [num_parameters]."""
    theta = current.theta.copy()
    theta[list(columns)] = values
    return theta
