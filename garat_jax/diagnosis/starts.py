"""Initial states of segments at fixed parameters, by damped Gauss-Newton steps of their own."""

import dataclasses

import numpy as np

from garat_jax.diagnosis.problem import LARGE, Linearisation, Problem, linearise
from garat_jax.diagnosis.sensing import as_they_are, displacement

SETTLED = 1e-3
"""Fall of a segment's cost, relative to it, below which its initial state is left as it is."""
SETTLE_STEPS = 10
"""Steps of the initial states after a fit, whose own steps have moved them already."""
KEPT_PROMISE = 0.5
"""Fall of the cost, relative to the promised one, below which sensitivities are measured again."""
HELD = 30.0
"""Measurements that hold a component of an initial state where it is, in each step of settling: one
that soon says nothing, as the height of a foot on the ground, is not to follow the noise of its
first samples into a hop."""
TOGETHER = 256
"""Simulations that settle in one batch, at most: their sensitivities are in memory."""
POOR = 1.3
"""Cost of a segment, relative to that of noise, above which its initial state is sought anew."""
SMOOTH = 0.3
"""How far the change of the residual towards another initial state is from that which sensitivities
promise, relative to it, below which both lead to the same settled state."""


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
        low: Lower ends of the free parameters' 95 % intervals, at the model's own timestep; see
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

    def take(self, chosen: np.ndarray) -> "Fit":
        """Return the fit of some of the segments."""
        parts = {name: getattr(self, name)[chosen] for name in ("start", "residual", "sensitivity")}
        return dataclasses.replace(self, **parts)

    @property
    def cost(self) -> np.ndarray:
        """Sum of squares of each segment, [S]."""
        return np.sum(self.residual**2, axis=1)


def settle(
    problem: Problem, theta: np.ndarray, start: np.ndarray | None = None, iterations: int = 8
) -> Fit:
    """Estimate the initial state of every segment at fixed parameters.

    Each segment has a damping of its own and is done when its linearisation promises no fall of
    its cost that matters; a step that was rejected is tried again, shorter.

    Args:
        problem: What is fitted.
        theta: All parameters, [num_parameters].
        start: Where to begin, [S, nq + nv]; None: where the sensors report what was measured.
        iterations: Steps at most.
    """
    if start is None:
        start, lin = as_measured(problem, theta)
    else:
        lin = linearise(problem, theta, start, (), ())
    start, lin = settle_starts(problem, theta, start, lin, iterations)
    start, lin = settle_anew(problem, theta, start, lin)
    nothing = np.zeros(0)
    return Fit(theta, (), (), start, lin.residual, lin.start, nothing, nothing)


def as_measured(problem: Problem, theta: np.ndarray) -> tuple[np.ndarray, Linearisation]:
    """Return initial states whose sensors report what was measured, and the linearisation there."""
    segments = problem.segments
    lin = linearise(problem, theta, segments.start, (), ())

    def report(start):
        return problem.simulator.predict(theta[None], start[None], segments)[0, :, 0]

    first = _reported(problem, segments.start, lin.residual)
    start = as_they_are(segments.start, first, report, segments.start_unit)
    return start, lin if start is segments.start else linearise(problem, theta, start, (), ())


