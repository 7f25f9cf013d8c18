"""Derivatives and noise of sampled signals; sampling may be irregular."""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

WINDOW = 0.05
"""Seconds over which a derivative is taken: short against a robot joint's motion."""
FEWEST = 5
"""Samples in that window at least."""
ORDERS = (2, 4)
"""Orders of the differences that tell noise from motion."""
UNIFORM = 0.01
"""Largest deviation of a sampling interval, relative to their median, that counts as uniform."""
TOGGLES = 3
"""Changes of a signal from which its levels are an encoder's."""
OFF_GRID = 0.05
"""Part of a step by which levels may be off the grid."""
FINEST = 0.02
"""Part of the median gap between levels that a step is at least."""
ROWS = 10_000
"""Samples around which polynomials are fitted at once: each has a window of its own in memory."""


def even_steps(time: np.ndarray) -> np.ndarray:
    """Return times [T] at even steps, which filters for uniform sampling need; given ones if so."""
    steps = np.diff(time)
    usual = float(np.median(steps))
    if np.abs(steps - usual).max() <= UNIFORM * usual:
        return time
    return np.linspace(time[0], time[-1], round((time[-1] - time[0]) / usual) + 1)


def interpolated(at: np.ndarray, time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values [T, N], linear between their samples, at other times, [M, N]."""
    return np.stack([np.interp(at, time, column) for column in values.T], axis=1)


def held(at: np.ndarray, time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values [T, N], held until their next sample, at other times, [M, N]."""
    return values[np.searchsorted(time, at, side="right") - 1]


def held_means(at: np.ndarray, time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the means of values [T, N], held until their next sample, around even times, [M, N].

    Each is over half a step to either side. Beyond its ends a signal stays as it is there.
    """
    steps = np.diff(time)[:, None]
    integral = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(steps * values[:-1], 0)])
    integral = np.concatenate([integral[:1] - values[:1], integral, integral[-1:] + values[-1:]])
    time = np.concatenate([[time[0] - 1.0], time, [time[-1] + 1.0]])
    step = float(np.median(np.diff(at)))
    low, high = (interpolated(end, time, integral) for end in (at - step / 2, at + step / 2))
    return (high - low) / step


def local_slope(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Differentiate by local polynomials (Savitzky and Golay 1964, for irregular sampling too).

    A quadratic is fitted, with tricube weights, to the samples around each one: about `WINDOW`
    seconds and at least `FEWEST` samples, the nearest full window at either end.

    Args:
        time: Seconds, increasing, [T] with T >= `FEWEST`.
        values: [T, N].

    Returns:
        Derivatives, [T, N].
    """
    num = len(time)
    half = max(FEWEST // 2, round(0.5 * WINDOW / float(np.median(np.diff(time)))))
    width = min(2 * half + 1, num)
    parts = np.array_split(np.arange(num), -(-num // ROWS))
    return np.concatenate([_slope_at(rows, time, values, half, width) for rows in parts])


def _slope_at(
    rows: np.ndarray, time: np.ndarray, values: np.ndarray, half: int, width: int
) -> np.ndarray:
    """Return the derivatives at some samples, [rows, N]."""
    first = np.clip(rows - half, 0, len(time) - width)
    index = first[:, None] + np.arange(width)
    offset = time[index] - time[rows, None]
    reach = np.abs(offset).max(axis=1, keepdims=True)
    offset = offset / reach
    weight = (1 - np.minimum(np.abs(offset) * width / (width + 1), 1) ** 3) ** 3
    powers = np.stack([np.ones_like(offset), offset, offset**2], axis=2)
    weighted = powers * weight[..., None]
    normal = np.einsum("tki,tkj->tij", weighted, powers)
    moments = np.einsum("tki,tkn->tin", weighted, values[index])
    return np.linalg.solve(normal, moments)[:, 1] / reach


def white_noise(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Estimate the standard deviation of white noise on slow signals.

    Differences of second and of fourth order, scaled so that white noise passes with its own
    standard deviation, hold little of the motion; their median absolute value is robust to the
    moments at which they do. The smaller of the two orders counts: what motion adds only
    makes an estimate larger. Below an encoder's step the median means nothing: there the root mean
    square counts, and at least the step over the square root of 12.

    Args:
        time: Seconds, increasing, [T] with T > 4.
        values: [T, N].

    Returns:
        Standard deviations, [N].
    """
    steps = np.asarray([quantum(column) for column in values.T])
    by_median, by_square = [], []
    for order in ORDERS:
        times = sliding_window_view(time, order + 1)
        gaps = times[:, :, None] - times[:, None, :] + np.eye(order + 1)
        weights = 1.0 / np.prod(gaps / (times[:, -1] - times[:, 0])[:, None, None], axis=2)
        weights /= np.linalg.norm(weights, axis=1, keepdims=True)
        windows = sliding_window_view(values, order + 1, axis=0)
        differences = np.abs(np.einsum("tk,tnk->tn", weights, windows))
        by_median.append(1.4826 * np.median(differences, axis=0))
        by_square.append(np.sqrt(np.mean(np.minimum(differences, 3 * steps) ** 2, axis=0)))
    median, square = np.min(by_median, axis=0), np.min(by_square, axis=0)
    return np.where(median < steps, np.maximum(square, steps / np.sqrt(12.0)), median)


def quantum(values: np.ndarray) -> float:
    """Return the step of a quantised signal [T], 0 where the values lie on no grid.

    Where most values differ, as in a fast motion, steps between some may be missing. Two levels are
    a grid only if the signal goes back and forth between them. A steady motion has equal steps
    too, but only what lies on a grid bends by its steps.
    """
    step = _spacing(values)
    bends = np.abs(np.diff(values, 2))
    bends = bends[bends > 2 * OFF_GRID * step]  # less is rounding
    return step if len(bends) and float(np.median(bends)) > 0.5 * step else 0.0


def _spacing(values: np.ndarray) -> float:
    """Return the step that all values [T] are apart by, a whole number of times; 0 if none is."""
    levels = np.unique(values)
    if len(levels) < 2 or np.count_nonzero(np.diff(values)) < TOGGLES:
        return 0.0
    gaps = np.diff(levels)
    gaps = gaps[gaps > 1e-6 * float(np.median(gaps))]
    step = float(gaps.min())
    if len(levels) <= 0.5 * len(values):
        ratio = gaps / step
        return step if np.all(np.abs(ratio - np.round(ratio)) < OFF_GRID * ratio) else 0.0
    while step > FINEST * float(np.median(gaps)):  # Euclid's, for gaps that are not exact
        rest = np.abs(gaps - np.round(gaps / step) * step)
        if np.all(rest < OFF_GRID * step):
            return step
        step = float(rest[rest >= OFF_GRID * step].min())
    return 0.0
