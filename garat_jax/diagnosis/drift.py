"""Whether a parameter changes while it is recorded: a sagging supply is a gain that falls.

Each fitted parameter's sensitivity, times the time within the recording, is held against what the
fit left of the residual. Evidence is robust, with blocks of time as the independent units.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from garat_jax.diagnosis.differences import clear_differences
from garat_jax.diagnosis.findings import Drift, Estimate
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.problem import Problem, StartSpace, block_labels, tall
from garat_jax.diagnosis.robust import regress
from garat_jax.diagnosis.starts import Fit
from garat_jax.effects import unit_at

SIGNIFICANCE = 0.01
"""Largest p-value, corrected for the number of parameters of all fits (Bonferroni)."""
SMALLEST_SHARE = 0.1
"""Share of what the fit leaves unexplained that a drift must explain."""
MUCH_LESS = 0.9
"""What the drift of another fit may leave to count, at most, relative to those before it."""


def time_in_recording(problem: Problem, recordings: Sequence[Recording]) -> np.ndarray:
    """Return where each residual's sample lies in its recording, from -0.5 to 0.5, [S, N]."""
    s = problem.segments
    places = []
    for recording, first in zip(s.recording, s.first, strict=True):
        time = recordings[recording].time
        samples = np.minimum(first + np.arange(s.measured.shape[1]), len(time) - 1)
        places.append((time[samples] - time[0]) / (time[-1] - time[0]) - 0.5)
    return np.repeat(places, s.measured.shape[2], axis=1)


def find_drifts(
    problem: Problem, fits: Sequence[Fit], recordings: Sequence[Recording]
) -> tuple[Drift, ...]:
    """Return the fitted parameters that drift within the recordings, clearest first.

    Where the recordings do not tell fits apart whose parameters are constant, a drift may: those of
    another fit count if one of them leaves much less than those before it do.

    Args:
        problem: What was fitted.
        fits: The fits whose parameters are tested, the likely one first.
        recordings: What the segments were cut from, in the order of their indices.
    """
    num_tests = sum(len(fitted.free) for fitted in fits)
    found, least = _drifts_of(problem, fits[0], recordings, num_tests)
    for fitted in fits[1:]:
        drifts, left = _drifts_of(problem, fitted, recordings, num_tests)
        if drifts and left < MUCH_LESS * least:
            found, least = [dataclasses.replace(drift, instead=True) for drift in drifts], left
    return tuple(sorted(found, key=lambda drift: drift.p_value))


def _drifts_of(problem: Problem, fitted: Fit, recordings: Sequence[Recording], num_tests: int):
    """Return a fit's parameters that drift, and the least that it leaves with one or none."""
    free = tuple(j for j in fitted.free if j not in fitted.frozen)
    if not free:
        return [], np.inf
    lin = clear_differences(problem, fitted.theta, fitted.start, free).linearisation
    chosen = problem.fitted
    when = time_in_recording(problem, recordings)[chosen, :, None]
    columns = lin.parameters[chosen]
    parts = [columns, columns * when, lin.residual[chosen, :, None]]
    rest = StartSpace(lin.start[chosen]).remove(np.concatenate(parts, axis=2))
    constant, growing, residual = np.split(rest, [len(free), 2 * len(free)], axis=2)
    labels = block_labels(problem)[chosen].ravel()
    without = regress(tall(constant), residual.ravel(), labels).rest
    found, least = [], float(without @ without)
    for place, j in enumerate(free):
        both = np.concatenate([constant, growing[..., place : place + 1]], axis=2)
        line = _line(tall(both), residual.ravel(), labels, place, without)
        if line.p_value * num_tests < SIGNIFICANCE and line.share > SMALLEST_SHARE:
            found.append(_named(problem, fitted, j, line))
            least = min(least, line.left)
    return found, least


class _Line(NamedTuple):
    """A parameter along a recording.

    Attributes:
        middle: What comes to its estimate in the middle of a recording: what is fitted may lie
            before or after.
        change: From start to end.
        half: Half of the 95 % interval of that.
        p_value: Of there being none.
        share: Of the residual's squares that it explains.
        left: What it leaves of them.
    """

    middle: float
    change: float
    half: float
    p_value: float
    share: float
    left: float


def _line(
    columns: np.ndarray, residual: np.ndarray, labels: np.ndarray, place: int, without: np.ndarray
) -> _Line:
    """Regress a residual on the parameters and, the last column, one of them times the time.

    Args:
        columns: Of the constant parameters, then of the growing one, [M, k + 1].
        residual: What is to be explained, [M].
        labels: Blocks of time, [M].
        place: Which of the constants grows.
        without: What the constants alone leave, [M].
    """
    found = regress(columns, residual, labels)
    change, deviation = found.coefficient[-1], np.sqrt(found.covariance[-1, -1])
    p_value = 2.0 * float(stats.t.sf(abs(change) / max(deviation, 1e-300), found.freedom))
    left = float(found.rest @ found.rest)
    share = 1.0 - left / max(float(without @ without), 1e-300)
    half = float(stats.t.ppf(0.975, found.freedom) * deviation)
    return _Line(float(found.coefficient[place]), float(change), half, p_value, share, left)


def _named(problem: Problem, fitted: Fit, j: int, line: _Line) -> Drift:
    simulator = problem.simulator
    slot = simulator.slots[j]
    effect = simulator.effects[slot.effect]
    unit = unit_at(slot.parameter, simulator.host, effect.target)
    middle, change = float(fitted.theta[j]) + line.middle, line.change
    return Drift(
        effect=effect.kind,
        target=effect.target,
        parameter=slot.parameter.name,
        begin=middle - change / 2,
        end=middle + change / 2,
        change=Estimate(change, change - line.half, change + line.half, unit),
        p_value=line.p_value,
        share=line.share,
    )
