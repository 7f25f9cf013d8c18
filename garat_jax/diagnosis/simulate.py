"""Simulate every segment of the recordings, for many parameters and initial states, in one call.

Recordings are cut into segments with free initial states (multiple shooting). One compiled program
holds every candidate effect at its nominal value, which is the identity; fitting and scoring move
its leaves. Signals are `qpos`, then `qvel` where every recording measured it.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import integrate

from garat_jax import dynamics
from garat_jax.diagnosis.measurements import Recording, noise
from garat_jax.diagnosis.model_card import Model
from garat_jax.dynamics import Override
from garat_jax.effects import Effect, Parameter
from garat_jax.errors import UserError

WARM_UP = 0.1
"""Seconds of commands before each segment: they fill delays and activations (at most 0.1 s)."""
UNIFORM = 0.01
"""Largest deviation of a sampling interval, relative to their median, that counts as uniform."""
SHORTEST = 10
"""Samples that a segment must have."""
BATCH_SIZES = (1, 4, 16)
"""Each width of a batch is compiled once, so widths are rounded up to one of these."""
SMALLEST_NOISE = 1e-4
"""Noise assumed at least, relative to the signal's standard deviation."""
KINEMATIC_WINDOW = 0.05
"""Seconds over which position and velocity sensors are held against each other."""
CONTRADICTION = 1.5
"""How much more than their white noise the two sensors must differ before it counts."""


class Slot(NamedTuple):
    """One parameter of one candidate effect.

    Attributes:
        effect: Index among the candidate effects.
        parameter: Its declaration.
        base: The value that stands for "no effect" here.
    """

    effect: int
    parameter: Parameter
    base: float


@dataclasses.dataclass(frozen=True)
class Segments:
    """Measurements cut for multiple shooting; sample k of a segment is at `times[k]`.

    Attributes:
        measured: Measured signals, [S, L, num_signals].
        weight: 1 for a sample, 0 for padding, [S, L].
        start: Measured initial state (qpos, qvel), [S, nq + nv].
        ctrl: Command of every simulated step, the warm-up's first, [S, warm_up + steps, nu].
        place: Where a sample lies between simulated steps, [S, L].
        recording: Index of the recording, [S].
        first: Index of the first sample within its recording, [S].
        noise: Standard deviation of each signal's noise, [num_signals].
        spread: Standard deviation of each signal, [num_signals].
    """

    measured: np.ndarray
    weight: np.ndarray
    start: np.ndarray
    ctrl: np.ndarray
    place: np.ndarray
    recording: np.ndarray
    first: np.ndarray
    noise: np.ndarray
    spread: np.ndarray


@dataclasses.dataclass(frozen=True)
class Grid:
    """The steps at which commands change and states are recorded.

    Attributes:
        interval: Seconds of one simulated step.
        substeps: Physics substeps in it.
        per_sample: Simulated steps a sample; samples lie on steps where sampling is uniform.
        uniform: Whether every recording is sampled uniformly at the same rate.
    """

    interval: float
    substeps: int
    per_sample: int
    uniform: bool

    @property
    def timestep(self) -> float:
        """Seconds of one physics substep."""
        return self.interval / self.substeps


def choose_grid(recordings: Sequence[Recording], timestep: float) -> Grid:
    """Match the physics to the sampling.

    Uniform sampling: a step is a sample, in substeps no longer than the model's timestep. Otherwise
    a step is no longer than the model's timestep, commands are held on these steps, and
    predictions are interpolated linearly between them.
    """
    intervals = np.concatenate([np.diff(r.time[a:b]) for r in recordings for a, b in r.spans])
    sample = float(np.median(intervals))
    substeps = max(1, int(np.ceil(sample / timestep - 1e-6)))
    if np.abs(intervals - sample).max() <= UNIFORM * sample:
        return Grid(sample, substeps, 1, True)
    return Grid(sample / substeps, 1, substeps, False)


