"""Estimates as a timestep of 0 would have them, and as a smooth cost would across contacts."""

import dataclasses

import numpy as np

from garat_jax.diagnosis.differences import STEP, Differences, clear_differences, projected
from garat_jax.diagnosis.fit import (
    WIDE,
    are_determined,
    converge,
    fit,
    interval,
    uncertainty,
    wide,
)
from garat_jax.diagnosis.metric import beyond_starts, coarse_error, trusted
from garat_jax.diagnosis.problem import Linearisation, Problem, block_labels
from garat_jax.diagnosis.robust import regress
from garat_jax.diagnosis.starts import KEPT_PROMISE, Fit, follow, settle_twice, start_step
from garat_jax.diagnosis.surface import smooth_minimum

EXTRAPOLATED = 0.1
"""Share of the shift to a timestep of 0 that is uncertain at least: it is extrapolated from half of
one. It is as much more as half the shift does less, or more, than was promised of it."""

UNFELT = 0.1
"""Norm of what a shift is to change, in standard deviations of noise, below which it is none."""
EXPLAINED = 1.1
"""What would be left at a timestep of 0, relative to what the fit leaves, up to which that can be
extrapolated."""
REFINED = 4
"""Physics substeps in place of each, from one timestep at which is fitted to the next."""
REFINEMENTS = 2
"""Largest number of finer timesteps at which is fitted."""
REFITTED = 24
"""Segments of all recordings that are fitted again, at least."""
IN_A_ROW = 4
"""Of these, those that follow each other: one says where the next begins."""
LOST = 10.0
"""Cost of a segment, relative to noise's and to the median segment's, above which its initial state
was not found."""
SETTLED = 0.4
"""What a finer timestep changes, in half-widths of the fit's own interval, below which no still
finer one is tried: a timestep of 0 changes a third of that. Wide differences make the interval that
is given wider, but not the estimate better."""


def count_timestep(problem: Problem, fitted: Fit, num_refitted: int = REFITTED) -> Fit:
    """Move the estimates to where a timestep of 0 would have them, and the intervals with them.

    At the model's own timestep a parameter also makes up for the integrator's error, which may be
    many times the noise. What half the timestep does is extrapolated, unless it does much less or
    more than sensitivities promise, or a timestep of 0 would explain less than the fit does. Then,
    and where contacts make predictions jump, estimates are those of fits at finer timesteps if the
    timestep's error is above the noise. If it is below, jumps or not, the minimum of a smooth
    surface through a rough cost counts (see `smooth_minimum`); where that is not extrapolated, fits
    at the whole and at half the timestep say how far it is from one at 0, and intervals reach as
    far.

    Args:
        problem: What is fitted.
        fitted: The fit.
        num_refitted: Segments that are fitted again where that is needed, at least.
    """
    excited = _excited(fitted)
    if not np.any(excited) or not are_determined(problem, excited):
        return fitted
    differences = clear_differences(problem, fitted.theta, fitted.start, fitted.free)
    if not _are_smooth(differences, excited) and _is_coarse(problem, fitted):
        return _at_finer_timesteps(problem, fitted, num_refitted, differences.relative)
    fitted, lin, rough = _at_minimum(problem, fitted, differences)
    if moved := _extrapolated(problem, fitted, lin, rough):
        return moved
    if _is_coarse(problem, fitted):
        return _at_finer_timesteps(problem, fitted, num_refitted, differences.relative)
    low, high = _interval(problem, fitted.theta, fitted, lin, rough)
    shift = _shift_by_fits(problem, fitted, num_refitted)
    low, high = low + np.minimum(shift, 0.0), high + np.maximum(shift, 0.0)
    return dataclasses.replace(fitted, low=low, high=high)


def _excited(fitted: Fit) -> np.ndarray:
    """Say which of the free parameters the data excite, [k] bool."""
    return np.asarray([j not in fitted.frozen for j in fitted.free], bool)


def _are_smooth(differences: Differences, keep: np.ndarray) -> bool:
    """Say whether none of the parameters that are kept makes predictions jump."""
    return bool(np.all((differences.is_clear & (differences.relative <= STEP))[keep]))


def _is_coarse(problem: Problem, fitted: Fit) -> bool:
    """Say whether the timestep's error is above the noise, as half of it tells."""
    change = beyond_starts(fitted, coarse_error(problem, fitted))
    return bool(np.sum(change[problem.fitted] ** 2) > np.sum(problem.expected[problem.fitted]))


