"""Recordings cut into segments with free initial states (multiple shooting).

Signals are `qpos`, then `qvel` where any recording measured it. Velocities that were estimated from
positions are no measurements: they say nothing that the positions do not, so they do not count.
"""

import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np

from garat_jax.diagnosis.activation import check_known, forgets_in, known_spans
from garat_jax.diagnosis.filters import UNIFORM
from garat_jax.diagnosis.measurements import Recording, between_gaps
from garat_jax.diagnosis.noise import noise_of
from garat_jax.errors import UserError

WARM_UP = 0.5
"""Seconds of commands before each segment, at least: they fill delays, lags and activations."""
LONGEST_GAP = 1.0
"""Seconds that a gap in a recording counts at most, for what is remembered of before it."""
SHORTEST = 10
"""Samples that a segment must have."""
SLOWEST = 0.5
"""Seconds between samples, at most: a segment would last for 5 s, too long to be followed."""
SLIP = 0.05
"""Samples by which those of a recording may be off from even ones, at most, at the end of
`FOLLOWED` seconds."""
FOLLOWED = 2.0
"""Seconds of the longest segments."""
QUIET = 10.0
"""Multiple of its noise that a signal's spread counts as at least where a horizon is chosen; one
that spreads less hardly moves: it is predicted no better than its noise, which is no error of the
model."""


@dataclasses.dataclass(frozen=True)
class Segments:
    """Measurements cut for multiple shooting; sample k of a segment is at `times[k]`.

    Attributes:
        measured: Measured signals, [S, L, num_signals].
        weight: 1 for a sample, 0 for padding, [S, L].
        observed: Whether a signal was measured in the segment's recording, [S, num_signals].
        trust: How much a sample's residual counts, 0 to 1, [S, L, num_signals]; see
            `metric.trusted`.
        start: Measured initial state (qpos, qvel), [S, nq + nv].
        ctrl: Command of every simulated step, the warm-up's first, [S, warm_up + steps, nu].
        place: Where a sample lies between simulated steps, [S, L].
        recording: Index of the recording, [S].
        first: Index of the first sample within its recording, [S].
        past: Command of every simulated step of each recording from where it begins, padded,
            [R, T, nu].
        past_qvel: Measured velocity in the middle of each of these steps, 0 in gaps, [R, T, nv].
        num_past: How many of these steps came before the segment, [S].
        begins: Measured state where each recording begins, [R, nq + nv].
        noise: Standard deviation of each signal's noise, [num_signals].
        spread: Standard deviation of each signal, `QUIET` times its noise at least, [num_signals].
        start_unit: What the initial states differ by, a unit of each component, [nq + nv].
        lasts: Simulated steps that a segment lasts, if it is not of a recording that has too few
            samples in them, or is shorter.
        seconds: Seconds that the longest lasts.
    """

    measured: np.ndarray
    weight: np.ndarray
    observed: np.ndarray
    trust: np.ndarray
    start: np.ndarray
    ctrl: np.ndarray
    place: np.ndarray
    recording: np.ndarray
    first: np.ndarray
    past: np.ndarray
    past_qvel: np.ndarray
    num_past: np.ndarray
    begins: np.ndarray
    noise: np.ndarray
    spread: np.ndarray
    start_unit: np.ndarray
    lasts: float = np.inf
    seconds: float = np.nan

    @property
    def is_whole(self) -> np.ndarray:
        """Say which last half as long as the longest or more, [S] bool: not rests of recordings."""
        steps = 1.0 + np.max(self.place * self.weight, axis=1, initial=0.0)
        return 2 * steps >= min(self.lasts, steps.max(initial=0.0))

    @property
    def stretch(self) -> np.ndarray:
        """Number the stretches of segments that follow each other, if over a gap, [S]."""
        ends = self.first + np.count_nonzero(self.weight, axis=1)
        is_new = (self.recording[1:] != self.recording[:-1]) | (self.first[1:] != ends[:-1])
        return np.concatenate([[0], np.cumsum(is_new)])

    def take(self, chosen: np.ndarray) -> "Segments":
        """Return some of the segments; noise, spread, units and past stay those of all."""
        by_segment = ("measured", "weight", "observed", "trust", "start", "ctrl", "place")
        by_segment += ("recording", "first", "num_past")
        parts = {name: getattr(self, name)[chosen] for name in by_segment}
        return dataclasses.replace(self, **parts)

    @property
    def counts(self) -> np.ndarray:
        """1 where there is a measured sample of a signal, else 0, [S, L, num_signals]."""
        return self.weight[..., None] * self.observed[:, None]


