"""The error that a diagnosis reports, and the floor that noise and the integrator set it."""

from typing import NamedTuple

import numpy as np

from garat_jax.diagnosis.fit import Fit
from garat_jax.diagnosis.problem import Problem, StartSpace

ABOVE_FLOOR = 1.5
"""A model is adequate up to this multiple of the noise floor."""


class Metric(NamedTuple):
    """The error that is reported: see `results.Errors`.

    Attributes:
        weight: Squared metric of one squared whitened residual, [N].
        counted: Which residuals are samples and not padding, [S, N].
        spread: Standard deviation of each signal in the held-out data, its noise at least,
            [num_signals].
    """

    weight: np.ndarray
    counted: np.ndarray
    spread: np.ndarray

    def error(self, residual: np.ndarray, chosen: np.ndarray) -> float:
        """Return the root mean square over samples and signals of the chosen segments."""
        squares = residual[chosen] ** 2 * self.weight
        return float(np.sqrt(squares.sum() / self.count(chosen)))

    def count(self, chosen: np.ndarray) -> int:
        """Return how many residuals of the chosen segments count, 1 or more."""
        return max(int(self.counted[chosen].sum()), 1)

    def by_signal(self, residual: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Return the error of each signal in units of its noise, [num_signals]."""
        num_signals = len(self.spread)
        squares = (residual[chosen] ** 2 * self.counted[chosen]).reshape(-1, num_signals)
        return np.sqrt(squares.sum(axis=0) / self.counted[chosen].sum() * num_signals)


def make_metric(problem: Problem) -> Metric:
    """Make the metric: errors relative to each signal's spread in the held-out data."""
    s = problem.segments
    held_out = (s.weight > 0) & ~problem.fitted[:, None]
    spread = np.maximum(s.measured[held_out].std(axis=0), s.noise)
    weight = np.tile((s.noise / spread) ** 2, s.measured.shape[1])
    return Metric(weight, np.repeat(s.weight > 0, s.measured.shape[2], axis=1), spread)


class Floor(NamedTuple):
    """The held-out error that noise and the integrator's error would make by themselves.

    Attributes:
        error: In the metric.
        by_signal: In units of each signal's noise, [num_signals].
    """

    error: float
    by_signal: np.ndarray


def noise_floor(problem: Problem, metric: Metric, current: Fit) -> Floor:
    """Estimate the noise floor; a first-order integrator errs by twice what half a step changes."""
    held_out = ~problem.fitted
    change = problem.integrator_error(current.theta, current.start, current.residual)
    change = 2.0 * StartSpace(current.sensitivity).remove(change[..., None])[..., 0]
    noise = metric.counted.astype(float)
    return Floor(
        float(np.hypot(metric.error(noise, held_out), metric.error(change, held_out))),
        np.hypot(1.0, metric.by_signal(change, held_out)),
    )


def is_above(
    problem: Problem, metric: Metric, current: Fit, floor: Floor, by: float = ABOVE_FLOOR
) -> bool:
    """Say whether any signal's held-out error is well above its noise floor, `by` times it."""
    errors = metric.by_signal(current.residual, ~problem.fitted)
    return bool(np.any(errors > by * floor.by_signal))
