"""Estimates as a timestep of 0 would have them, and as a smooth cost would across contacts."""

import dataclasses

import numpy as np

from garat_jax.diagnosis.differences import STEP, clear_differences, projected
from garat_jax.diagnosis.fit import WIDE, converge, fit, interval, uncertainty, wide
from garat_jax.diagnosis.problem import Linearisation, Problem, block_labels
from garat_jax.diagnosis.robust import regress
from garat_jax.diagnosis.starts import KEPT_PROMISE, Fit, follow, start_step
from garat_jax.diagnosis.surface import smooth_minimum

EXTRAPOLATED = 0.1
"""Share of the shift to a timestep of 0 that is uncertain at least: it is extrapolated from half of
one. It is as much more as half the shift does less, or more, than was promised of it."""

UNFELT = 0.1
"""Norm of what a shift is to change, in standard deviations of noise, below which it is none."""
EXPLAINED = 1.1
"""What would be left at a timestep of 0, relative to what the fit leaves, up to which that can be
extrapolated."""
REFITTED = 24
"""Segments that are fitted again at least, at both timesteps."""


def count_timestep(problem: Problem, fitted: Fit) -> Fit:
    """Move the estimates to where a timestep of 0 would have them, and the intervals with them.

    At the model's own timestep a parameter also makes up for the integrator's error, which may be
    many times the noise. Where halving the timestep does much less or more than sensitivities
    promise, or a timestep of 0 would explain less than the fit does, as across contacts, estimates
    stay, fits at both timesteps say how far they are from those at 0, and their intervals reach as
    far. Where contacts make the cost rough, that of a smooth surface counts; see `smooth_minimum`.
    """
    keep = np.asarray([j not in fitted.frozen for j in fitted.free], bool)
    if not np.any(keep):
        return fitted
    free = fitted.free
    differences = clear_differences(problem, fitted.theta, fitted.start, free)
    lin = differences.linearisation
    if np.all(differences.is_clear[keep] & (differences.relative[keep] <= STEP)):
        fitted, lin = converge(problem, fitted, differences)
    elif not np.all(differences.is_clear[keep]):
        lin = wide(
            problem, fitted, free, np.where(differences.is_clear, differences.relative, WIDE)
        )
    rough = np.zeros(len(free))
    if np.any(differences.relative[keep] > STEP):
        covariance, sure = uncertainty(problem, lin, keep)
        excited = np.asarray(free)[keep]
        fitted, rough[keep] = smooth_minimum(problem, fitted, excited, covariance, sure)
        lin = lin._replace(residual=fitted.residual)
    theta, start = fitted.theta, fitted.start
    halved = problem.integrator_error(theta, start, fitted.residual)
    near = lin._replace(start=fitted.sensitivity)
    shift = _step(problem, near._replace(residual=2.0 * halved), theta, free, keep)
    kept = _kept_promise(problem, near._replace(residual=halved), fitted, 0.5 * shift)
    there = None
    if abs(1.0 - kept) <= 1.0 - KEPT_PROMISE:
        there = _moved(problem, near._replace(residual=2.0 * halved), fitted, shift)
    if there is None:
        low, high = _wider(interval(problem, theta, lin, free, keep), rough)
        shift = _shift_by_fits(problem, fitted)
        low, high = low + np.minimum(shift, 0.0), high + np.maximum(shift, 0.0)
        return dataclasses.replace(fitted, low=low, high=high)
    moved, left = there
    low, high = _wider(interval(problem, moved, lin._replace(residual=left), free, keep), rough)
    unsure = max(EXTRAPOLATED, abs(1.0 - kept)) * np.abs((moved - theta)[list(free)])
    return dataclasses.replace(follow(problem, moved, fitted), low=low - unsure, high=high + unsure)


