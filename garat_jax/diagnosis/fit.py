"""Fit parameters by Gauss-Newton with the initial state of every segment eliminated.

Residuals are prediction minus measurement, in units of each signal's noise. Sensitivities to the
parameters and to the initial states come from the same batched simulation; the initial states
leave the normal equations by projection (variable projection, Golub and Pereyra 1973).
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from scipy import optimize, stats

from garat_jax.diagnosis.segments import Segments, nearby_starts
from garat_jax.diagnosis.simulate import Simulator

BLOCK = 0.25
"""Seconds of the shortest block within which errors may be correlated, in robust variances."""
STEP = 1e-2
"""Finite difference of a fit, relative to a parameter's `scale` or size."""
START_STEP = 1e-4
"""Finite difference of an initial state, relative to its spread."""
UNEXCITED = 1e-6
"""Sensitivity, relative to the residual's size at the bounds, below which a direction is frozen."""
FITTED = 1e-4
"""Fall of the cost, relative to it, below which a fit has converged."""
SETTLED = 1e-3
"""Fall of a segment's cost, relative to it, below which its initial state is left as it is."""
SETTLE_STEPS = 4
"""Steps of the initial states after a fit, whose own steps have moved them already."""
LARGE = 1e8
"""Whitened residual that stands for a simulation that diverged."""