@dataclasses.dataclass(frozen=True)
class Grid:
    """The steps at which commands change and states are recorded.

    Attributes:
        interval: Seconds of one simulated step.
        substeps: Physics substeps in it.
        per_sample: Simulated steps a sample; samples lie on steps where sampling is uniform.
        uniform: Whether every recording is sampled uniformly at the same rate, within `SLIP`.
        forgets: Seconds after which activations have forgotten how they began; see `activation`.
    """

    interval: float
    substeps: int
    per_sample: int
    uniform: bool
    forgets: float = 0.0

    @property
    def timestep(self) -> float:
        """Seconds of one physics substep."""
        return self.interval / self.substeps

    @property
    def sample(self) -> float:
        """Seconds between samples."""
        return self.interval * self.per_sample


def grid_for(recordings: Sequence[Recording], host: mujoco.MjModel) -> Grid:
    """Match a model to the sampling, and to its activations; see `choose_grid`.

    Raises:
        UserError: Samples are too far apart to follow a motion, or activations stay unknown.
    """
    grid = choose_grid(recordings, host.opt.timestep)
    check_known(recordings, forgets_in(host), SHORTEST)
    return dataclasses.replace(grid, forgets=forgets_in(host))


def choose_grid(recordings: Sequence[Recording], timestep: float) -> Grid:
    """Match the physics to the sampling.

    Uniform sampling: a step is a sample, in substeps no longer than the model's timestep. Otherwise
    a step is no longer than the model's timestep, commands are held on these steps, and
    predictions are interpolated linearly between them; a sample is as long as in the recording
    that has most of them a second.

    Raises:
        UserError: Samples are too far apart to follow a motion.
    """
    for recording in recordings:
        if recording.interval > SLOWEST:
            raise UserError(
                f"the samples of {recording.name} are {recording.interval:.4g} s apart, too far to "
                f"follow a motion; at most {SLOWEST:g} s are. Is time in another unit than "
                "seconds? A map file names it"
            )
    intervals = [np.concatenate([np.diff(r.time[a:b]) for a, b in r.spans]) for r in recordings]
    sample = float(np.mean(np.concatenate(intervals)))
    slips = [abs(i.mean() - sample) / sample * FOLLOWED / sample for i in intervals]
    is_uniform = max(np.abs(i - sample).max() for i in intervals) <= UNIFORM * sample
    if not (is_uniform and max(slips) <= SLIP):
        is_uniform, sample = False, min(r.interval for r in recordings)
    substeps = max(1, int(np.ceil(sample / timestep - 1e-6)))
    if is_uniform:
        return Grid(sample, substeps, 1, True)
    return Grid(sample / substeps, 1, substeps, False)


def cut(recordings: Sequence[Recording], grid: Grid, horizon: float) -> Segments:
    """Cut recordings into segments of a horizon, each with the commands that led to it.

    Where activations are unknown, at the beginning of a recording, there are none.

    Args:
        recordings: What was measured.
        grid: The simulated steps.
        horizon: Seconds of a segment.

    Raises:
        UserError: No span is long enough for one segment.
    """
    samples = [grid.interval if grid.uniform else r.interval for r in recordings]
    lengths = [max(SHORTEST, round(horizon / sample)) for sample in samples]
    pieces = [
        (index, start, min(start + length, stop))
        for index, (r, length) in enumerate(zip(recordings, lengths, strict=True))
        for a, stop in known_spans(r, grid.forgets)
        for start in range(a, stop, length)
        if min(start + length, stop) - start >= SHORTEST
    ]
    if not pieces:
        raise UserError(f"the recordings have no {SHORTEST} samples in a row; record for longer")
    length = max(b - a for _, a, b in pieces)
    steps = max(_steps(recordings[i].time[a:b], grid) for i, a, b in pieces)
    warm_up = warm_up_steps(grid, recordings[0].ctrl.shape[1])
    before = [_past_steps(r, grid) for r in recordings]
    rows = [
        _piece(recordings[i], before[i], a, b, length, steps, warm_up, grid) for i, a, b in pieces
    ]
    measured, weight, start, ctrl, place = (np.stack(parts) for parts in zip(*rows, strict=True))
    num_position = recordings[0].qpos.shape[1]
    has_velocity = any(r.velocity_measured for r in recordings)
    num_signals = measured.shape[2] if has_velocity else num_position
    measured = measured[..., :num_signals]
    spread = measured[weight > 0].std(axis=0)
    deviations = noise_of(recordings, measured, weight)
    index = np.asarray([i for i, _, _ in pieces])
    observed = np.ones((len(pieces), num_signals), bool)
    observed[:, num_position:] = np.asarray([r.velocity_measured for r in recordings])[index, None]
    return Segments(
        measured=measured,
        weight=weight,
        observed=observed,
        trust=np.ones_like(measured),
        start=start,
        ctrl=ctrl,
        place=place,
        recording=index,
        first=np.asarray([a for _, a, _ in pieces]),
        past=_past(recordings, before),
        past_qvel=_past_qvel(recordings, before),
        num_past=np.asarray([before[i][a] for i, a, _ in pieces]),
        begins=np.stack([np.concatenate([r.qpos[0], r.qvel[0]]) for r in recordings]),
        noise=deviations,
        spread=np.maximum(spread, QUIET * deviations),
        start_unit=_unit(start),
        lasts=horizon / grid.interval,
        seconds=max((b - a) * samples[i] for i, a, b in pieces),
    )