def _at_minimum(
    problem: Problem, fitted: Fit, differences: Differences
) -> tuple[Fit, Linearisation, np.ndarray]:
    """Take a fit to its minimum; across contacts, to that of a smooth surface through its cost.

    Returns:
        The fit there, the linearisation, and how far parameters may be from there, [k].
    """
    keep, lin, rough = _excited(fitted), differences.linearisation, np.zeros(len(fitted.free))
    if not are_determined(problem, keep):
        return fitted, lin, rough
    if _are_smooth(differences, keep):
        return *converge(problem, fitted, differences), rough
    if not np.all(differences.is_clear[keep]):
        relative = np.where(differences.is_clear, differences.relative, WIDE)
        lin = wide(problem, fitted, fitted.free, relative)
    covariance, sure = uncertainty(problem, lin, keep)
    shows = np.diag(covariance) > 0.0  # not so one that no difference moves, as below a threshold
    if not np.any(shows):
        return fitted, lin, rough
    keep[keep] = shows
    columns, covariance = np.asarray(fitted.free)[keep], covariance[np.ix_(shows, shows)]
    fitted, rough[keep] = smooth_minimum(problem, fitted, columns, covariance, sure)
    return fitted, lin._replace(residual=fitted.residual), rough


def _interval(problem: Problem, theta, fitted: Fit, lin: Linearisation, rough: np.ndarray):
    """Return 95 % intervals' ends, with a further, independent half-width, [k] each."""
    low, high = interval(problem, theta, lin, fitted.free, _excited(fitted))
    known = np.isfinite(low) & np.isfinite(high)
    centre = (low[known] + high[known]) / 2
    half = np.hypot((high[known] - low[known]) / 2, rough[known])
    low[known], high[known] = centre - half, centre + half
    return low, high


def _extrapolated(
    problem: Problem, fitted: Fit, lin: Linearisation, rough: np.ndarray
) -> Fit | None:
    """Return a fit with what half the timestep does extrapolated; None if that cannot be trusted.

    Args:
        problem: What is fitted.
        fitted: The fit, converged.
        lin: The linearisation there.
        rough: How far its free parameters may be from the minimum, [k].
    """
    theta, start, free, keep = fitted.theta, fitted.start, fitted.free, _excited(fitted)
    halved = problem.integrator_error(theta, start, fitted.residual)
    near = lin._replace(start=fitted.sensitivity)
    shift = _step(problem, near._replace(residual=2.0 * halved), theta, free, keep)
    kept = _kept_promise(problem, near._replace(residual=halved), fitted, 0.5 * shift)
    if abs(1.0 - kept) > 1.0 - KEPT_PROMISE:
        return None
    there = _moved(problem, near._replace(residual=2.0 * halved), fitted, shift)
    if there is None:
        return None
    moved, left = there
    low, high = _interval(problem, moved, fitted, lin._replace(residual=left), rough)
    unsure = max(EXTRAPOLATED, abs(1.0 - kept)) * np.abs((moved - theta)[list(free)])
    return dataclasses.replace(follow(problem, moved, fitted), low=low - unsure, high=high + unsure)


