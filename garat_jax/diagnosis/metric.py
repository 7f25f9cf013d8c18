"""The error that a diagnosis reports, and the floor that noise and the integrator set it."""

import dataclasses
import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from garat_jax.diagnosis.problem import AnyProblem, Problem, StartSpace
from garat_jax.diagnosis.segments import metric_spread
from garat_jax.diagnosis.starts import Fit
from garat_jax.effects.contact import can_any_touch

ABOVE_FLOOR = 1.5
"""A model is adequate up to this multiple of the noise floor."""
AT_FLOOR = 1.1
"""Multiple of the noise floor up to which a fit leaves nothing for another law to explain."""
TRUSTED = 3.0
"""Standard deviations of noise that the timestep's error may reach before a sample counts less."""
TOO_COARSE = 1.0 / ABOVE_FLOOR
"""Integrator's error, relative to the signals' spread, above which a model that is as bad as always
predicting the mean would be near the floor."""
UNEXPLAINED = 0.3
"""Share of the error that may stay, however near to the noise floor that is."""
SMALLEST_SHARE = 0.05
"""Share of the residual that an effect must explain, and of the error that always may stay."""
FINE = 8
"""Physics substeps in place of each that say the timestep's error past contacts."""


@dataclasses.dataclass(frozen=True)
class Errors:
    """Held-out prediction error.

    Attributes:
        metric: How it is measured, the horizon among it.
        unit: "1": relative to each signal's standard deviation; see `segments.metric_spread`.
        before: Of the model as it is.
        after: With every selected effect.
        noise_floor: What noise and the integrator's own error make.
        unexplained_share: What is left above the floor, over `before`; 1 if that is too coarse.
        per_signal: By signal: before, after, noise_floor and the signal's unit, in that unit.
        timestep: Seconds of a step of the physics.
        integrator: What the integrator's error alone makes at this timestep.
        horizon: Seconds of the segments that are predicted.
        above_floor: The signals whose error stays well above their noise floor.
    """

    metric: str
    unit: str
    before: float
    after: float
    noise_floor: float
    unexplained_share: float
    per_signal: Mapping[str, Mapping[str, float | str]]
    timestep: float = math.nan
    integrator: float = 0.0
    horizon: float = math.nan
    above_floor: tuple[str, ...] = ()

    @classmethod
    def above(
        cls,
        floor: float,
        of_noise: float,
        *,
        metric: str,
        horizon: float,
        before: float,
        after: float,
        timestep: float,
        per_signal: Mapping[str, Mapping[str, float | str]],
        above_floor: tuple[str, ...] = (),
    ) -> "Errors":
        """Hold errors against their floor, of which noise alone makes `of_noise`.

        A model may err more than predicting the mean would, 1; what is left is then held against
        that.
        """
        integrator = math.sqrt(max(floor**2 - of_noise**2, 0.0))
        rest = math.sqrt(max(after**2 - floor**2, 0.0))
        share = rest / min(before, 1.0) if before > 0 else 0.0
        share = 1.0 if integrator > TOO_COARSE else share
        known = (before, after, floor, share, per_signal, timestep, integrator, horizon)
        return cls(metric, "1", *known, above_floor)

    @property
    def is_too_coarse(self) -> bool:
        """Whether the integrator's error would hide any other, so that nothing can be judged."""
        return self.integrator > TOO_COARSE

    @property
    def integrator_exceeds_noise(self) -> bool:
        """Whether the integrator's error is above noise's, so that it hides what noise does not."""
        return self.integrator > self.noise_floor / math.sqrt(2.0)

    @property
    def is_near_floor(self) -> bool:
        """Whether what is left is what noise, and an integrator that can be trusted, make."""
        return self.after <= ABOVE_FLOOR * self.noise_floor and not self.is_too_coarse

    @property
    def is_adequate(self) -> bool:
        """Whether no signal's error is well above its noise floor, and this can be judged."""
        return not self.above_floor and not self.is_too_coarse

    @property
    def is_explained(self) -> bool:
        """Whether what is left is hardly any of the error, or little and near the noise floor.

        Where nothing was added (`before` is `after`), whether the model is adequate.
        """
        if self.before == self.after:
            return self.is_adequate
        share = self.unexplained_share
        return share <= SMALLEST_SHARE or (self.is_near_floor and share <= UNEXPLAINED)

    @property
    def coarseness(self) -> str:
        """That nothing can be judged, in one sentence."""
        return (
            f"The model cannot be judged at a timestep of {self.timestep:g} s: the integrator's "
            f"error alone is {100 * self.integrator:.0f} % of the signals' spread. Give it a "
            "smaller timestep, an implicit integrator or softer gains."
        )