def metric_spread(samples: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return what the error of each signal is held against, [num_signals].

    That is its standard deviation. Of a signal that hardly moves it is as many times its noise as
    in the median of those that move (`QUIET` times if none does), so that its noise weighs no more
    than theirs.

    Args:
        samples: Measurements, [num_samples, num_signals].
        noise: Standard deviation of each signal's noise, [num_signals].
    """
    spread = samples.std(axis=0)
    moves = spread > QUIET * noise
    typical = np.median(spread[moves] / noise[moves]) if np.any(moves) else QUIET
    return np.where(moves, spread, typical * noise)


def _unit(start: np.ndarray) -> np.ndarray:
    """Return the standard deviation of each component, a thousandth of the largest at least."""
    spread = start.std(axis=0)
    return np.maximum(spread, 1e-3 * max(float(spread.max()), 1e-3))


def warm_up_steps(grid: Grid, num_actuators: int) -> int:
    """Return the steps before each segment; without actuators nothing has to fill."""
    return int(np.ceil(max(WARM_UP, grid.forgets) / grid.interval)) if num_actuators else 0


def _past_steps(recording: Recording, grid: Grid) -> np.ndarray:
    """Return how many simulated steps before each sample its recording began, [T]."""
    intervals = np.minimum(np.diff(recording.time), LONGEST_GAP)
    return np.round(np.cumsum([0.0, *intervals]) / grid.interval).astype(int)


def _past(recordings: Sequence[Recording], steps: Sequence[np.ndarray]) -> np.ndarray:
    """Return every recording's commands by simulated steps, [R, T, nu]; gaps keep the last one."""
    every = np.arange(max(at[-1] for at in steps))
    held = [np.searchsorted(at, every, side="right") - 1 for at in steps]
    return np.stack([r.ctrl[rows] for r, rows in zip(recordings, held, strict=True)])


def _past_qvel(recordings: Sequence[Recording], steps: Sequence[np.ndarray]) -> np.ndarray:
    """Return every recording's velocity in the middle of the simulated steps, [R, T, nv]."""
    qvel = np.zeros((len(recordings), max(at[-1] for at in steps), recordings[0].qvel.shape[1]))
    for row, recording, at in zip(qvel, recordings, steps, strict=True):
        for a, b in between_gaps(recording.time):  # also what is left out or held out
            every = np.arange(at[a], at[b - 1])
            speeds = [np.interp(every + 0.5, at[a:b], v) for v in recording.qvel[a:b].T]
            row[every] = np.stack(speeds, axis=1)
    return qvel


def _steps(time: np.ndarray, grid: Grid) -> int:
    if grid.uniform:
        return len(time) - 1
    return int(np.ceil((time[-1] - time[0]) / grid.interval)) + 1


def _piece(
    recording: Recording,
    at: np.ndarray,
    a: int,
    b: int,
    length: int,
    steps: int,
    warm_up: int,
    grid: Grid,
):
    """Return one segment's measured [L, nq + nv], weight, start, ctrl and place, padded.

    Samples come after `at` simulated steps, [T]; so do the commands before the segment.
    """
    padding = (0, length - (b - a))
    state = np.concatenate([recording.qpos, recording.qvel], axis=1)
    measured = np.pad(state[a:b], (padding, (0, 0)), mode="edge")
    weight = np.pad(np.ones(b - a), padding)
    before = np.searchsorted(at, at[a] - np.arange(warm_up, 0, -1), side="right") - 1
    during = np.arange(steps)
    if grid.uniform:
        held = a + during
        place = np.arange(length, dtype=float)
    else:
        times = recording.time[a] + during * grid.interval
        held = np.searchsorted(recording.time, times + 0.5 * grid.interval, side="right") - 1
        place = np.pad((recording.time[a:b] - recording.time[a]) / grid.interval, padding)
    rows = np.concatenate([before, held])
    ctrl = recording.ctrl[np.clip(rows, 0, len(recording.time) - 1)]
    return measured, weight, state[a], ctrl, np.minimum(place, steps)
