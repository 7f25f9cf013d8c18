"""Is what the model leaves random? Autocorrelation of the residuals, and correlation with inputs.

Ljung, System Identification (2nd ed. 1999), section 16.6. A residual that is white and independent
of the inputs holds nothing that a better model could still explain.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.replay import Replay

ALIKE = 1.1
"""Ratio up to which sampling intervals are taken for the same."""
LAGS = 25
"""Lags looked at, in samples."""
QUANTILE = 2.576
"""Of the normal distribution: 99 % of chance lies within."""
MOST_OUTSIDE = 2
"""Of 25 lags, that chance puts beyond 99 % bounds; three have a probability of 0.2 %."""


@dataclasses.dataclass(frozen=True)
class Whiteness:
    """Autocorrelation of one signal's residual.

    Attributes:
        signal: The signal.
        seconds: Lags, from one sample on.
        correlation: At these lags, -1 to 1.
        bound: What chance stays within, with 99 % probability a lag.
        outside: How many lags are beyond it.
        white: Whether chance would do that.
    """

    signal: str
    seconds: tuple[float, ...]
    correlation: tuple[float, ...]
    bound: float
    outside: int
    white: bool


@dataclasses.dataclass(frozen=True)
class Independence:
    """Correlation of one signal's residual with an earlier command; fields as in `Whiteness`."""

    signal: str
    input: str
    seconds: tuple[float, ...]
    correlation: tuple[float, ...]
    bound: float
    outside: int
    independent: bool


@dataclasses.dataclass(frozen=True)
class Residuals:
    """Both tests, for every signal."""

    whiteness: tuple[Whiteness, ...]
    independence: tuple[Independence, ...]

    def sentence(self, small: bool = False) -> str:
        """Return what the tests say, in one sentence.

        Args:
            small: Whether the residuals are as small as noise and the integrator's error.
        """
        coloured = [w.signal for w in self.whiteness if not w.white]
        driven = [f"{i.signal} with {i.input}" for i in self.independence if not i.independent]
        if not coloured and not driven:
            found = "What the model leaves is white and independent of the commands"
            if small:
                return f"{found}: it is noise."
            return f"{found} by these tests, but too large for noise: few samples tell no pattern."
        lines = [f"not white: {', '.join(coloured)}"] if coloured else []
        lines += [f"goes with the commands: {', '.join(driven)}"] if driven else []
        found = "; ".join(lines)
        if small:
            return (
                f"What the model leaves has a pattern ({found}), but no more of it than noise and "
                "the integrator's own error would make."
            )
        return f"What the model leaves is no noise ({found})."


def examine(played: Replay, recordings: Sequence[Recording], inputs: Sequence[str]) -> Residuals:
    """Test a model's residuals for whiteness and for independence of the commands.

    Lags are samples: of recordings at several rates, those at the highest are tested that measured
    the signal.

    Args:
        played: Predictions of the recordings.
        recordings: What was measured.
        inputs: Names of the commands.
    """
    intervals = np.asarray([r.interval for r in recordings])[played.segments.recording]
    weight = played.segments.weight
    rows = [
        np.minimum(first + np.arange(weight.shape[1]), len(recordings[r].time) - 1)
        for first, r in zip(played.segments.first, played.segments.recording, strict=True)
    ]
    commands = np.stack(
        [recordings[r].ctrl[k] for r, k in zip(played.segments.recording, rows, strict=True)]
    )
    lags = min(LAGS, weight.shape[1] - 2)
    whiteness, independence = [], []
    for i, name in enumerate(played.names):
        interval = float(intervals[played.segments.observed[:, i]].min())
        is_tested = intervals <= ALIKE * interval
        weight = played.segments.counts[..., i] * is_tested[:, None]
        residual = _centred(played.deviation[..., i], weight)
        own = _correlation(residual, residual, lags)
        num = float(weight.sum())
        bound = QUANTILE / np.sqrt(num)
        seconds = tuple(float(interval * k) for k in range(lags + 1))
        outside = int(np.sum(np.abs(own[1:]) > bound))
        white = outside <= MOST_OUTSIDE
        correlation = tuple(map(float, own[1:]))
        whiteness.append(Whiteness(name, seconds[1:], correlation, bound, outside, white))
        for j, command in enumerate(inputs):
            if np.ptp(commands[..., j][weight > 0]) == 0:
                continue
            driving = _centred(commands[..., j], weight)
            with_input = _correlation(residual, driving, lags)
            of_input = _correlation(driving, driving, lags)
            spread = 1.0 + 2.0 * float(np.sum(own[1:] * of_input[1:]))
            limit = QUANTILE * np.sqrt(max(spread, 1.0) / num)
            beyond = int(np.sum(np.abs(with_input) > limit))
            independence.append(
                Independence(
                    signal=name,
                    input=command,
                    seconds=seconds,
                    correlation=tuple(map(float, with_input)),
                    bound=float(limit),
                    outside=beyond,
                    independent=beyond <= MOST_OUTSIDE,
                )
            )
    return Residuals(tuple(whiteness), tuple(independence))


def _centred(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Take the mean off, padding aside, [S, L]."""
    mean = float((values * weight).sum() / weight.sum())
    return (values - mean) * weight


def _correlation(late: np.ndarray, early: np.ndarray, lags: int) -> np.ndarray:
    """Return the correlation of one series [S, L] with another some samples before, [lags + 1]."""
    size = np.sqrt(np.sum(late**2) * np.sum(early**2)) or 1.0
    length = late.shape[1]
    return np.asarray(
        [np.sum(late[:, k:] * early[:, : length - k]) / size for k in range(lags + 1)]
    )
