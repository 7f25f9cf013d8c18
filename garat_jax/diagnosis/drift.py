"""Whether a parameter changes while it is recorded: a sagging supply is a gain that falls.

Each fitted parameter's sensitivity, times the time within the recording, is held against what the
fit left of the residual. Evidence is robust, with blocks of time as the independent units.
"""

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
"""Largest p-value, corrected for the number of parameters (Bonferroni)."""
SMALLEST_SHARE = 0.1
"""Share of what the fit leaves unexplained that a drift must explain, and of what another fit's
drift leaves by which one of its own has to leave less."""


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
    the first fit count unless one of another leaves much less.

    Args:
        problem: What was fitted.
        fits: The fits whose parameters are tested, the likely one first.
        recordings: What the segments were cut from, in the order of their indices.
    """
    found, least = [], np.inf
    for fitted in fits:
        drifts = _drifts_of(problem, fitted, recordings)
        left = min((line.left for line, _ in drifts), default=np.inf)
        if left < (1.0 - SMALLEST_SHARE) * least:
            found, least = drifts, left
    found = sorted(found, key=lambda drift: drift[0].p_value)
    return tuple(drift for _, drift in found)


def _drifts_of(problem: Problem, fitted: Fit, recordings: Sequence[Recording]):
    """Return a fit's parameters that drift, each with its line."""
    free = tuple(j for j in fitted.free if j not in fitted.frozen)
    if not free:
        return []
    lin = clear_differences(problem, fitted.theta, fitted.start, free).linearisation
    chosen = problem.fitted
    when = time_in_recording(problem, recordings)[chosen, :, None]
    columns = lin.parameters[chosen]
    parts = [columns, columns * when, lin.residual[chosen, :, None]]
    rest = StartSpace(lin.start[chosen]).remove(np.concatenate(parts, axis=2))
    constant, growing, residual = np.split(rest, [len(free), 2 * len(free)], axis=2)
    labels = block_labels(problem)[chosen].ravel()
    found = []
    for place, j in enumerate(free):
        both = np.concatenate([constant, growing[..., place : place + 1]], axis=2)
        line = _line(tall(both), residual.ravel(), labels, place)
        if line.p_value * len(free) < SIGNIFICANCE and line.share > SMALLEST_SHARE:
            found.append((line, _named(problem, fitted, j, line)))
    return found


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


def _line(columns: np.ndarray, residual: np.ndarray, labels: np.ndarray, place: int) -> _Line:
    """Regress a residual on the parameters and, the last column, one of them times the time.

    Args:
        columns: Of the constant parameters, then of the growing one, [M, k + 1].
        residual: What is to be explained, [M].
        labels: Blocks of time, [M].
        place: Which of the constants grows.
    """
    without = regress(columns[:, :-1], residual, labels).rest
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
