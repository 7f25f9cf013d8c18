"""How much wider intervals are for parameters of a law that were left at a guess."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from garat_jax.diagnosis.differences import clear_differences, projected
from garat_jax.diagnosis.problem import Problem, block_labels, block_stretches
from garat_jax.diagnosis.robust import directions, jackknife
from garat_jax.diagnosis.slots import columns_of
from garat_jax.diagnosis.starts import Fit


def with_guesses(problem: Problem, effects: Sequence[int], fitted: Fit) -> Fit:
    """Widen intervals by what those parameters may be that no fit needed and nothing else tells.

    A payload's place is a guess, its body's centre of mass, until a fit needs another. Its mass is
    then as uncertain as that place. (A parameter that acts alone, as an offset, has a value that
    says "no effect", and is no guess.) To first order: what the recordings leave open of the
    guesses, within their bounds, times how the fitted parameters make up for them; and intervals
    reach as far as a step to the best guess would move these.

    Args:
        problem: What was fitted.
        effects: Indices of the effects that act.
        fitted: The fit with all of them.
    """
    half = (fitted.high - fitted.low) / 2.0
    known = [i for i, j in enumerate(fitted.free) if j not in fitted.frozen and half[i] < np.inf]
    guesses = [j for i in effects for j in _guesses(problem, i, fitted)]
    if not known or not guesses:
        return fitted
    columns = (*(fitted.free[i] for i in known), *guesses)
    differences = clear_differences(problem, fitted.theta, fitted.start, columns)
    sensitivity, residual = projected(problem, differences.linearisation)
    basis, back = directions(sensitivity[:, : len(known)])
    guessed = sensitivity[:, len(known) :]
    answer = -back @ (basis.T @ guessed)  # by how much the fitted ones make up for each guess
    told = guessed - basis @ (basis.T @ guessed)
    half_width = _half_widths(problem, told, residual)
    parameters = [problem.simulator.slots[j].parameter for j in guesses]
    low, high = (np.asarray([getattr(p, end) for p in parameters]) for end in ("low", "high"))
    reach = (high - low) / 2.0
    weighted = told / half_width
    left = np.linalg.inv(weighted.T @ weighted + np.diag(reach**-2.0))
    step = -left @ (weighted.T @ residual / half_width)
    best = np.clip(fitted.theta[guesses] + step, low, high)
    shift = answer @ (best - fitted.theta[guesses])
    spread = np.sqrt(np.einsum("ki,ij,kj->k", answer, left, answer))
    wider = np.hypot(half[known], spread) - half[known]
    ends = fitted.low.copy(), fitted.high.copy()
    ends[0][known] += np.minimum(shift, 0.0) - wider
    ends[1][known] += np.maximum(shift, 0.0) + wider
    return dataclasses.replace(fitted, low=ends[0], high=ends[1])


def _guesses(problem: Problem, effect: int, fitted: Fit) -> list[int]:
    """Return the parameters that an effect's first one switches on and that were not fitted."""
    if problem.simulator.effects[effect].independent:
        return []
    _, *others = columns_of(problem.simulator.slots, effect).values()
    return [j for j in others if j not in fitted.free]


def _half_widths(problem: Problem, told: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Return half-widths of a 95 % interval of each guess by itself, were its column of norm 1.

    Errors last within blocks of time and beyond; were they white, it would be 1.96.

    Args:
        problem: What was fitted.
        told: What the guesses change that nothing fitted makes up for, [M, k].
        residual: [M].
    """
    labels, stretches = block_labels(problem)[problem.fitted].ravel(), block_stretches(problem)
    found = [jackknife(column[:, None], residual, labels, stretches) for column in told.T]
    deviation = np.sqrt([regression.covariance[0, 0] for regression in found])
    return 1.96 * np.maximum(deviation * np.linalg.norm(told, axis=0), 1.0)