@dataclasses.dataclass(frozen=True)
class Problem:
    """What is fitted to what.

    Attributes:
        simulator: The model with all candidates.
        finer: The same with half the physics timestep.
        segments: All segments, those held out among them.
        fitted: Which segments the parameters may see, [S] bool.
        interval: Seconds between samples.
    """

    simulator: Simulator
    finer: Simulator
    segments: Segments
    fitted: np.ndarray
    interval: float

    def take(self, chosen: np.ndarray) -> "Problem":
        """Return the problem of some of the segments."""
        segments = self.segments.take(chosen)
        return dataclasses.replace(self, segments=segments, fitted=self.fitted[chosen])

    def whiten(self, predicted: np.ndarray) -> np.ndarray:
        """Return whitened residuals [..., S, N] of predictions [..., S, L, num_signals]."""
        s = self.segments
        residual = (predicted - s.measured) * (s.weight[..., None] / s.noise)
        residual = np.where(np.isfinite(residual), residual, LARGE)
        return np.clip(residual, -LARGE, LARGE).reshape(*residual.shape[:-2], -1)

    def whiten_change(self, change: np.ndarray) -> np.ndarray:
        """Return changes of predictions [..., S, L, num_signals], whitened, [..., S, N]."""
        s = self.segments
        change = change * (s.weight[..., None] / s.noise)
        change = np.where(np.isfinite(change), change, 0.0)
        return np.clip(change, -LARGE, LARGE).reshape(*change.shape[:-2], -1)

    def integrator_error(
        self, theta: np.ndarray, start: np.ndarray, residual: np.ndarray
    ) -> np.ndarray:
        """Return the change of the residuals [S, N] on halving the physics timestep.

        A first-order integrator's error is twice this change.
        """
        fine = self.finer.predict(theta[None], start[None], self.segments)
        return self.whiten(fine)[0] - residual

    def blocks(self) -> np.ndarray:
        """Return each whitened residual's block within its segment, [N]."""
        num_samples, num_signals = self.segments.measured.shape[1:]
        size = max(1, round(BLOCK / self.interval))
        count = max(1, num_samples // size)
        block = np.minimum(np.arange(num_samples) * count // num_samples, count - 1)
        return np.repeat(block, num_signals)


class Linearisation(NamedTuple):
    """Residuals and sensitivities at one point.

    Attributes:
        residual: [S, N].
        parameters: Derivatives by the free parameters, [S, N, num_free].
        start: Derivatives by the initial state's components, in units of `start_unit`,
            [S, N, nq + nv].
        start_unit: [nq + nv].
    """

    residual: np.ndarray
    parameters: np.ndarray
    start: np.ndarray
    start_unit: np.ndarray


@dataclasses.dataclass(frozen=True)
class Fit:
    """Parameters, initial states and what is left of the residual.

    Attributes:
        theta: All parameters, [num_parameters].
        free: Indices of those that were fitted.
        frozen: Indices that the data do not excite; they kept their values.
        start: Initial states, [S, nq + nv].
        residual: Whitened, [S, N].
        low: Lower ends of the free parameters' 95 % intervals.
        high: Upper ends.
    """

    theta: np.ndarray
    free: tuple[int, ...]
    frozen: tuple[int, ...]
    start: np.ndarray
    residual: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @property
    def cost(self) -> np.ndarray:
        """Sum of squares of each segment, [S]."""
        return np.sum(self.residual**2, axis=1)


def linearise(problem: Problem, theta, start, columns, steps) -> Linearisation:
    """Simulate the point and one perturbation a column and a component of the initial state.

    Args:
        problem: What is fitted.
        theta: All parameters, [num_parameters].
        start: Initial states, [S, nq + nv].
        columns: Indices of the parameters to perturb.
        steps: Their perturbations.
    """
    unit = nearby_starts(problem.segments, 1.0)
    num_start = len(unit)
    thetas = np.tile(theta, (1 + len(columns) + num_start, 1))
    thetas[1 + np.arange(len(columns)), list(columns)] += steps
    starts = np.tile(start, (len(thetas), 1, 1))
    for i in range(num_start):
        starts[1 + len(columns) + i, :, i] += START_STEP * unit[i]
    residuals = problem.whiten(problem.simulator.predict(thetas, starts, problem.segments))
    changes = np.moveaxis(residuals[1:] - residuals[0], 0, -1)
    parameters = changes[..., : len(columns)] / np.asarray(steps, float)
    return Linearisation(residuals[0], parameters, changes[..., len(columns) :] / START_STEP, unit)


class StartSpace:
    """The residuals that initial states can make, orthonormal within each segment.

    Attributes:
        basis: [S, N, nq + nv]; zero where a direction is not excited.
    """

    def __init__(self, sensitivity: np.ndarray):
        scale = np.linalg.norm(sensitivity, axis=1, keepdims=True)
        u, s, _ = np.linalg.svd(sensitivity / np.maximum(scale, 1e-300), full_matrices=False)
        self.basis = u * (s > 1e-9 * s.max(axis=1, keepdims=True))[:, None, :]

    def remove(self, columns: np.ndarray) -> np.ndarray:
        """Project columns [S, N, k] onto what no initial state can make."""
        return columns - self.basis @ (np.swapaxes(self.basis, 1, 2) @ columns)


def difference_steps(problem: Problem, theta: np.ndarray, columns, relative: float) -> np.ndarray:
    """Return finite differences for some parameters that stay within their bounds."""
    steps = []
    for j in columns:
        p = problem.simulator.slots[j].parameter
        size = relative * max(p.scale, 0.1 * min(abs(theta[j] - p.nominal), abs(theta[j])))
        steps.append(size if theta[j] + size <= p.high else -size)
    return np.asarray(steps)


def settle(problem: Problem, theta: np.ndarray, start: np.ndarray, iterations: int = 8) -> Fit:
    """Estimate the initial state of every segment at fixed parameters.

    Each segment has a damping of its own and is done when its linearisation promises no fall of
    its cost that matters; a step that was rejected is tried again, shorter.
    """
    lin = linearise(problem, theta, start, (), ())
    damping = np.full(len(start), 1e-6)
    for _ in range(iterations):
        change = _start_step(lin, lin.residual, damping)
        before = np.sum(lin.residual**2, 1)
        if np.all(before - _promised(lin, lin.residual, change) < SETTLED * before):
            break
        starts = start + change * lin.start_unit
        trial = linearise(problem, theta, starts, (), ())
        better = np.sum(trial.residual**2, 1) < before
        start = np.where(better[:, None], starts, start)
        lin = _choose(better, trial, lin)
        damping = np.where(better, damping * 0.1, np.maximum(damping, 1e-5) * 100.0)
    nothing = np.zeros(0)
    return Fit(theta, (), (), start, lin.residual, nothing, nothing)


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


def fit(problem: Problem, theta, start, free, iterations: int = 12) -> Fit:
    """Fit some parameters within their bounds, and every initial state.

    Parameters see the fitted segments only. The initial states of those held out follow as long as
    that lowers their own cost, and are settled at the end.

    Args:
        problem: What is fitted.
        theta: Where to start, [num_parameters].
        start: Initial states to start from, [S, nq + nv].
        free: Indices of the parameters to fit.
        iterations: Largest number of Gauss-Newton steps.
    """
    theta, free = np.array(theta, float), tuple(free)
    damping, undamped = 1e-4, np.zeros(len(start))
    lin = linearise(problem, theta, start, free, difference_steps(problem, theta, free, STEP))
    keep = np.ones(len(free), bool)
    for _ in range(iterations):
        change, keep = _parameter_step(problem, theta, lin, free, damping)
        expected = lin.residual + lin.parameters @ change
        start_change = _start_step(lin, expected, undamped)
        before = np.sum(lin.residual[problem.fitted] ** 2)
        promised = _promised(lin, expected, start_change)[problem.fitted].sum()
        if before - promised < FITTED * before or damping > 1e8:
            break
        starts = start + start_change * lin.start_unit
        trial_theta = theta.copy()
        trial_theta[list(free)] += change
        steps = difference_steps(problem, trial_theta, free, STEP)
        trial = linearise(problem, trial_theta, starts, free, steps)
        if np.sum(trial.residual[problem.fitted] ** 2) < before:
            follows = np.sum(trial.residual**2, 1) < np.sum(lin.residual**2, 1)
            moved = problem.fitted | follows
            start = np.where(moved[:, None], starts, start)
            theta, lin, damping = trial_theta, _choose(moved, trial, lin), damping * 0.1
        else:
            damping = max(damping, 1e-3) * 30.0
    low, high = _interval(problem, theta, start, lin, free, keep)
    settled = settle(problem, theta, start, SETTLE_STEPS)
    frozen = tuple(j for j, kept in zip(free, keep, strict=True) if not kept)
    return Fit(theta, free, frozen, settled.start, settled.residual, low, high)


def _projected(problem: Problem, lin: Linearisation) -> tuple[np.ndarray, np.ndarray]:
    """Return the fitted segments' sensitivities [M, k] and residual [M], initial states removed."""
    both = np.concatenate([lin.parameters, lin.residual[..., None]], axis=2)[problem.fitted]
    rest = StartSpace(lin.start[problem.fitted]).remove(both)
    rest = rest.reshape(rest.shape[0] * rest.shape[1], rest.shape[2])
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


def _interval(problem: Problem, theta, start, lin: Linearisation, free, keep):
    """Return 95 % intervals: robust, with blocks of time as the independent units.

    They are widened by the shift that a timestep of zero would give the estimate, for it is fitted
    at the model's own.
    """
    low, high = np.full(len(free), -np.inf), np.full(len(free), np.inf)
    if not np.any(keep):
        return low, high
    sensitivity, residual = _projected(problem, lin)
    sensitivity = sensitivity[:, keep]
    labels = block_labels(problem)[problem.fitted].ravel()
    unit = np.linalg.norm(sensitivity, axis=0)
    scores = np.stack(
        [np.bincount(labels, column * residual) for column in (sensitivity / unit).T], axis=1
    )
    bread = np.linalg.pinv((sensitivity / unit).T @ (sensitivity / unit))
    num_blocks, num_free = len(np.unique(labels)), len(unit)
    correction = num_blocks / max(num_blocks - num_free, 1)
    covariance = bread @ (scores.T @ scores) @ bread * correction
    half = stats.t.ppf(0.975, max(num_blocks - num_free, 1)) * np.sqrt(np.diag(covariance)) / unit
    change = 2.0 * problem.integrator_error(theta, start, lin.residual)[..., None]
    shifted = _projected(problem, lin._replace(residual=change[..., 0]))[1]
    shift = -bread @ ((sensitivity / unit).T @ shifted) / unit
    centre = theta[np.asarray(free)[keep]]
    low[keep] = centre - half + np.minimum(shift, 0.0)
    high[keep] = centre + half + np.maximum(shift, 0.0)
    return low, high


def block_labels(problem: Problem) -> np.ndarray:
    """Return a number for each block of each segment, per whitened residual, [S, N]."""
    blocks = problem.blocks()
    return np.arange(len(problem.fitted))[:, None] * (blocks.max() + 1) + blocks
