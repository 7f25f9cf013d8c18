"""Fit parameters by Gauss-Newton with the initial state of every segment eliminated."""

import dataclasses
from functools import partial

import numpy as np
from scipy import stats

from garat_jax.diagnosis.descend import CONVERGED, FITTED, descend, excited, parameter_step
from garat_jax.diagnosis.differences import (
    STEP,
    Differences,
    clear_differences,
    difference_steps,
    is_erratic,
    projected,
)
from garat_jax.diagnosis.problem import (
    Linearisation,
    Problem,
    block_labels,
    block_stretches,
    linearise,
)
from garat_jax.diagnosis.robust import jackknife
from garat_jax.diagnosis.starts import (
    SETTLE_STEPS,
    Fit,
    follow,
    follow_each,
    settle,
    settle_anew,
    settle_starts,
)

DESCENTS = 2
"""Largest number of times that they are begun: again where initial states sought anew lowered the
cost, wider differences are needed than were at first, or ones measured anew promise more."""
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


def fit(
    problem: Problem,
    theta,
    start,
    free,
    rival: float = np.inf,
    sensitivity: np.ndarray | None = None,
    searches: bool = True,
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
        searches: Whether a search may go on; not needed from near the minimum.
    """
    theta, free = np.array(theta, float), tuple(free)
    if not free:
        return settle(problem, theta, start)
    there = clear_differences(problem, theta, start, free, sensitivity)
    is_stale, descents = sensitivity is not None, 0
    while True:
        near, descents = there, descents + 1
        theta, start, lin = descend(problem, free, rival, theta, start, near, is_stale)
        start, settled, is_better = _settle_all(problem, theta, start, lin)
        there = _differences_there(problem, theta, start, free, near.relative, settled)
        is_wider = np.any(there.is_clear & (there.relative > near.relative))
        goes_on = is_better or is_wider or promises_more(problem, theta, there, free)
        if descents == DESCENTS or not goes_on:
            break
        is_stale = True
    lin = there.linearisation
    keep = excited(problem, free, projected(problem, lin)[0])
    cost = np.sum(settled.residual[problem.fitted] ** 2)
    if cost < SEARCHED_WITHIN * rival and not np.all(there.is_clear[keep]):
        settled = settle(problem, theta, start)
        found, lin, keep = _fit_across_contacts(problem, settled, there, free, searches)
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


def converge(problem: Problem, fitted: Fit, differences: Differences) -> tuple[Fit, Linearisation]:
    """Take a fit's last steps, that change it by less than noise, and return what it is then.

    Args:
        problem: What is fitted.
        fitted: The fit.
        differences: Those at it, none across jumps.

    Returns:
        The fit, its intervals as they were, and the linearisation there.
    """
    free, theta, start = fitted.free, fitted.theta, fitted.start
    theta, start, lin = descend(problem, free, np.inf, theta, start, differences, False, CONVERGED)
    moved = {"theta": theta, "start": start, "residual": lin.residual, "sensitivity": lin.start}
    return dataclasses.replace(fitted, **moved), lin


def promises_more(problem: Problem, theta, there: Differences, free) -> bool:
    """Say whether, with derivatives measured anew, a fit's end promises a lower cost.

    Derivatives by the initial states that were kept from elsewhere may see none. Across jumps, all
    promise more than is kept.
    """
    if np.any(there.relative > STEP):
        return False
    sensitivity, residual = projected(problem, there.linearisation)
    change, _ = parameter_step(problem, theta, there.linearisation, free, 1e-4)
    before = np.sum(residual**2)
    return bool(before - np.sum((residual + sensitivity @ change) ** 2) > FITTED * before)


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


def _fit_across_contacts(problem: Problem, near: Fit, differences: Differences, free, searches):
    """Search if more is left than noise, and take Gauss-Newton steps with `wide` differences.

    Args:
        problem: What is fitted.
        near: What Gauss-Newton steps have reached, initial states settled.
        differences: Those there; they are kept where they are wider than `WIDE`.
        free: Indices of the parameters to fit.
        searches: Whether to search.

    Returns:
        The best that was reached, the linearisation there, and which parameters are excited.
    """
    relative = np.maximum(differences.relative, WIDE)
    if searches and _cost(problem, near) > SEARCHED_ABOVE * problem.expected[problem.fitted].sum():
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
    change, keep = parameter_step(problem, near.theta, lin, free, 1e-4)
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


def interval(problem: Problem, theta, lin: Linearisation, free, keep):
    """Return 95 % intervals: robust, where errors last within blocks of time and beyond."""
    low, high = np.full(len(free), -np.inf), np.full(len(free), np.inf)
    if not np.any(keep) or not are_determined(problem, keep):
        return low, high
    covariance, sure = uncertainty(problem, lin, keep)
    half = sure * np.sqrt(np.diag(covariance))
    centre = theta[np.asarray(free)[keep]]
    low[keep], high[keep] = centre - half, centre + half
    return low, high


def are_determined(problem: Problem, keep) -> bool:
    """Say whether there are more blocks of time than excited parameters: else nothing is left."""
    return len(np.unique(block_labels(problem)[problem.fitted])) > np.sum(keep)


def uncertainty(problem: Problem, lin: Linearisation, keep) -> tuple[np.ndarray, float]:
    """Return the covariance of the excited parameters, and standard deviations in a half-width."""
    sensitivity, residual = projected(problem, lin)
    labels = block_labels(problem)[problem.fitted].ravel()
    found = jackknife(sensitivity[:, keep], residual, labels, block_stretches(problem))
    return found.covariance, float(stats.t.ppf(0.975, found.freedom))
