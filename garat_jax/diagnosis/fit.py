"""Fit parameters by Gauss-Newton with the initial state of every segment eliminated.

The initial states leave the normal equations by projection (variable projection, Golub and Pereyra
1973). Sensitivities to them, which are most of the simulations, are kept from step to step as long
as the cost falls as they promise.
"""

from functools import partial

import numpy as np
from scipy import optimize, stats

from garat_jax.diagnosis.differences import (
    STEP,
    Differences,
    clear_differences,
    difference_steps,
    is_erratic,
    projected,
)
from garat_jax.diagnosis.problem import Linearisation, Problem, block_labels, linearise
from garat_jax.diagnosis.robust import regress
from garat_jax.diagnosis.starts import (
    KEPT_PROMISE,
    SETTLE_STEPS,
    SETTLED,
    Fit,
    follow,
    follow_each,
    measured_anew,
    promised_costs,
    settle,
    settle_anew,
    settle_starts,
    start_step,
)

FITTED = 1e-4
"""Fall of the cost, relative to it, below which a fit has converged."""
STEPS = 24
"""Largest number of Gauss-Newton steps in a row."""
DESCENTS = 2
"""Largest number of times that they are begun: again where initial states sought anew lowered the
cost, or wider differences are needed than were at first."""
SHRINK = 10.0
"""Factor of the damping from a step that is not taken to the next; a tenth after one that is."""
FIRST_SHRUNK = 1.0
"""Damping, relative to what the data say, after the first that is not: half the step."""
STALLED = 4
"""Steps in a row, taken or not, none of which lowers the cost by `LITTLE`, after which a fit with
wider differences has converged, too: initial states promise for ever what jumps do not let them
keep."""
LITTLE = 1e-3
"""Fall of the cost, relative to it."""
MOST_DAMPED = 1e4
"""Damping, relative to what the data say, from which a fit makes no further step."""
SAME = 0.95
"""Cost with initial states sought anew, relative to that before, above which nothing is new."""
WIDE = 0.5
"""Finite difference where none is clear, relative to a parameter's `scale` or size."""
WIDE_STEPS = 4
"""Largest number of Gauss-Newton steps with these."""
SEARCHED = 12
"""Segments with which a search is made at least, evenly chosen; each of its steps settles them."""
SEARCHED_WITHIN = 4.0
"""Cost, relative to another fit's, above which a fit is not worth a search."""
SEARCHED_ABOVE = 1.1
"""Cost, relative to that of noise, up to which a search has nothing to find."""
SEARCH_STEPS = 10
"""Largest number of rounds of a search."""
SEARCH_ON = 0.99
"""Cost that a round reaches, relative to the one before, above which its steps were too long."""
FINEST = 0.1
"""Shortest steps of a search, relative to its first."""
BEATEN = 2.0
"""Cost, relative to another fit's, above which a fit is not worth its last steps."""


def fit(
    problem: Problem,
    theta,
    start,
    free,
    rival: float = np.inf,
    sensitivity: np.ndarray | None = None,
) -> Fit:
    """Fit some parameters within their bounds, and every initial state.

    Parameters see the fitted segments only; the initial states of those held out follow. Where no
    difference is clear of the jumps of contacts, and more is left than noise, a search goes on from
    what Gauss-Newton steps have reached.

    Args:
        problem: What is fitted.
        theta: Where to start, [num_parameters].
        start: Initial states to start from, [S, nq + nv].
        free: Indices of the parameters to fit.
        rival: Cost on the fitted segments that another fit reached; steps that promise no more than
            `BEATEN` times that are not taken; beyond `SEARCHED_WITHIN` times there is no search.
        sensitivity: Derivatives by the initial states from nearby; see `linearise`.
    """
    theta, free = np.array(theta, float), tuple(free)
    if not free:
        return settle(problem, theta, start)
    there = clear_differences(problem, theta, start, free, sensitivity)
    is_stale, descents = sensitivity is not None, 0
    while True:
        near, descents = there, descents + 1
        theta, start, lin = _descend(problem, free, rival, theta, start, near, is_stale)
        start, settled, is_better = _settle_all(problem, theta, start, lin)
        there = _differences_there(problem, theta, start, free, near.relative, settled)
        is_wider = np.any(there.is_clear & (there.relative > near.relative))
        if descents == DESCENTS or not (is_better or is_wider):
            break
        is_stale = True
    lin = there.linearisation
    keep = excited(problem, free, projected(problem, lin)[0])
    cost = np.sum(settled.residual[problem.fitted] ** 2)
    if cost < SEARCHED_WITHIN * rival and not np.all(there.is_clear[keep]):
        settled = settle(problem, theta, start)
        found, lin, keep = _fit_across_contacts(problem, settled, there, free)
        theta, start, settled = found.theta, found.start, lin._replace(start=found.sensitivity)
    low, high = interval(problem, theta, lin, free, keep)
    frozen = tuple(j for j, kept in zip(free, keep, strict=True) if not kept)
    return Fit(theta, free, frozen, start, settled.residual, settled.start, low, high)


