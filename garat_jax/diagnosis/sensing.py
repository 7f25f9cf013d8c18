"""The states that sensors report: where they are off, what is measured is not what is."""

from collections.abc import Callable

import numpy as np

DISPLACED = 1e-6
"""Difference of what is and what sensors report, in units of the states, that counts."""
FLAT = 0.05
"""Slope of what is reported, by what is, below which it tells nothing."""


def displacement(states: np.ndarray, reported: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Return states [S, nq + nv] less what sensors report of them, [S, num_signals]; mostly 0.

    Args:
        states: The states.
        reported: What sensors report of them, [S, num_signals]: positions, then velocities.
        unit: Of each component, [nq + nv].
    """
    num = reported.shape[1]
    off = states[:, :num] - reported
    return np.where(np.abs(off) > DISPLACED * unit[:num], off, 0.0)


def as_they_are(
    measured: np.ndarray,
    reported: np.ndarray,
    report: Callable[[np.ndarray], np.ndarray],
    unit: np.ndarray,
) -> np.ndarray:
    """Return the states of which sensors report what was measured, [S, nq + nv].

    A secant step for each component, exact where it is reported by itself and linearly, as by the
    sensors of the catalogue. Without effects of sensors these are the measured ones themselves.

    Args:
        measured: What was measured, [S, nq + nv].
        reported: What sensors report of states that are the measured ones, [S, num_signals].
        report: Returns that of other states.
        unit: Of each component, [nq + nv].
    """
    first = displacement(measured, reported, unit)
    if not np.any(first):
        return measured
    states, num = measured.copy(), first.shape[1]
    states[:, :num] += first
    again = report(states)
    second = np.where(np.isfinite(again), displacement(states, again, unit), first)
    moved = np.where(first == 0.0, 1.0, first)
    slope = 1.0 - (second - first) / moved
    states[:, :num] += (second - first) / np.where(np.abs(slope) > FLAT, slope, 1.0)
    return states
