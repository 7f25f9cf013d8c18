"""The minimum of a cost that contacts make rough, and how sure it is.

Where the cost jumps from one set of parameters to the next, a fit ends in the deepest dip that it
met. A quadratic through the costs around it (Box and Wilson 1951) is what all of them say, and the
next one, around its minimum, if that is surely not near.
"""

import numpy as np
from scipy import stats

from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.starts import Fit, follow, follow_each

OFFSETS = (-2.0, -1.5, -1.0, 1.0, 1.5, 2.0)
"""Where the cost is measured along each axis, at first half-widths of a 95 % interval, relative to
its length; not in the dip itself."""
WIDENED = 2
"""How often axes along which the cost shows no curvature are doubled, at most, for all surfaces."""
MOVES = 4
"""Largest number of surfaces, each around the minimum of the one before."""
NEAR = 1.0
"""Farthest minimum, relative to its axis, that a surface tells; beyond, if that is sure, it says
where to look."""
CURVED = 3.0
"""Standard errors by which a curvature shows."""


def smooth_minimum(
    problem: Problem,
    fitted: Fit,
    columns: np.ndarray,
    covariance: np.ndarray,
    sure: float,
    moves: int = MOVES,
) -> tuple[Fit, np.ndarray]:
    """Move a fit to the minimum of a smooth surface through the costs around it.

    Args:
        problem: What is fitted.
        fitted: Where the fit ended.
        columns: Indices of the parameters that are excited, k of them.
        covariance: Theirs, as noise alone makes it, [k, k].
        sure: Half-width of a 95 % interval in standard deviations.
        moves: Largest number of surfaces.

    Returns:
        The fit there, initial states settled, and how far its parameters may be from there for the
        roughness, half the width of 95 % intervals, [k].
    """
    some = np.flatnonzero(problem.fitted)
    half = sure * np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(half, half) * sure**2
    share, ways = np.linalg.eigh(correlation)
    axes = half[:, None] * ways * np.sqrt(np.maximum(share, 1e-6))
    doublings = WIDENED
    while True:
        near = problem.take(some), fitted.take(some)
        axes, doublings, move, unsure = _move(*near, columns, axes, doublings)
        theta = fitted.theta.copy()
        theta[columns] = problem.within_bounds(columns, theta[columns] + axes @ move)
        fitted, by = follow(problem, theta, fitted), (theta - fitted.theta)[columns]
        along, moves = np.abs(np.linalg.solve(axes, by)), moves - 1
        is_far = np.any((along > NEAR) & (along > unsure))
        if not is_far or not moves:
            rough = np.sqrt(np.sum((axes * unsure) ** 2, axis=1))
            return fitted, np.hypot(rough, by) if is_far else rough


def _move(problem: Problem, fitted: Fit, columns: np.ndarray, axes: np.ndarray, doublings: int):
    """Return how far a surface's minimum is from a fit, and how far it may be from there.

    Axes along which no curvature shows are doubled, so many times at most.

    Returns:
        The axes [k, k], how often they may be doubled yet, and both distances, [k] each, relative
        to the axes.
    """
    num_axes = len(columns)
    places = np.empty((len(OFFSETS) * num_axes, num_axes))
    costs, flat = np.empty((len(places), len(fitted.start))), np.ones(num_axes, bool)
    while True:
        rows = np.repeat(flat, len(OFFSETS))
        places[rows], costs[rows] = _around(problem, fitted, columns, axes[:, flat])
        at = np.linalg.solve(axes, places.T).T
        move, unsure, is_curved = _minimum(at, _together(costs, problem.expected))
        if not doublings or np.all(is_curved):
            return axes, doublings, move, unsure
        doublings, flat = doublings - 1, ~is_curved
        axes = np.where(flat, 2.0, 1.0) * axes


def _around(problem: Problem, fitted: Fit, columns: np.ndarray, axes: np.ndarray):
    """Return places along some axes [k, m], as changes of the parameters [n, k], and costs [n, S].

    These are of each segment.
    """
    steps = np.concatenate([np.outer(OFFSETS, axis) for axis in axes.T])
    here = fitted.theta[columns]
    values = problem.within_bounds(columns, here + steps)
    thetas = np.tile(fitted.theta, (len(values), 1))
    thetas[:, columns] = values
    return values - here, np.stack([fit.cost for fit in follow_each(problem, thetas, fitted)])


def _together(costs: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Add up the costs of segments at some places, [n, S], so that none outvotes the others, [n].

    One whose initial state was not found, on the wrong side of a contact, leaves many times what
    the others do, and another amount at each place. Beyond what is usual a cost therefore counts by
    its logarithm (Lorentzian; Cauchy's distribution).

    Args:
        costs: Of each segment at each place.
        expected: What noise makes of them, [S].
    """
    told = expected > 0
    share = costs[:, told] / expected[told]
    usual = max(1.0, float(np.median(share)))
    return np.sum(expected[told] * usual * np.log1p(share / usual), axis=1)


def _minimum(at: np.ndarray, costs: np.ndarray):
    """Return where a quadratic without cross terms is least, in how far that is sure, and if it is.

    Returns:
        The minimum, [k], no farther than the places are; half the width of its 95 % interval, [k];
        and whether the curvature along each axis shows, [k] bool.
    """
    num, size = len(costs), at.shape[1]
    design = np.concatenate([np.ones((num, 1)), at, at**2], axis=1)
    inverse = np.linalg.pinv(design.T @ design)
    factor = inverse @ (design.T @ costs)
    freedom = max(num - design.shape[1], 1)
    variance = np.sum((costs - design @ factor) ** 2) / freedom * inverse
    slope, bend = factor[1 : 1 + size], factor[1 + size :]
    of_slope, of_bend = np.split(np.diag(variance)[1:], 2)
    is_curved = bend > CURVED * np.sqrt(of_bend)
    farthest = np.max(np.abs(at), axis=0)
    bend = np.where(is_curved, bend, np.inf)
    move = np.clip(-0.5 * slope / bend, -farthest, farthest)
    error = np.sqrt(of_slope / 4.0 + move**2 * of_bend) / bend
    unsure = stats.t.ppf(0.975, freedom) * error
    return move, np.where(is_curved, np.minimum(unsure, farthest), farthest), is_curved