def _differences_there(
    problem: Problem, theta, start, free, relative: np.ndarray, settled: Linearisation
) -> Differences:
    """Return the differences at settled initial states, with steps as before where those do."""
    steps = difference_steps(problem, theta, free, relative)
    there = linearise(problem, theta, start, free, steps, settled.start, settled.residual)
    if any(is_erratic(c, problem.num_signals) for c in projected(problem, there)[0].T):
        return clear_differences(problem, theta, start, free, settled.start)
    return Differences(relative, np.ones(len(free), bool), there)


def _settle_all(problem: Problem, theta, start, lin: Linearisation):
    """Settle all initial states at a fit's end; say if those sought anew lowered its cost."""
    start, lin = settle_starts(problem, theta, start, lin, SETTLE_STEPS)
    before = np.sum(lin.residual[problem.fitted] ** 2)
    start, lin = settle_anew(problem, theta, start, lin)
    return start, lin, np.sum(lin.residual[problem.fitted] ** 2) < SAME * before


def wide(problem: Problem, near: Fit, free, relative) -> Linearisation:
    """Measure sensitivities over wide steps, initial states settled at both ends of each.

    Contacts that open or close a step of the engine earlier change what follows by an amount that
    does not shrink with the perturbation; over a wide one these changes average out. What initial
    states do is in these sensitivities already: those to them are 0.
    """
    steps = difference_steps(problem, near.theta, free, relative)
    thetas = np.tile(near.theta, (len(free), 1))
    thetas[np.arange(len(free)), list(free)] += steps
    moved = follow_each(problem, thetas, near)
    columns = [(far.residual - near.residual) / h for far, h in zip(moved, steps, strict=True)]
    nothing = np.zeros_like(near.sensitivity)
    return Linearisation(near.residual, np.stack(columns, -1), nothing)


def _fit_across_contacts(problem: Problem, near: Fit, differences: Differences, free):
    """Search if more is left than noise, and take Gauss-Newton steps with `wide` differences.

    Args:
        problem: What is fitted.
        near: What Gauss-Newton steps have reached, initial states settled.
        differences: Those there; they are kept where they are wider than `WIDE`.
        free: Indices of the parameters to fit.

    Returns:
        The best that was reached, the linearisation there, and which parameters are excited.
    """
    relative = np.maximum(differences.relative, WIDE)
    if _cost(problem, near) > SEARCHED_ABOVE * problem.expected[problem.fitted].sum():
        found = settle(problem, _search(problem, near, free, relative), near.start)
        near = min((near, found), key=partial(_cost, problem))
    stepped = _wide_step(problem, near, free, relative)
    for _ in range(WIDE_STEPS - 1):
        if _cost(problem, stepped[0]) > SEARCH_ON * _cost(problem, near):
            break
        near = stepped[0]
        stepped = _wide_step(problem, near, free, relative)
    return stepped


def _wide_step(problem: Problem, near: Fit, free, relative):
    """Take a Gauss-Newton step with `wide` differences; see `_fit_across_contacts`."""
    lin = wide(problem, near, free, relative)
    change, keep = _parameter_step(problem, near.theta, lin, free, 1e-4)
    theta = near.theta.copy()
    theta[list(free)] += change
    near = min((near, follow(problem, theta, near)), key=partial(_cost, problem))
    return near, lin._replace(residual=near.residual), keep


def _cost(problem: Problem, of: Fit) -> float:
    return float(of.cost[problem.fitted].sum())