class Metric(NamedTuple):
    """The error that is reported: see `Errors`.

    Attributes:
        weight: Squared metric of one squared whitened residual, [N].
        counted: Which residuals are measured samples, not padding or estimates, [S, N].
        trust: How much each counts in a fit and in decisions, [S, N].
        spread: What each signal's error is held against; see `segments.metric_spread`.
    """

    weight: np.ndarray
    counted: np.ndarray
    trust: np.ndarray
    spread: np.ndarray

    def error(self, residual: np.ndarray, chosen: np.ndarray) -> float:
        """Return the root mean square over samples, all alike, and signals of chosen segments."""
        squares = (residual[chosen] / self.trust[chosen]) ** 2 * self.weight
        return float(np.sqrt(squares.sum() / self.count(chosen)))

    def count(self, chosen: np.ndarray) -> int:
        """Return how many residuals of the chosen segments count, 1 or more."""
        return max(int(self.counted[chosen].sum()), 1)

    def of_noise(self, chosen: np.ndarray) -> float:
        """Return the error that noise alone makes in chosen segments."""
        return self.error(self.counted * self.trust, chosen)

    def rms(self, residual: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Return the error of each signal in units of its noise, all samples alike [num_signals].

        Not a number where no sample was measured.
        """
        num_signals = len(self.spread)
        squares = (residual[chosen] / self.trust[chosen]) ** 2 * self.counted[chosen]
        count = self.counted[chosen].reshape(-1, num_signals).sum(axis=0)
        total = squares.reshape(-1, num_signals).sum(axis=0)
        return np.sqrt(np.where(count > 0, total / np.maximum(count, 1), np.nan))

    def by_signal(self, residual: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Return the error of each signal in units of its noise, as trusted, [num_signals]."""
        num_signals = len(self.spread)
        counted = self.counted[chosen] * self.trust[chosen]
        squares = (residual[chosen] ** 2 * self.counted[chosen]).reshape(-1, num_signals)
        total = np.maximum((counted**2).reshape(-1, num_signals).sum(axis=0), 1e-300)
        return np.sqrt(squares.sum(axis=0) / total)


def make_metric(problem: Problem) -> Metric:
    """Make the metric: errors relative to each signal's spread in the held-out data."""
    s = problem.segments
    held_out = (s.weight > 0) & ~problem.fitted[:, None]
    spread = metric_spread(s.measured[held_out], s.noise)
    weight = np.tile((s.noise / spread) ** 2, s.measured.shape[1])
    counted = (s.counts > 0).reshape(len(s.weight), -1)
    return Metric(weight, counted, s.trust.reshape(counted.shape), spread)


def trusted(problem: AnyProblem, settled: Fit) -> AnyProblem:
    """Let samples of a signal count less that the model's timestep does not let it predict.

    Where half a timestep changes a prediction by many standard deviations of noise, as after an
    impact, a residual says nothing of the model's physics. Such changes last to the end of a
    segment. What other initial states would undo does not count.

    Args:
        problem: What is fitted.
        settled: The model, as it is or with what was found, initial states fitted.
    """
    segments = problem.segments
    change = coarse_error(problem, settled)
    sizes = change, beyond_starts(settled, change)
    size = np.minimum(*(np.abs(x).reshape(segments.measured.shape) for x in sizes))
    trust = 1.0 / np.maximum(1.0, np.maximum.accumulate(size, axis=1) / TRUSTED)
    return dataclasses.replace(problem, segments=dataclasses.replace(segments, trust=trust))


def coarse_error(problem: Problem, current: Fit) -> np.ndarray:
    """Return the engine's error at the model's timestep, as half of it tells.

    A first-order integrator errs by twice what half a step changes. Past contacts that is too much:
    those that open or close a step earlier change as much as they err.

    Returns:
        Whitened, [S, N].
    """
    return 2.0 * problem.integrator_error(current.theta, current.start, current.residual)


def timestep_error(problem: Problem, current: Fit) -> np.ndarray:
    """Return the engine's error at the model's timestep that no initial state undoes.

    Where contacts or the stops of joints may act, much finer steps say it in segments where it is
    above the noise; see `coarse_error`.

    Returns:
        Whitened, [S, N].
    """
    theta, start, residual = current.theta, current.start, current.residual
    change = coarse_error(problem, current)
    loud, host = np.flatnonzero(np.abs(change).max(axis=1) > 1.0), problem.simulator.host
    if len(loud) and (can_any_touch(host) or np.any(host.jnt_limited)):
        finer = problem.simulator.refined(FINE)
        fine = problem.take(loud).residual_by(finer, theta, start[loud])
        change[loud] = FINE / (FINE - 1) * (fine - residual[loud])
    return beyond_starts(current, change)


def beyond_starts(current: Fit, change: np.ndarray) -> np.ndarray:
    """Return what of a change of the residuals [S, N] no initial state undoes."""
    return StartSpace(current.sensitivity).remove(change[..., None])[..., 0]


class Floor(NamedTuple):
    """The held-out error that noise and the integrator's error would make by themselves.

    Attributes:
        error: In the metric.
        by_signal: In units of each signal's noise, as trusted, [num_signals].
        rms: The same, all samples alike, [num_signals].
    """

    error: float
    by_signal: np.ndarray
    rms: np.ndarray


def noise_floor(problem: Problem, metric: Metric, current: Fit) -> Floor:
    """Estimate the noise floor."""
    held_out = ~problem.fitted
    change = timestep_error(problem, current)
    return Floor(
        float(np.hypot(metric.of_noise(held_out), metric.error(change, held_out))),
        np.hypot(1.0, metric.by_signal(change, held_out)),
        np.hypot(1.0, metric.rms(change, held_out)),
    )


def signals_above(
    problem: Problem, metric: Metric, current: Fit, floor: Floor, by: float = ABOVE_FLOOR
) -> np.ndarray:
    """Say of each signal whether its held-out error is well above its noise floor, `by` times it.

    Returns:
        [num_signals] bool.
    """
    errors = metric.by_signal(current.residual, ~problem.fitted)
    return errors > by * floor.by_signal


def signals_mostly_above(
    problem: Problem, metric: Metric, current: Fit, floor: Floor
) -> np.ndarray:
    """Say of each signal whether it is well above its noise floor in most held-out segments.

    Long segments are few: one whose initial state was not found would make a gap of its own.

    Returns:
        [num_signals] bool.
    """
    held_out = np.flatnonzero(~problem.fitted)
    errors = np.stack(
        [metric.by_signal(current.residual, held_out[[i]]) for i in range(len(held_out))]
    )
    return np.mean(errors > ABOVE_FLOOR * floor.by_signal, axis=0) > 0.5


def is_above(
    problem: Problem, metric: Metric, current: Fit, floor: Floor, by: float = ABOVE_FLOOR
) -> bool:
    """Say whether any signal's held-out error is well above its noise floor, `by` times it."""
    return bool(np.any(signals_above(problem, metric, current, floor, by)))
