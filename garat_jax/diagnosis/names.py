"""One change under two names: laws that do the very same are fitted once."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.screen import Score, cosine
from garat_jax.diagnosis.slots import columns_of
from garat_jax.diagnosis.starts import Fit

SAME = 1.0 - 1e-9
"""Cosine of two candidates' changes from which they are one change."""


def twins(score: Score, others: Sequence[Score]) -> list[Score]:
    """Return those of the others that change the very same where screened, at the same sizes."""
    same = [s for s in others if len(s.size) == len(score.size) and np.allclose(s.size, score.size)]
    return [s for s in same if cosine(score, s) > SAME]


def is_predicted(problem: Problem, fitted: Fit) -> bool:
    """Say whether a fit that was renamed still predicts what is left of its residual."""
    predicted = problem.residual_by(problem.simulator, fitted.theta, fitted.start)
    return np.allclose(predicted, fitted.residual, atol=1e-6)


def stands_for(problem: Problem, one: Score, other: Score) -> dict[int, int]:
    """Return which parameter of another law stands for which of one, by index."""
    effects, slots = problem.simulator.effects, problem.simulator.slots
    if effects[one.effect].kind != effects[other.effect].kind:
        return dict(zip(one.columns, other.columns, strict=True))
    theirs = columns_of(slots, other.effect)
    return {j: theirs[name] for name, j in columns_of(slots, one.effect).items()}


def renamed(fitted: Fit, old: Sequence[int], new: Sequence[int], without: np.ndarray) -> Fit:
    """Return a fit whose parameters `old` are called `new`; its residual stays the very array.

    Args:
        fitted: The fit.
        old: Indices of some parameters.
        new: Those that get their values.
        without: Values at which the old ones do nothing, [num_parameters].
    """
    theta, names = fitted.theta.copy(), dict(zip(old, new, strict=True))
    theta[list(old)] = without[list(old)]
    theta[list(new)] = fitted.theta[list(old)]
    free, frozen = (
        tuple(names.get(j, j) for j in columns) for columns in (fitted.free, fitted.frozen)
    )
    return dataclasses.replace(fitted, theta=theta, free=free, frozen=frozen)
