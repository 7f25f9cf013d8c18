"""Gauss-Newton steps of parameters and initial states together.

The initial states leave the normal equations by projection (variable projection, Golub and Pereyra
1973). Sensitivities to them, which are most of the simulations, are kept from step to step as long
as the cost falls as they promise.
"""

import numpy as np
from scipy import optimize

from garat_jax.diagnosis.differences import STEP, Differences, difference_steps, projected
from garat_jax.diagnosis.problem import Linearisation, Problem, linearise
from garat_jax.diagnosis.starts import (
    KEPT_PROMISE,
    SETTLED,
    measured_anew,
    promised_costs,
    start_step,
)

FITTED = 1e-4
"""Fall of the cost, relative to it, below which a fit has converged."""
CONVERGED = 0.01
"""Fall of the cost, in squared standard deviations of noise, below which a last fit has converged:
what is reported then differs by a tenth of its standard deviation."""
STEPS = 24
"""Largest number of Gauss-Newton steps in a row."""
SHRINK = 10.0
"""Factor of the damping from a step that is not taken to the next; a tenth after one that is."""
FIRST_SHRUNK = 1.0
"""Damping, relative to what the data say, after the first that is not: half the step."""
STALLED = 4
"""Steps in a row, taken or not, after which a fit with wider differences has converged, too, if
none lowers the cost by `LITTLE` or by `KEPT_PROMISE` of its promise: initial states promise for
ever what jumps do not let them keep. With small differences twice as many, for damping to grow."""
LITTLE = 1e-3
"""Fall of the cost, relative to it."""
MOST_DAMPED = 1e4
"""Damping, relative to what the data say, from which a fit makes no further step."""
BEATEN = 2.0
"""Cost, relative to another fit's, above which a fit that has stalled goes no further. One that
still falls may surprise: where things stick and slip, costs fall by more than steps promise."""


def descend(
    problem: Problem,
    free,
    rival: float,
    theta,
    start,
    near: Differences,
    is_stale: bool,
    least: float = np.inf,
):
    """Take Gauss-Newton steps of parameters and initial states together; see `fit`.

    Each segment decides for itself whether its initial state follows, and when the derivatives by
    it are measured again.

    Args:
        problem: What is fitted.
        free: Indices of the parameters to fit.
        rival: As for `fit`.
        theta: Where to start, [num_parameters].
        start: Initial states, [S, nq + nv].
        near: Differences there; their relative steps are kept.
        is_stale: Whether their derivatives by the initial states are from elsewhere.
        least: Fall of the cost below which it has converged, if that is below `FITTED` of it.

    Returns:
        Parameters, initial states and the linearisation at them.
    """
    damping, undamped, stalled = 1e-4, np.zeros(len(start)), 0
    patience = STALLED if np.any(near.relative > STEP) else 2 * STALLED
    lin, is_old = near.linearisation, np.full(len(start), is_stale)
    for taken in range(STEPS):
        change, _ = parameter_step(problem, theta, lin, free, damping)
        expected = lin.residual + lin.parameters @ change
        start_change = start_step(problem, lin, expected, undamped, 0.0)
        before = np.sum(lin.residual**2, 1)
        promised = before - promised_costs(lin, expected, start_change)
        cost, promise = before[problem.fitted].sum(), promised[problem.fitted].sum()
        if promise < min(FITTED * cost, least) or damping > MOST_DAMPED or stalled == patience:
            break
        if taken > 1 and stalled and cost - promise > BEATEN * rival:
            break
        moved = theta.copy()
        moved[list(free)] += change
        starts = start + start_change * problem.segments.start_unit
        starts, residual = _tried(problem, moved, start, starts, before)
        falls = before - np.sum(residual**2, 1)
        fall = falls[problem.fitted].sum()
        missed = is_old & (promised > SETTLED * before) & (falls < KEPT_PROMISE * promised)
        stalled = 0 if fall > min(LITTLE * cost, KEPT_PROMISE * promise) else stalled + 1
        if fall > 0:
            theta, start, damping = moved, starts, damping / SHRINK
            steps = difference_steps(problem, theta, free, near.relative)
            lin = linearise(problem, theta, start, free, steps, lin.start, residual)
            is_old = np.ones(len(start), bool)
        elif not np.any(missed & problem.fitted):
            damping = max(damping * SHRINK, FIRST_SHRUNK)
        if np.any(missed):
            lin, is_old = measured_anew(problem, theta, start, lin, missed), is_old & ~missed
    return theta, start, lin


def _tried(problem: Problem, theta, stay, move, before: np.ndarray):
    """Simulate where initial states move, or stay in segments that move for the worse.

    Args:
        problem: What is fitted.
        theta: Parameters, [num_parameters].
        stay: Initial states before the step, [S, nq + nv].
        move: Those after it.
        before: Each segment's cost before the step, [S].

    Returns:
        Initial states, [S, nq + nv], and the residual there, [S, N].
    """
    simulator, starts = problem.simulator, move.copy()
    residual = problem.residual_by(simulator, theta, move)
    cost = np.sum(residual**2, 1)
    worse = np.flatnonzero(cost > before)
    if not len(worse):
        return starts, residual
    stayed = problem.take(worse).residual_by(simulator, theta, stay[worse])
    better = np.sum(stayed**2, 1) < cost[worse]
    chosen = worse[better]
    starts[chosen], residual[chosen] = stay[chosen], stayed[better]
    return starts, residual


def excited(problem: Problem, free, sensitivity: np.ndarray) -> np.ndarray:
    """Say which parameters would show within their bounds, [k] bool."""
    width = [
        problem.simulator.slots[j].parameter.high - problem.simulator.slots[j].parameter.low
        for j in free
    ]
    return np.linalg.norm(sensitivity, axis=0) * np.asarray(width) > 3.0


def parameter_step(problem: Problem, theta, lin: Linearisation, free, damping: float):
    """Return a damped step within the bounds [k], and which parameters are excited."""
    sensitivity, residual = projected(problem, lin)
    keep = excited(problem, free, sensitivity)
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