def _search(problem: Problem, near: Fit, free, relative) -> np.ndarray:
    """Fit parameters to some of the segments by compass search, initial states settled each time.

    (Kolda, Lewis and Torczon 2003.) No derivative is trusted; steps double and shrink.
    """
    fitted = np.flatnonzero(problem.fitted)
    chosen = fitted[:: max(1, len(fitted) // SEARCHED)]
    problem, near = problem.take(chosen), near.take(chosen)
    steps = difference_steps(problem, near.theta, free, relative)
    steps = np.abs(steps)
    least = FINEST * steps
    ways = np.concatenate([-np.eye(len(free)), np.eye(len(free))])
    for _ in range(SEARCH_STEPS):
        thetas = np.tile(near.theta, (len(ways), 1))
        thetas[:, free] = problem.within_bounds(free, thetas[:, free] + ways * steps)
        trials = follow_each(problem, thetas, near)
        costs = [trial.cost.sum() for trial in trials]
        along = int(np.argmin(costs))
        if costs[along] < SEARCH_ON * near.cost.sum():
            near, steps[along % len(free)] = trials[along], 2.0 * steps[along % len(free)]
        elif np.all(steps <= least):
            break
        else:
            steps *= 0.3
    return near.theta


def _descend(problem: Problem, free, rival: float, theta, start, near: Differences, is_stale: bool):
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

    Returns:
        Parameters, initial states and the linearisation at them.
    """
    damping, undamped, stalled = 1e-4, np.zeros(len(start)), 0
    patience = STALLED if np.any(near.relative > STEP) else STEPS
    lin, is_old = near.linearisation, np.full(len(start), is_stale)
    for taken in range(STEPS):
        change, _ = _parameter_step(problem, theta, lin, free, damping)
        expected = lin.residual + lin.parameters @ change
        start_change = start_step(problem, lin, expected, undamped, 0.0)
        before = np.sum(lin.residual**2, 1)
        promised = before - promised_costs(lin, expected, start_change)
        cost, promise = before[problem.fitted].sum(), promised[problem.fitted].sum()
        if promise < FITTED * cost or damping > MOST_DAMPED or stalled == patience:
            break
        if taken > 1 and cost - promise > BEATEN * rival:
            break
        moved = theta.copy()
        moved[list(free)] += change
        steps = difference_steps(problem, moved, free, near.relative)
        starts = start + start_change * problem.segments.start_unit
        starts, trial = _tried(problem, moved, free, steps, start, starts, lin)
        falls = before - np.sum(trial.residual**2, 1)
        fall = falls[problem.fitted].sum()
        missed = is_old & (promised > SETTLED * before) & (falls < KEPT_PROMISE * promised)
        stalled = 0 if fall > LITTLE * cost else stalled + 1
        if fall > 0:
            theta, start, lin, damping = moved, starts, trial, damping / SHRINK
            is_old = np.ones(len(start), bool)
        elif not np.any(missed & problem.fitted):
            damping = max(damping * SHRINK, FIRST_SHRUNK)
        if np.any(missed):
            lin, is_old = measured_anew(problem, theta, start, lin, missed), is_old & ~missed
    return theta, start, lin


def _tried(problem: Problem, theta, free, steps, stay, move, lin: Linearisation):
    """Linearise where initial states move, or stay in segments that move for the worse.

    Args:
        problem: What is fitted.
        theta: Parameters, [num_parameters].
        free: Indices of the parameters to perturb.
        steps: Their perturbations.
        stay: Initial states before the step, [S, nq + nv].
        move: Those after it.
        lin: The linearisation before the step.

    Returns:
        Initial states, [S, nq + nv], and the linearisation there.
    """
    trial = linearise(problem, theta, move, free, steps, lin.start)
    cost = np.sum(trial.residual**2, 1)
    worse = np.flatnonzero(cost > np.sum(lin.residual**2, 1))
    if not len(worse):
        return move, trial
    some, near = problem.take(worse), lin.start[worse]
    stayed = linearise(some, theta, stay[worse], free, steps, near)
    better = np.sum(stayed.residual**2, 1) < cost[worse]
    chosen, start, residual = worse[better], move.copy(), trial.residual.copy()
    parameters = trial.parameters.copy()
    start[chosen], residual[chosen] = stay[chosen], stayed.residual[better]
    parameters[chosen] = stayed.parameters[better]
    return start, Linearisation(residual, parameters, trial.start)


def excited(problem: Problem, free, sensitivity: np.ndarray) -> np.ndarray:
    """Say which parameters would show within their bounds, [k] bool."""
    width = [
        problem.simulator.slots[j].parameter.high - problem.simulator.slots[j].parameter.low
        for j in free
    ]
    return np.linalg.norm(sensitivity, axis=0) * np.asarray(width) > 3.0


def _parameter_step(problem: Problem, theta, lin: Linearisation, free, damping: float):
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


def interval(problem: Problem, theta, lin: Linearisation, free, keep):
    """Return 95 % intervals: robust, with blocks of time as the independent units."""
    low, high = np.full(len(free), -np.inf), np.full(len(free), np.inf)
    if not np.any(keep):
        return low, high
    covariance, sure = uncertainty(problem, lin, keep)
    half = sure * np.sqrt(np.diag(covariance))
    centre = theta[np.asarray(free)[keep]]
    low[keep], high[keep] = centre - half, centre + half
    return low, high


def uncertainty(problem: Problem, lin: Linearisation, keep) -> tuple[np.ndarray, float]:
    """Return the covariance of the excited parameters, and standard deviations in a half-width."""
    sensitivity, residual = projected(problem, lin)
    labels = block_labels(problem)[problem.fitted].ravel()
    found = regress(sensitivity[:, keep], residual, labels)
    return found.covariance, float(stats.t.ppf(0.975, found.freedom))
