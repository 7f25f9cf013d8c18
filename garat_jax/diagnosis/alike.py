"""Which candidates do what a contender does, as screened or at the size at which it was fitted.

Screening holds candidates against each other at sizes of its own. Where what an effect does changes
with its size and sign, as beside contacts, two that are the same force may look unlike there.
"""

from collections.abc import Sequence

import numpy as np

from garat_jax.diagnosis.differences import cosines
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.screen import EQUIVALENT, Score, cosine, gather
from garat_jax.diagnosis.starts import Fit


def alike_as_fitted(
    problem: Problem, current: Fit, score: Score, fitted: Fit, others: Sequence[Score]
) -> list[Score]:
    """Return those of some candidates that do what a contender does.

    A law that lists several sizes is no multiple of itself and is held against it as screened only.

    Args:
        problem: What is fitted.
        current: The fit that was screened.
        score: What screening said of the contender.
        fitted: The contender's fit.
        others: What it said of the candidates.
    """
    alike = [other for other in others if cosine(score, other) > EQUIVALENT]
    scaled = [s for s in others if s not in alike and problem.num_listed(s.effect) == 1]
    if not scaled:
        return alike
    _, evidence, weight = gather(problem, current)
    changed = [*{*fitted.free} ^ {*current.free}]  # a refined law comes in a simpler one's place
    own = weight[:, None] * evidence.change(_moved(current, changed, fitted.theta[changed])[None])
    times = [float(np.linalg.norm(own) / np.linalg.norm(s.contribution)) for s in scaled]
    thetas = [_enlarged(problem, current, *each) for each in zip(scaled, times, strict=True)]
    same = cosines(weight[:, None] * evidence.change(np.stack(thetas)), own) > EQUIVALENT
    return alike + [other for other, is_same in zip(scaled, same, strict=True) if is_same]


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
