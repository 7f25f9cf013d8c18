"""Which candidates do what a contender does, at the size at which it was fitted.

Screening holds candidates against each other at sizes of its own. Where what an effect does changes
with its size and sign, as beside contacts, two that are the same force may look unlike there.
"""

from collections.abc import Sequence

import numpy as np

from garat_jax.diagnosis.differences import ALIKE, cosines
from garat_jax.diagnosis.evidence import Evidence
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.screen import EQUIVALENT, Score, cosine, screened
from garat_jax.diagnosis.starts import Fit


def alike_as_fitted(
    problem: Problem, current: Fit, score: Score, fitted: Fit, others: Sequence[Score]
) -> list[Score]:
    """Return those of some candidates that do what a contender does.

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
    chosen, weight = screened(problem, current)
    evidence = Evidence(problem, current, chosen)
    weight = np.repeat(weight, len(evidence.residual) // len(chosen))[:, None]
    columns = list(score.columns)
    own = weight * evidence.change(_moved(current, columns, fitted.theta[columns]))
    if cosines(own, score.contribution[:, None]) > ALIKE:
        return alike
    size, thetas = np.linalg.norm(own), []
    for other in scaled:
        columns = list(other.columns)
        none = problem.simulator.base[columns]
        times = size / max(float(np.linalg.norm(other.contribution)), 1e-300)
        values = problem.within_bounds(columns, none + times * (other.size - none))
        thetas.append(_moved(current, columns, values)[0])
    same = cosines(weight * evidence.change(np.stack(thetas)), own) > EQUIVALENT
    return alike + [other for other, is_same in zip(scaled, same, strict=True) if is_same]


def _moved(current: Fit, columns: Sequence[int], values: np.ndarray) -> np.ndarray:
    """Return the current parameters with some at other values, [1, num_parameters]."""
    theta = current.theta.copy()
    theta[list(columns)] = values
    return theta[None]