def _step(problem: Problem, lin: Linearisation, theta: np.ndarray, free, keep) -> np.ndarray:
    """Return the change of the free parameters, within bounds, that lowers a residual most, [k]."""
    sensitivity, residual = projected(problem, lin)
    labels = block_labels(problem)[problem.fitted].ravel()
    moved = theta.copy()
    moved[np.asarray(free)[keep]] += regress(sensitivity[:, keep], residual, labels).coefficient
    moved = problem.within_bounds(range(len(moved)), moved)
    return (moved - theta)[list(free)]


def _moved(problem: Problem, change: Linearisation, fitted: Fit, shift: np.ndarray):
    """Return a fit's parameters at a timestep of 0, and the residual as it would be there.

    Args:
        problem: What is fitted.
        change: What a timestep of 0 changes of the fit's residual, with the fit's sensitivities.
        fitted: The fit.
        shift: The Gauss-Newton step of the free parameters that undoes the change, [k].

    Returns:
        Parameters [num_parameters] and residual [S, N]; None where the step does not undo any of
        it, or more is left than the fit leaves.
    """
    sensitivity, before = projected(problem, change)
    if np.linalg.norm(sensitivity @ shift) < UNFELT:
        return fitted.theta, fitted.residual + change.residual
    moved = fitted.theta.copy()
    moved[list(fitted.free)] += shift
    expected, undamped = change.residual + change.parameters @ shift, np.zeros(len(fitted.start))
    apart = start_step(problem, change, expected, undamped, 0.0) * problem.segments.start_unit
    starts = fitted.start + apart
    left = 2.0 * problem.residual_by(problem.finer, moved, starts)
    left -= problem.residual_by(problem.simulator, moved, starts)
    after = projected(problem, change._replace(residual=left - fitted.residual))[1]
    explains_less = _cost(problem, left) > EXPLAINED * _cost(problem, fitted.residual)
    if explains_less or np.linalg.norm(after) >= np.linalg.norm(before):
        return None
    return moved, left


def _cost(problem: Problem, residual: np.ndarray) -> float:
    return float(np.sum(residual[problem.fitted] ** 2))


def _shift_by_fits(problem: Problem, near: Fit) -> np.ndarray:
    """Return how far a timestep of 0 moves the free parameters, by fits at the whole and at half.

    Some segments say it, `REFITTED` or more, evenly chosen.
    """
    chosen = np.flatnonzero(problem.fitted)
    chosen = chosen[:: max(1, len(chosen) // REFITTED)]
    problem, near = problem.take(chosen), near.take(chosen)

    def fitted_by(simulator) -> np.ndarray:
        there = dataclasses.replace(problem, simulator=simulator)
        return fit(there, near.theta, near.start, near.free, sensitivity=near.sensitivity).theta

    shift = 2.0 * (fitted_by(problem.finer) - fitted_by(problem.simulator))
    moved = problem.within_bounds(range(len(shift)), near.theta + shift)
    return (moved - near.theta)[list(near.free)]


def _wider(ends: tuple[np.ndarray, np.ndarray], rough: np.ndarray):
    """Return an interval with a further, independent half-width, [k] each."""
    low, high = (np.array(end) for end in ends)
    known = np.isfinite(low) & np.isfinite(high)
    centre = (low[known] + high[known]) / 2
    half = np.hypot((high[known] - low[known]) / 2, rough[known])
    low[known], high[known] = centre - half, centre + half
    return low, high


def _kept_promise(problem: Problem, half: Linearisation, fitted: Fit, shift) -> float:
    """Return how much of the change that half the timestep makes a shift of parameters undoes.

    Relative to what sensitivities promise; the change is the residual in `half`. Where that would
    hardly show, it is as promised.
    """
    moved = fitted.theta.copy()
    moved[list(fitted.free)] += shift
    there = problem.integrator_error(moved, fitted.start, fitted.residual)
    sensitivity, before = projected(problem, half)
    _, found = projected(problem, half._replace(residual=there))
    effect = sensitivity @ shift
    if np.linalg.norm(effect) < UNFELT:
        return 1.0
    promised = np.sum(before**2) - np.sum((before + effect) ** 2)
    return float((np.sum(before**2) - np.sum(found**2)) / max(promised, 1e-300))
