"""A law that most of the measured torques follow, however far off the others are."""

import numpy as np
from scipy import optimize

NEAR = 0.1
"""Distance from the law, relative to the values' median one from theirs, from which its size counts
and not its square."""


def follow_most(columns: np.ndarray, values: np.ndarray) -> tuple[float, np.ndarray]:
    """Fit values by a level and a multiple of each column, with a pseudo-Huber loss.

    What noise makes of contacts are few torques, but huge ones, which would bend least squares.

    Args:
        columns: [M, k].
        values: [M].

    Returns:
        The level, where all columns are 0, and the multiples, [k].
    """
    middle, spread = np.median(columns, axis=0), np.std(columns, axis=0) + 1e-12
    level, size = float(np.median(values)), median_distance(values)
    at = np.column_stack([np.ones(len(values)), (columns - middle) / spread])
    wanted = (values - level) / size
    start = np.zeros(at.shape[1])
    found = optimize.least_squares(lambda x: at @ x - wanted, start, loss="soft_l1", f_scale=NEAR).x
    factor = found[1:] * size / spread
    return float(level + found[0] * size - middle @ factor), factor


def median_distance(values: np.ndarray) -> float:
    """Return the median distance of values from their median, more than 0."""
    return float(np.median(np.abs(values - np.median(values)))) + 1e-12
