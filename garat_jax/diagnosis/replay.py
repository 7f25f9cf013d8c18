"""Replay recordings with a model: what it predicts where each segment's initial state is free."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from garat_jax.diagnosis.columns import signals
from garat_jax.diagnosis.measurements import Recording, longest_span
from garat_jax.diagnosis.model_card import Model
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.segments import QUIET, Grid, Segments, cut, grid_for, metric_spread
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.diagnosis.starts import settle
from garat_jax.diagnosis.velocity import estimate_velocity

HORIZONS = (0.2, 0.5, 1.0, 2.0)
"""Seconds over which predictions are shown."""


class Size(NamedTuple):
    """How far predictions of one signal are off.

    Attributes:
        rmse: Root mean square error, in the signal's unit.
        relative: The same by what the signal's error is held against; see
            `segments.metric_spread`.
        fit_percent: 100 (1 - |y - ŷ| / |y - mean y|), as in system identification; not a number
            where the signal moves no more than `segments.QUIET` times its noise.
        noise: Standard deviation of the signal's noise.
        unit: The signal's unit.
    """

    rmse: float
    relative: float
    fit_percent: float
    noise: float
    unit: str


@dataclasses.dataclass(frozen=True)
class Replay:
    """A model's predictions beside the measurements.

    Attributes:
        horizon: Seconds of a segment.
        names: Name of each signal.
        units: Unit of each signal.
        segments: The measurements, cut.
        predicted: [S, L, num_signals].
    """

    horizon: float
    names: tuple[str, ...]
    units: tuple[str, ...]
    segments: Segments
    predicted: np.ndarray

    @property
    def deviation(self) -> np.ndarray:
        """Prediction minus measurement, 0 where there is no sample, [S, L, num_signals]."""
        return (self.predicted - self.segments.measured) * self.segments.counts

    def only(self, recordings: Sequence[int]) -> "Replay":
        """Return the part of some recordings, by number, without signals that none measured."""
        kept = np.isin(self.segments.recording, list(recordings))
        segments = self.segments.take(kept)
        num = int(np.count_nonzero(segments.observed.any(axis=0)))  # positions, then velocities
        segments = dataclasses.replace(
            segments,
            measured=segments.measured[..., :num],
            observed=segments.observed[:, :num],
            trust=segments.trust[..., :num],
            noise=segments.noise[:num],
            spread=segments.spread[:num],
        )
        predicted = self.predicted[kept][..., :num]
        named = {"names": self.names[:num], "units": self.units[:num]}
        return dataclasses.replace(self, segments=segments, predicted=predicted, **named)

    @property
    def spread(self) -> np.ndarray:
        """What the error of each signal is held against, [num_signals]; see `metric_spread`."""
        return metric_spread(self.segments.measured[self.segments.weight > 0], self.segments.noise)

    def sizes(self) -> dict[str, Size]:
        """Return how far the predictions of each signal are off."""
        found = {}
        deviation, sampled = self.deviation, self.segments.counts > 0
        deviations = self.segments.measured[self.segments.weight > 0].std(axis=0)
        spread = self.spread
        for i, (name, unit) in enumerate(zip(self.names, self.units, strict=True)):
            rmse = float(np.sqrt(np.mean(deviation[..., i][sampled[..., i]] ** 2)))
            relative = rmse / float(spread[i])
            noise = float(self.segments.noise[i])
            moves = deviations[i] > QUIET * noise
            fit = 100 * (1 - rmse / float(deviations[i])) if moves else np.nan
            found[name] = Size(rmse, relative, fit, noise, unit)
        return found

    def error(self) -> float:
        """Return the root mean square over signals of the relative error."""
        return float(np.sqrt(np.mean([size.relative**2 for size in self.sizes().values()])))

    def worst(self, count: int) -> list[int]:
        """Return the segments with the largest relative error, largest first."""
        relative = self.deviation / self.spread
        samples = self.segments.weight.sum(axis=1)
        return list(np.argsort(-(relative**2).sum(axis=(1, 2)) / samples)[:count])


def replay(
    model: Model, recordings: Sequence[Recording], horizons: Mapping[float, Sequence[int]]
) -> tuple[Replay, ...]:
    """Predict recordings over some horizons, the initial state of each segment fitted to it.

    Args:
        model: The model, with its effects.
        recordings: What was measured.
        horizons: Seconds of a segment, and the numbers of the recordings to predict over it.
    """
    host = model.compile(engine="mujoco").host.model
    grid = grid_for(recordings, host)
    simulator = Simulator(model, (), grid)
    return tuple(
        replay_with(simulator, recordings, grid, horizon, chosen)
        for horizon, chosen in horizons.items()
    )


def lasting_horizons(recordings: Sequence[Recording]) -> list[float]:
    """Return those of `HORIZONS` for which some recording lasts without a gap."""
    longest = longest_span(recordings)
    return [horizon for horizon in HORIZONS if horizon <= longest]


def replay_with(
    simulator: Simulator,
    recordings: Sequence[Recording],
    grid: Grid,
    horizon: float,
    chosen: Sequence[int] | None = None,
) -> Replay:
    """Predict all recordings, or chosen ones, with a simulator that is compiled; see `replay`."""
    shown = range(len(recordings)) if chosen is None else list(chosen)
    segments = cut(recordings, grid, horizon)
    segments = segments.take(np.isin(segments.recording, shown))
    everywhere = np.ones(len(segments.start), bool)
    problem = Problem(simulator, segments, everywhere, grid.sample)
    settled = settle(problem, simulator.base)
    residual = settled.residual.reshape(segments.measured.shape)
    of_state = signals(simulator.host)[: segments.measured.shape[2]]
    played = Replay(
        horizon=horizon,
        names=tuple(s.name for s in of_state),
        units=tuple(s.unit for s in of_state),
        segments=segments,
        predicted=segments.measured + residual * segments.noise,
    )
    return played.only(shown)


def as_recordings(
    played: Replay, recordings: Sequence[Recording], model: mujoco.MjModel
) -> list[Recording]:
    """Put predictions in the place of the measurements, as if they had been recorded.

    Whatever is then computed from both meets the same filters. Each segment is a span.
    """
    pieces: Mapping[int, list[int]] = {i: [] for i in range(len(recordings))}
    for s, index in enumerate(played.segments.recording):
        pieces[int(index)].append(s)
    return [
        _as_recording(played, recordings[index], members, model)
        for index, members in pieces.items()
        if members
    ]


def _as_recording(played: Replay, recording: Recording, members: list[int], model) -> Recording:
    qpos, qvel = recording.qpos.copy(), recording.qvel.copy()
    num_position = qpos.shape[1]
    spans = []
    for s in members:
        count = int(played.segments.weight[s].sum())
        first = int(played.segments.first[s])
        at = slice(first, first + count)
        qpos[at] = played.predicted[s, :count, :num_position]
        if recording.velocity_measured and played.predicted.shape[2] > num_position:
            qvel[at] = played.predicted[s, :count, num_position:]
        else:
            qvel[at] = estimate_velocity(model, recording.time[at], qpos[at])
        spans.append((first, first + count))
    return dataclasses.replace(recording, qpos=qpos, qvel=qvel, spans=tuple(spans))