def _reported(problem: Problem, start: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Return what sensors report of initial states, [S, num_signals]; these where it is unknown."""
    first = residual.reshape(problem.segments.measured.shape)[:, 0]
    is_told = (problem.scale[:, 0] > 0) & (np.abs(first) < LARGE)
    return np.where(is_told, problem.unwhiten(residual)[:, 0], start[:, : first.shape[1]])


def settle_twice(problem: Problem, found: Fit) -> Fit:
    """Settle from what was measured, too; of each segment the better counts.

    A fit has followed its initial states from one set of parameters to the next, in contact past
    places from where no small step leads on.
    """
    fresh = settle(problem, found.theta)
    better = fresh.cost < found.cost
    return dataclasses.replace(
        found,
        start=np.where(better[:, None], fresh.start, found.start),
        residual=np.where(better[:, None], fresh.residual, found.residual),
        sensitivity=np.where(better[:, None, None], fresh.sensitivity, found.sensitivity),
    )


def follow(problem: Problem, theta, near: Fit) -> Fit:
    """Settle the initial states at parameters near those of a fit, with its sensitivities."""
    lin = linearise(problem, theta, near.start, (), (), near.sensitivity)
    start, lin = settle_starts(problem, theta, near.start, lin, SETTLE_STEPS)
    return dataclasses.replace(
        near, theta=theta, start=start, residual=lin.residual, sensitivity=lin.start
    )


def follow_each(problem: Problem, thetas: np.ndarray, near: Fit) -> list[Fit]:
    """Settle the initial states at each of many parameters [K, num_parameters], in batches.

    A call of C MuJoCo costs more than a few segments' step in it.
    """
    num = len(near.start)
    at_once = max(1, TOGETHER // num)
    found = []
    for some in np.split(thetas, range(at_once, len(thetas), at_once)):
        every = np.tile(np.arange(num), len(some))
        fits = follow(problem.take(every), np.repeat(some, num, axis=0), near.take(every))
        parts = np.split(np.arange(len(every)), len(some))
        found += [
            dataclasses.replace(fits.take(part), theta=theta)
            for theta, part in zip(some, parts, strict=True)
        ]
    return found


def settle_anew(problem: Problem, theta, start: np.ndarray, lin: Linearisation):
    """Settle segments with much residual again, from where the segment before ends.

    Noise may lift a foot off the ground or push it in, and another model's initial states may make
    it hop, from where no small step leads back. What is reached anew counts where it is better.
    """
    poor = np.flatnonzero(np.sum(lin.residual**2, axis=1) > POOR * problem.expected)
    if not len(poor):
        return start, lin
    carried = _carried(problem, start, lin.residual)
    poor = poor[_is_beyond_sensitivity(problem, theta, start, lin, carried, poor)]
    if not len(poor):
        return start, lin
    some, carried = problem.take(poor), carried[poor]
    fresh = linearise(some, theta, carried, (), ())
    carried, fresh = settle_starts(some, theta, carried, fresh, SETTLE_STEPS)
    better = np.sum(fresh.residual**2, axis=1) < np.sum(lin.residual[poor] ** 2, axis=1)
    chosen = poor[better]
    start, residual, sensitivity = start.copy(), lin.residual.copy(), lin.start.copy()
    start[chosen], residual[chosen] = carried[better], fresh.residual[better]
    sensitivity[chosen] = fresh.start[better]
    return start, lin._replace(residual=residual, start=sensitivity)


def _is_beyond_sensitivity(
    problem: Problem, theta, start: np.ndarray, lin: Linearisation, other: np.ndarray, chosen
) -> np.ndarray:
    """Say of chosen segments [C] whether sensitivities fail to promise what another start does."""
    sensitivity, change = lin.start[chosen], (other - start)[chosen] / problem.segments.start_unit
    promised = np.einsum("sni,si->sn", sensitivity, change)
    there = linearise(problem.take(chosen), theta, other[chosen], (), (), sensitivity)
    found = there.residual - lin.residual[chosen]
    gap = np.sum((found - promised) ** 2, axis=1)
    return gap > SMOOTH**2 * np.sum(promised**2, axis=1)


def _carried(problem: Problem, start: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Return where the preceding segments end, or what was measured, as it is, [S, nq + nv].

    Of some segments, only those present count; where one diverged, what follows was measured.
    """
    predicted, segments = problem.unwhiten(residual), problem.segments
    carried, reported = segments.start.copy(), _reported(problem, start, residual)
    displaced = displacement(start, reported, segments.start_unit)
    carried[:, : displaced.shape[1]] += displaced
    count = np.count_nonzero(segments.weight, axis=1)
    place = {at: i for i, at in enumerate(zip(segments.recording, segments.first, strict=True))}
    for number, signals in enumerate(predicted):
        after = place.get((segments.recording[number], segments.first[number] + count[number]))
        diverged = np.abs(residual[number]).max() >= LARGE
        if after is not None and count[number] > 1 and not diverged:
            last, before = signals[count[number] - 1], signals[count[number] - 2]
            carried[after] = start[after]
            carried[after, : len(last)] = 2.0 * last - before + displaced[after]
    return carried


def settle_starts(problem: Problem, theta, start, lin: Linearisation, iterations: int):
    """Return settled initial states and the linearisation at them, from one that is near.

    Parameters are [num_parameters], or each segment's, [S, num_parameters].
    """
    lin = lin._replace(parameters=lin.parameters[..., :0])
    damping, is_stale = np.full(len(start), 1e-6), np.ones(len(start), bool)
    for _ in range(iterations):
        change = start_step(problem, lin, lin.residual, damping, HELD)
        before = np.sum(lin.residual**2, 1)
        promised = before - promised_costs(lin, lin.residual, change)
        is_open = promised >= SETTLED * before
        if not np.any(is_open):
            break
        starts = start + np.where(is_open[:, None], change, 0.0) * problem.segments.start_unit
        trial = _linearised_again(problem, theta, starts, lin, is_open)
        fall = before - np.sum(trial.residual**2, 1)
        better = fall > 0
        start = np.where(better[:, None], starts, start)
        lin = choose(better, trial, lin)
        later = np.where(is_stale, damping, np.maximum(damping, 1e-5) * 100.0)
        damping = np.where(better, damping * 0.1, later)
        again = is_open & (is_stale | better) & (fall < KEPT_PROMISE * promised)
        if np.any(again):
            lin = measured_anew(problem, theta, start, lin, again)
        is_stale = np.where(again, False, is_stale | better)
    return start, lin


def _own(theta, chosen) -> np.ndarray:
    """Return the parameters of some segments, where each has its own."""
    return theta[chosen] if np.ndim(theta) > 1 else theta


def _linearised_again(problem: Problem, theta, start, lin: Linearisation, chosen) -> Linearisation:
    """Return a linearisation with the residual of some segments at other initial states."""
    own, near = _own(theta, chosen), lin.start[chosen]
    residual = lin.residual.copy()
    moved = linearise(problem.take(chosen), own, start[chosen], (), (), near)
    residual[chosen] = moved.residual
    return lin._replace(residual=residual)


def measured_anew(problem: Problem, theta, start, lin: Linearisation, chosen) -> Linearisation:
    """Return a linearisation with the derivatives by some segments' initial states as they are now.

    Args:
        problem: What is fitted.
        theta: Parameters, [num_parameters] or, each segment its own, [S, num_parameters].
        start: Initial states, [S, nq + nv].
        lin: The linearisation there.
        chosen: Which segments, [S] bool.
    """
    some = problem.take(chosen)
    fresh = linearise(
        some, _own(theta, chosen), start[chosen], (), (), residual=lin.residual[chosen]
    )
    sensitivity = lin.start.copy()
    sensitivity[chosen] = fresh.start
    return lin._replace(start=sensitivity)


def promised_costs(lin: Linearisation, residual: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Return each segment's cost [S] if the initial states' effect on the residual were linear."""
    return np.sum((residual + np.einsum("sni,si->sn", lin.start, change)) ** 2, axis=1)


def choose(which: np.ndarray, new: Linearisation, old: Linearisation) -> Linearisation:
    """Take the segments `which` [S] from one linearisation and the others from another."""
    return Linearisation(
        np.where(which[:, None], new.residual, old.residual),
        np.where(which[:, None, None], new.parameters, old.parameters),
        np.where(which[:, None, None], new.start, old.start),
    )


def start_step(
    problem: Problem, lin: Linearisation, residual: np.ndarray, damping: np.ndarray, held: float
) -> np.ndarray:
    """Return damped Gauss-Newton changes of the initial states [S, nq + nv], in their units.

    Args:
        problem: What is fitted.
        lin: Its linearisation.
        residual: [S, N].
        damping: Of each segment, relative to what it says, [S].
        held: Measurements that hold every component where it is.
    """
    normal = np.swapaxes(lin.start, 1, 2) @ lin.start
    gradient = np.einsum("sni,sn->si", lin.start, residual)
    diagonal = np.einsum("sii->si", normal)
    floor = np.zeros_like(diagonal) + 1e-12 * diagonal.max(axis=1, keepdims=True) + 1e-300
    noise = problem.segments.noise
    floor[:, : len(noise)] += held * (problem.segments.start_unit[: len(noise)] / noise) ** 2
    ridge = np.maximum(damping, 1e-12)[:, None] * diagonal + floor
    normal = normal + ridge[:, :, None] * np.eye(normal.shape[1])
    return -np.linalg.solve(normal, gradient[..., None])[..., 0]
