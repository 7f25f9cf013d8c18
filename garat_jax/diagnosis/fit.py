"""Fit parameters by Gauss-Newton with the initial state of every segment eliminated.

The initial states leave the normal equations by projection (variable projection, Golub and Pereyra
1973). Sensitivities to them, which are most of the simulations, are kept from step to step as long
as the cost falls as they promise.
"""

import dataclasses

import numpy as np
from scipy import optimize, stats

from garat_jax.diagnosis.problem import (
    Linearisation,
    Problem,
    StartSpace,
    block_labels,
    difference_steps,
    linearise,
    tall,
)
from garat_jax.diagnosis.robust import regress

STEP = 1e-2
"""Finite difference of a fit, relative to a parameter's `scale` or size."""
UNEXCITED = 1e-6
"""Sensitivity, relative to the residual's size at the bounds, below which a direction is frozen."""
FITTED = 1e-4
"""Fall of the cost, relative to it, below which a fit has converged."""
SETTLED = 1e-3
"""Fall of a segment's cost, relative to it, below which its initial state is left as it is."""
SETTLE_STEPS = 10
"""Steps of the initial states after a fit, whose own steps have moved them already."""
KEPT_PROMISE = 0.5
"""Fall of the cost, relative to the promised one, below which sensitivities are measured again."""
BEATEN = 2.0
"""Cost, relative to another fit's, above which a fit is not worth its last steps."""


@dataclasses.dataclass(frozen=True)
class Fit:
    """Parameters, initial states and what is left of the residual.

    Attributes:
        theta: All parameters, [num_parameters].
        free: Indices of those that were fitted.
        frozen: Indices that the data do not excite; they kept their values.
        start: Initial states, [S, nq + nv].
        residual: Whitened, [S, N].
        sensitivity: Its derivatives by the initial states, [S, N, nq + nv].
        low: Lower ends of the free parameters' 95 % intervals, without the timestep's error; see
            `count_timestep`.
        high: Upper ends.
    """

    theta: np.ndarray
    free: tuple[int, ...]
    frozen: tuple[int, ...]
    start: np.ndarray
    residual: np.ndarray
    sensitivity: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @property
    def cost(self) -> np.ndarray:
        """Sum of squares of each segment, [S]."""
        return np.sum(self.residual**2, axis=1)


def settle(problem: Problem, theta: np.ndarray, start: np.ndarray, iterations: int = 8) -> Fit:
    """Estimate the initial state of every segment at fixed parameters.

    Each segment has a damping of its own and is done when its linearisation promises no fall of
    its cost that matters; a step that was rejected is tried again, shorter.
    """
    lin = linearise(problem, theta, start, (), ())
    start, lin = _settle(problem, theta, start, lin, iterations)
    nothing = np.zeros(0)
    return Fit(theta, (), (), start, lin.residual, lin.start, nothing, nothing)


def _settle(problem: Problem, theta, start, lin: Linearisation, iterations: int):
    """Return settled initial states and the linearisation at them, from one that is near."""
    lin = lin._replace(parameters=lin.parameters[..., :0])
    damping, is_stale = np.full(len(start), 1e-6), np.ones(len(start), bool)
    for _ in range(iterations):
        change = _start_step(lin, lin.residual, damping)
        before = np.sum(lin.residual**2, 1)
        promised = before - _promised(lin, lin.residual, change)
        open_still = promised >= SETTLED * before
        if not np.any(open_still):
            break
        starts = start + change * lin.start_unit
        trial = linearise(problem, theta, starts, (), (), lin.start)
        fall = before - np.sum(trial.residual**2, 1)
        better = fall > 0
        start = np.where(better[:, None], starts, start)
        lin = _choose(better, trial, lin)
        later = np.where(is_stale, damping, np.maximum(damping, 1e-5) * 100.0)
        damping = np.where(better, damping * 0.1, later)
        again = open_still & (is_stale | better) & (fall < KEPT_PROMISE * promised)
        if np.any(again):
            fresh = linearise(problem.take(again), theta, start[again], (), ())
            lin.start[again] = fresh.start * (lin.start_unit / fresh.start_unit)
        is_stale = np.where(again, False, is_stale | better)
    return start, lin