def cut(recordings: Sequence[Recording], grid: Grid, horizon: float) -> Segments:
    """Cut recordings into segments of a horizon, each with the commands that led to it.

    Args:
        recordings: What was measured.
        grid: The simulated steps.
        horizon: Seconds of a segment.

    Raises:
        UserError: No span is long enough for one segment.
    """
    sample = grid.interval * grid.per_sample
    length = max(SHORTEST, round(horizon / sample))
    measured_velocity = all(r.velocity_measured for r in recordings)
    pieces = [
        (index, start, min(start + length, stop))
        for index, r in enumerate(recordings)
        for a, stop in r.spans
        for start in range(a, stop, length)
        if min(start + length, stop) - start >= min(SHORTEST, length)
    ]
    if not pieces:
        raise UserError(f"the recordings have no {SHORTEST} samples in a row; record for longer")
    steps = max(_steps(recordings[i].time[a:b], grid) for i, a, b in pieces)
    warm_up = warm_up_steps(grid, recordings[0].ctrl.shape[1])
    rows = [_piece(recordings[i], a, b, length, steps, warm_up, grid) for i, a, b in pieces]
    measured, weight, start, ctrl, place = (np.stack(parts) for parts in zip(*rows, strict=True))
    num_position = recordings[0].qpos.shape[1]
    num_signals = measured.shape[2] if measured_velocity else num_position
    deviations = np.sqrt(np.mean([signal_noise(r) ** 2 for r in recordings], axis=0))
    measured = measured[..., :num_signals]
    spread = measured[weight > 0].std(axis=0) + 1e-12
    return Segments(
        measured=measured,
        weight=weight,
        start=start,
        ctrl=ctrl,
        place=place,
        recording=np.asarray([i for i, _, _ in pieces]),
        first=np.asarray([a for _, a, _ in pieces]),
        noise=np.maximum(deviations[:num_signals], SMALLEST_NOISE * spread),
        spread=spread,
    )


def warm_up_steps(grid: Grid, num_actuators: int) -> int:
    """Return the steps before each segment; without actuators nothing has to fill."""
    return int(np.ceil(WARM_UP / grid.interval)) if num_actuators else 0


def signal_noise(recording: Recording) -> np.ndarray:
    """Estimate each signal's error, [nq + nv]: white noise, or sensors that contradict each other.

    Filtered velocities have little white noise and are still wrong. What the change of position
    over a short window differs from the integral of velocity, beyond white noise, is the
    velocity's error. (Joints of one dof alone; a quaternion is no integral.)
    """
    white = np.asarray(noise(recording))
    num = recording.qpos.shape[1]
    if not recording.velocity_measured or num != recording.qvel.shape[1]:
        return white
    changes = []
    interval = float(np.median(np.diff(recording.time)))
    window = max(2, round(KINEMATIC_WINDOW / interval))
    for a, b in recording.spans:
        time, speed = recording.time[a:b], recording.qvel[a:b]
        travelled = integrate.cumulative_trapezoid(speed, time, axis=0, initial=0.0)
        difference = recording.qpos[a:b] - travelled
        changes.append(difference[window:] - difference[:-window])
    duration = window * interval
    apart = np.sqrt(np.mean(np.concatenate(changes) ** 2, axis=0)) / duration
    expected = np.hypot(np.sqrt(2) * white[:num] / duration, white[num:] / np.sqrt(window))
    systematic = np.sqrt(np.maximum(apart**2 - expected**2, 0.0))
    contradicts = apart > CONTRADICTION * expected
    return np.concatenate(
        [white[:num], np.where(contradicts, np.hypot(white[num:], systematic), white[num:])]
    )


def _steps(time: np.ndarray, grid: Grid) -> int:
    if grid.uniform:
        return len(time) - 1
    return int(np.ceil((time[-1] - time[0]) / grid.interval)) + 1