def _at_finer_timesteps(
    problem: Problem, fitted: Fit, num_refitted: int, relative: np.ndarray
) -> Fit:
    """Return a fit as ever finer timesteps have it, until a timestep of 0 would hardly change it.

    The integrator's error falls with the timestep. But contacts hold a fit back on its way, so that
    each is taken to the middle of the dips around it, and what the last timestep changed may be to
    come once more, and counts as unsure. Where predictions jumped at the timestep before, a clear
    difference is one within a dip, so that none is narrower than there. The noise is the same at
    each: an interval that is narrower than at the timestep before is so by chance. Where a finer
    timestep explains less, the estimates stay, and their intervals reach as far.

    Args:
        problem: What is fitted.
        fitted: The fit.
        num_refitted: Segments that are fitted again, at least.
        relative: Finite differences by which its parameters were clear, [k]; see `Differences`.
    """
    excited = _excited(fitted)
    free = np.asarray(fitted.free)[excited]
    chosen = _chosen(problem, num_refitted)
    some, near = problem.take(chosen), fitted.take(chosen)
    coarse, change, relative = _left(some, near), np.zeros(len(free)), relative[excited]
    half = half_before = (fitted.high - fitted.low)[excited] / 2
    for number in range(REFINEMENTS):
        half_before = half
        some, before = at_finer_timestep(some, near)
        near = fit(
            some,
            before.theta,
            before.start,
            free,
            sensitivity=before.sensitivity,
            searches=number == 0,
        )
        differences = clear_differences(some, near.theta, near.start, free, least=relative)
        near, lin, rough = _at_minimum(some, near, differences)
        relative, change = differences.relative, (near.theta - before.theta)[free]
        low, high = _interval(some, near.theta, near, lin, rough)
        half, of_fit = (high - low) / 2, np.hypot((near.high - near.low) / 2, rough)
        if np.all(np.abs(change) <= SETTLED * of_fit):
            break
    half = np.maximum(half, half_before)
    is_told = np.isfinite(half)
    theta, low, high = fitted.theta.copy(), fitted.low.copy(), fitted.high.copy()
    theta[free[is_told]] = near.theta[free[is_told]]
    ends = near.theta[free] - half + np.minimum(change, 0.0)
    low[excited] = np.where(is_told, ends, low[excited])
    ends = near.theta[free] + half + np.maximum(change, 0.0)
    high[excited] = np.where(is_told, ends, high[excited])
    if _left(some, near) > EXPLAINED * coarse:
        low, high = np.minimum(low, fitted.low), np.maximum(high, fitted.high)
        return dataclasses.replace(fitted, low=low, high=high)
    return dataclasses.replace(follow(problem, theta, fitted), low=low, high=high)


def _left(problem: Problem, fitted: Fit) -> float:
    """Return what a fit leaves, relative to noise."""
    return float(fitted.cost.sum() / problem.expected.sum())


def _chosen(problem: Problem, num: int) -> np.ndarray:
    """Return the indices of the segments that are fitted again, evenly chosen.

    Of a recording that is left out, the first count, too: it may be the only one of a condition.
    """
    fitted = np.flatnonzero(problem.fitted)
    recordings = problem.segments.recording[fitted]
    apart = max(1, len(fitted) // num)
    is_chosen = np.arange(len(fitted)) // IN_A_ROW % apart == 0
    for recording in np.setdiff1d(recordings, recordings[is_chosen]):
        is_chosen[np.flatnonzero(recordings == recording)[:IN_A_ROW]] = True
    return fitted[is_chosen]


def at_finer_timestep(problem: Problem, near: Fit) -> tuple[Problem, Fit]:
    """Return a problem at a finer timestep and a fit's initial states settled there.

    What a sample is trusted follows from the error at this timestep. Segments that stay far from
    what was measured, when most do not, are left out: their initial states were not found, on the
    wrong side of a contact.
    """
    everything = np.ones_like(problem.segments.trust)
    segments = dataclasses.replace(problem.segments, trust=everything)
    simulator = problem.simulator.refined(REFINED)
    finer = dataclasses.replace(problem, simulator=simulator, segments=segments)
    settled = settle_twice(finer, follow(finer, near.theta, near))
    share = settled.cost / finer.expected
    found = np.flatnonzero(share <= LOST * max(1.0, float(np.median(share))))
    finer, settled = finer.take(found), settled.take(found)
    return trusted(finer, settled), settled


def _shift_by_fits(problem: Problem, near: Fit, num_refitted: int) -> np.ndarray:
    """Return how far a timestep of 0 moves the free parameters, by fits at the whole and at half.

    Some segments say it, evenly chosen.
    """
    chosen = _chosen(problem, num_refitted)
    problem, near = problem.take(chosen), near.take(chosen)

    def fitted_by(simulator) -> np.ndarray:
        there = dataclasses.replace(problem, simulator=simulator)
        return fit(there, near.theta, near.start, near.free, sensitivity=near.sensitivity).theta

    simulator = problem.simulator
    shift = 2.0 * (fitted_by(simulator.refined(2)) - fitted_by(simulator))
    moved = problem.within_bounds(range(len(shift)), near.theta + shift)
    return (moved - near.theta)[list(near.free)]


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
    left = 2.0 * problem.residual_by(problem.simulator.refined(2), moved, starts)
    left -= problem.residual_by(problem.simulator, moved, starts)
    after = projected(problem, change._replace(residual=left - fitted.residual))[1]
    explains_less = _cost(problem, left) > EXPLAINED * _cost(problem, fitted.residual)
    if explains_less or np.linalg.norm(after) >= np.linalg.norm(before):
        return None
    return moved, left


def _cost(problem: Problem, residual: np.ndarray) -> float:
    return float(np.sum(residual[problem.fitted] ** 2))


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