def _promised(lin: Linearisation, residual: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Return each segment's cost [S] if the initial states' effect on the residual were linear."""
    return np.sum((residual + np.einsum("sni,si->sn", lin.start, change)) ** 2, axis=1)


def _choose(which: np.ndarray, new: Linearisation, old: Linearisation) -> Linearisation:
    """Take the segments `which` [S] from one linearisation and the others from another."""
    return Linearisation(
        np.where(which[:, None], new.residual, old.residual),
        np.where(which[:, None, None], new.parameters, old.parameters),
        np.where(which[:, None, None], new.start, old.start),
        new.start_unit,
    )


def _start_step(lin: Linearisation, residual: np.ndarray, damping: np.ndarray) -> np.ndarray:
    """Return damped Gauss-Newton changes of the initial states [S, nq + nv], in their units."""
    normal = np.swapaxes(lin.start, 1, 2) @ lin.start
    gradient = np.einsum("sni,sn->si", lin.start, residual)
    diagonal = np.einsum("sii->si", normal)
    floor = 1e-12 * diagonal.max(axis=1, keepdims=True) + 1e-300
    ridge = np.maximum(damping, 1e-12)[:, None] * diagonal + floor
    normal = normal + ridge[:, :, None] * np.eye(normal.shape[1])
    return -np.linalg.solve(normal, gradient[..., None])[..., 0]


def fit(
    problem: Problem,
    theta,
    start,
    free,
    iterations: int = 12,
    rival: float = np.inf,
    sensitivity: np.ndarray | None = None,
) -> Fit:
    """Fit some parameters within their bounds, and every initial state.

    Parameters see the fitted segments only. The initial states of those held out follow as long as
    that lowers their own cost, and are settled at the end.

    Args:
        problem: What is fitted.
        theta: Where to start, [num_parameters].
        start: Initial states to start from, [S, nq + nv].
        free: Indices of the parameters to fit.
        iterations: Largest number of Gauss-Newton steps.
        rival: Cost on the fitted segments that another fit reached; steps that promise no more than
            `BEATEN` times that are not taken.
        sensitivity: Derivatives by the initial states from nearby; see `linearise`.
    """
    theta, free = np.array(theta, float), tuple(free)
    damping, undamped = 1e-4, np.zeros(len(start))

    def at(theta, start, sensitivity) -> Linearisation:
        steps = difference_steps(problem, theta, free, STEP)
        return linearise(problem, theta, start, free, steps, sensitivity)

    lin = at(theta, start, sensitivity)
    keep, is_stale = np.ones(len(free), bool), sensitivity is not None
    for taken in range(iterations):
        change, keep = _parameter_step(problem, theta, lin, free, damping)
        expected = lin.residual + lin.parameters @ change
        start_change = _start_step(lin, expected, undamped)
        before = np.sum(lin.residual[problem.fitted] ** 2)
        promised = _promised(lin, expected, start_change)[problem.fitted].sum()
        if before - promised < FITTED * before or damping > 1e8:
            break
        if taken > 1 and promised > BEATEN * rival:
            break
        starts = start + start_change * lin.start_unit
        trial_theta = theta.copy()
        trial_theta[list(free)] += change
        trial = at(trial_theta, starts, lin.start)
        fall = before - np.sum(trial.residual[problem.fitted] ** 2)
        if fall > 0:
            follows = np.sum(trial.residual**2, 1) < np.sum(lin.residual**2, 1)
            moved = problem.fitted | follows
            start = np.where(moved[:, None], starts, start)
            theta, lin, damping = trial_theta, _choose(moved, trial, lin), damping * 0.1
        elif not is_stale:
            damping = max(damping, 1e-3) * 30.0
        if is_stale and fall < KEPT_PROMISE * (before - promised):
            lin, is_stale = at(theta, start, None), False
        elif fall > 0:
            is_stale = True
    low, high = _interval(problem, theta, lin, free, keep)
    if not np.all(problem.fitted):  # some of those held out did not follow
        lin = linearise(problem, theta, start, (), (), lin.start)
    start, lin = _settle(problem, theta, start, lin, SETTLE_STEPS)
    frozen = tuple(j for j, kept in zip(free, keep, strict=True) if not kept)
    return Fit(theta, free, frozen, start, lin.residual, lin.start, low, high)


def _projected(problem: Problem, lin: Linearisation) -> tuple[np.ndarray, np.ndarray]:
    """Return the fitted segments' sensitivities [M, k] and residual [M], initial states removed."""
    both = np.concatenate([lin.parameters, lin.residual[..., None]], axis=2)[problem.fitted]
    rest = tall(StartSpace(lin.start[problem.fitted]).remove(both))
    return rest[:, :-1], rest[:, -1]


def _excited(problem: Problem, free, sensitivity: np.ndarray) -> np.ndarray:
    """Say which parameters would show within their bounds, [k] bool."""
    width = [
        problem.simulator.slots[j].parameter.high - problem.simulator.slots[j].parameter.low
        for j in free
    ]
    return np.linalg.norm(sensitivity, axis=0) * np.asarray(width) > 3.0


def _parameter_step(problem: Problem, theta, lin: Linearisation, free, damping: float):
    """Return a damped step within the bounds [k], and which parameters are excited."""
    sensitivity, residual = _projected(problem, lin)
    keep = _excited(problem, free, sensitivity)
    slots = [problem.simulator.slots[j].parameter for j in np.asarray(free)[keep]]
    step = np.zeros(len(free))
    if not slots:
        return step, keep
    unit = np.linalg.norm(sensitivity[:, keep], axis=0)
    augmented = np.column_stack([sensitivity[:, keep] / unit, residual])
    triangle = np.asarray(np.linalg.qr(augmented, mode="r"))
    matrix = np.vstack([triangle[:, :-1], np.sqrt(damping + 1e-10) * np.eye(len(slots))])
    target = np.concatenate([-triangle[:, -1], np.zeros(len(slots))])
    now = theta[np.asarray(free)[keep]]
    low = (np.asarray([p.low for p in slots]) - now) * unit
    high = (np.asarray([p.high for p in slots]) - now) * unit
    low, high = np.minimum(low, 0.0), np.maximum(high, 0.0)
    fixed = high - low < 1e-12 * unit
    high = np.where(fixed, low + 1e-12 * unit, high)
    step[keep] = optimize.lsq_linear(matrix, target, (low, high)).x / unit
    return step, keep


def _interval(problem: Problem, theta, lin: Linearisation, free, keep):
    """Return 95 % intervals: robust, with blocks of time as the independent units."""
    low, high = np.full(len(free), -np.inf), np.full(len(free), np.inf)
    if not np.any(keep):
        return low, high
    sensitivity, residual = _projected(problem, lin)
    labels = block_labels(problem)[problem.fitted].ravel()
    found = regress(sensitivity[:, keep], residual, labels)
    half = stats.t.ppf(0.975, found.freedom) * np.sqrt(np.diag(found.covariance))
    centre = theta[np.asarray(free)[keep]]
    low[keep], high[keep] = centre - half, centre + half
    return low, high


def count_timestep(problem: Problem, fitted: Fit) -> Fit:
    """Measure the intervals again and widen them by the shift that a timestep of 0 would make.

    The estimates were fitted at the model's own timestep.
    """
    keep = np.asarray([j not in fitted.frozen for j in fitted.free], bool)
    if not np.any(keep):
        return fitted
    steps = difference_steps(problem, fitted.theta, fitted.free, STEP)
    lin = linearise(problem, fitted.theta, fitted.start, fitted.free, steps)
    low, high = _interval(problem, fitted.theta, lin, fitted.free, keep)
    change = 2.0 * problem.integrator_error(fitted.theta, fitted.start, lin.residual)
    sensitivity, change = _projected(problem, lin._replace(residual=change))
    shift = np.zeros(len(keep))
    labels = block_labels(problem)[problem.fitted].ravel()
    shift[keep] = regress(sensitivity[:, keep], change, labels).coefficient
    low, high = low + np.minimum(shift, 0.0), high + np.maximum(shift, 0.0)
    return dataclasses.replace(fitted, low=low, high=high)