def _piece(recording: Recording, a: int, b: int, length: int, steps: int, warm_up: int, grid: Grid):
    """Return one segment's measured [L, nq + nv], weight, start, ctrl and place, padded."""
    padding = (0, length - (b - a))
    state = np.concatenate([recording.qpos, recording.qvel], axis=1)
    measured = np.pad(state[a:b], (padding, (0, 0)), mode="edge")
    weight = np.pad(np.ones(b - a), padding)
    offsets = np.arange(-warm_up, steps)
    if grid.uniform:
        held = a + offsets
        place = np.arange(length, dtype=float)
    else:
        times = recording.time[a] + offsets * grid.interval
        held = np.searchsorted(recording.time, times + 0.5 * grid.interval, side="right") - 1
        place = np.pad((recording.time[a:b] - recording.time[a]) / grid.interval, padding)
    ctrl = recording.ctrl[np.clip(held, 0, len(recording.time) - 1)]
    return measured, weight, state[a], ctrl, np.minimum(place, steps)


class Simulator:
    """A model with candidate effects, simulated over segments.

    Parameters under which no effect looks at the state on the way take one call of C MuJoCo for a
    whole segment, with the effects that would look left out; others take a call a physics substep.

    Attributes:
        effects: The candidate effects; the model's own effects stay as they are.
        slots: The candidate effects' parameters, in the order of `theta`.
        base: `theta` at which no candidate acts, [num_parameters].
    """

    def __init__(self, model: Model, candidates: Sequence[Effect], grid: Grid, refine: int = 1):
        """Compile the model with every candidate.

        Args:
            model: The model under diagnosis.
            candidates: The effects that may be missing, each at its nominal.
            grid: The simulated steps.
            refine: Physics substeps for each of the grid's.
        """
        timestep = Override("option", "", "timestep", grid.timestep / refine)
        model = dataclasses.replace(model, overrides=(*model.overrides, timestep))
        with jax.enable_x64(True):
            self._world = model.compile(extra_effects=tuple(candidates))
        self._num_own = len(self._world.effects) - len(candidates)
        self._substeps = grid.substeps * refine
        self._warm_up = warm_up_steps(grid, self._world.host.model.nu)
        self._on_grid = grid.uniform
        self.effects = tuple(candidates)
        self.slots = tuple(
            Slot(i, p, float(getattr(effect, p.name)))
            for i, effect in enumerate(candidates)
            for p in effect.parameters()
        )
        self.base = np.asarray([slot.base for slot in self.slots])
        looking = [effect.reads_state or effect.notes for effect in candidates]
        self._looks = np.asarray([looking[slot.effect] for slot in self.slots], bool)
        self._blind = [i for i, looks in enumerate(looking) if not looks]
        own = self._world.replace(effects=self._world.effects[: self._num_own])
        self._any_at_once = dynamics.steps_at_once(own)
        self._run, self._run_at_once = (
            jax.jit(jax.vmap(jax.vmap(one, (None, 0, 0, 0)), (0, 0, None, None)))
            for one in (self._predict, self._predict_at_once)
        )

    @property
    def host(self):
        """The compiled MuJoCo model."""
        return self._world.host.model

    def with_parameters(self, theta) -> tuple[Effect, ...]:
        """Return the candidate effects with the values of `theta`, [num_parameters]."""
        values: list[dict] = [{} for _ in self.effects]
        for j, slot in enumerate(self.slots):
            values[slot.effect][slot.parameter.name] = theta[j]
        return tuple(e.replace(**v) for e, v in zip(self.effects, values, strict=True))

    def predict(self, theta: np.ndarray, start: np.ndarray, segments: Segments) -> np.ndarray:
        """Predict every segment's signals.

        Args:
            theta: Parameters, [P, num_parameters].
            start: Initial states, [P, S, nq + nv].
            segments: Commands and sample times.

        Returns:
            Predictions, [P, S, L, num_signals]; not finite where a simulation diverged.
        """
        at_once = np.all((theta == self.base)[:, self._looks], axis=1) & self._any_at_once
        result = np.empty((len(theta), *segments.measured.shape))
        for run, chosen in ((self._run_at_once, at_once), (self._run, ~at_once)):
            rows = np.flatnonzero(chosen)
            widest = next((w for w in BATCH_SIZES if w >= len(rows)), BATCH_SIZES[-1])
            for part in np.split(rows, range(widest, len(rows), widest)):
                result[part] = self._predict_part(run, theta[part], start[part], segments)
        return result

    def _predict_part(self, run, theta, start, segments: Segments) -> np.ndarray:
        """Predict at most the widest batch, padded to a width that is compiled once."""
        num = len(theta)
        if not num:
            return np.empty((0, *segments.measured.shape))
        width = next(w for w in BATCH_SIZES if w >= num)
        repeat = np.minimum(np.arange(width), num - 1)
        with jax.enable_x64(True):
            result = run(theta[repeat], start[repeat], segments.ctrl, segments.place)
            return np.asarray(result)[:num, ..., : segments.measured.shape[2]]

    def _predict_at_once(self, theta, start, ctrl, place):
        """Do as `_predict` without the effects that look at the state."""
        own = self._world.effects[: self._num_own]
        candidates = self.with_parameters(theta)
        world = self._world.replace(effects=own + tuple(candidates[i] for i in self._blind))
        num_position = self.host.nq
        state = dynamics.initial_state(world, start[:num_position], start[num_position:])
        path = dynamics.trajectory(world, state, ctrl, self._substeps, self._warm_up)
        path = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), state, path)
        sensed = jax.vmap(dynamics.sensed, (None, 0))(world, path)
        return self._at_samples(jnp.concatenate([sensed.qpos, sensed.qvel], axis=1), place)

    def _predict(self, theta, start, ctrl, place):
        """Predict what the sensors report of one segment, [L, nq + nv].

        During the warm-up the mechanism is held at its start. It is let go, within a step where
        need be, as long before the first sample as the sensors are late: what they report there
        is then the start, and all that they report later was simulated.
        """
        own = self._world.effects[: self._num_own]
        world = self._world.replace(effects=own + self.with_parameters(theta))
        num_position = self.host.nq
        state = dynamics.initial_state(world, start[:num_position], start[num_position:])
        interval = self._substeps * world.timestep
        late = dynamics.sensor_lag(world) / interval

        def reported(state):
            state = dynamics.sensed(world, state)
            return jnp.concatenate([state.qpos, state.qvel])

        def advance(state, inputs):
            index, command = inputs
            moved = dynamics.move(world, state, command, self._substeps)
            free = jnp.clip(index + 1 - self._warm_up + late, 0.0, 1.0)
            moved = moved._replace(
                qpos=jnp.where(free < 1, state.qpos + free * (moved.qpos - state.qpos), moved.qpos),
                qvel=jnp.where(free < 1, state.qvel + free * (moved.qvel - state.qvel), moved.qvel),
            )
            moved = dynamics.note(world, moved, interval)
            return moved, reported(moved)

        _, path = jax.lax.scan(advance, state, (jnp.arange(len(ctrl)), ctrl))
        path = jnp.concatenate([reported(state)[None], path[self._warm_up :]])
        return self._at_samples(path, place)

    def _at_samples(self, path, place):
        """Interpolate a path on the grid [steps + 1, nq + nv] at the samples."""
        if self._on_grid:
            return path
        below = jnp.minimum(place.astype(int), len(path) - 2)
        fraction = (place - below)[:, None]
        return (1 - fraction) * path[below] + fraction * path[below + 1]


def nearby_starts(segments: Segments, size: float) -> np.ndarray:
    """Return each initial-state component's perturbation, relative to its spread, [nq + nv]."""
    spread = segments.start.std(axis=0)
    return size * np.maximum(spread, 1e-3 * max(float(spread.max()), 1e-3))
