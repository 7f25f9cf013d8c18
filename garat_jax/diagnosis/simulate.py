"""Simulate every segment of the recordings, for many parameters and initial states, in one call.

One compiled model holds every candidate effect at its nominal value, which is the identity; fitting
and scoring move its leaves.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from garat_jax import dynamics
from garat_jax.diagnosis.model_card import Model
from garat_jax.diagnosis.segments import Grid, Segments, warm_up_steps
from garat_jax.dynamics import Override
from garat_jax.effects import Effect, Parameter

BATCH_SIZES = (1, 4, 16)
"""Each width of a batch is compiled once, so widths are rounded up to one of these."""


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


class Simulator:
    """A model with candidate effects, simulated over segments.

    Parameters under which no effect looks at the state on the way take one call of C MuJoCo for a
    whole segment. Others take a call a physics substep, in a program of its own for each set of
    effects that act.

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
        self._own = self._world.effects[: len(self._world.effects) - len(candidates)]
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
        self._owner = np.asarray([slot.effect for slot in self.slots], int)
        looking = [i for i, e in enumerate(candidates) if e.reads_state or e.notes]
        self._blind = tuple(i for i in range(len(candidates)) if i not in looking)
        self._along = tuple(i for i in looking if self._is_memoryless(candidates[i]))
        own = self._world.replace(effects=self._own)
        self._any_at_once = dynamics.steps_at_once(own)
        self._programs: dict[tuple[str, tuple[int, ...]], Callable] = {}

    @property
    def host(self):
        """The compiled MuJoCo model."""
        return self._world.host.model

    def _is_memoryless(self, effect: Effect) -> bool:
        return not effect.notes and not jax.tree.leaves(effect.init(self.host))

    def predict(self, theta: np.ndarray, start: np.ndarray, segments: Segments) -> np.ndarray:
        """Predict every segment's signals.

        Args:
            theta: Parameters, [P, num_parameters].
            start: Initial states, [P, S, nq + nv].
            segments: Commands and sample times.

        Returns:
            Predictions, [P, S, L, num_signals]; not finite where a simulation diverged.
        """
        result = np.empty((len(theta), *segments.measured.shape))
        at_once = np.asarray([self._is_at_once(row) for row in theta])
        for rows in (np.flatnonzero(at_once), np.flatnonzero(~at_once)):
            if len(rows):
                run = self._program(theta[rows])
                result[rows] = self._in_parts(run, segments, theta[rows], start[rows])[0]
        return result

    def linear_change(
        self, theta: np.ndarray, base: np.ndarray, start: np.ndarray, segments: Segments
    ) -> np.ndarray:
        """Predict how small effects change the signals, by the cheapest way for each.

        An effect that looks at the state, without memory, is given the path that the model takes
        without it, so that a whole segment is one call; to first order that is the same.

        Args:
            theta: Parameters, [P, num_parameters].
            base: Parameters from which the change is counted, [num_parameters].
            start: Initial states, [S, nq + nv].
            segments: Commands and sample times.

        Returns:
            Changes of the predictions, [P, S, L, num_signals].
        """
        moved = [set(self._owner[row != base].tolist()) for row in theta]
        kinds = [{self.effects[i].kind for i in effects} for effects in moved]
        cheap = np.asarray([self._any_at_once and m <= {*self._blind, *self._along} for m in moved])
        looks = cheap & np.asarray([not m <= {*self._blind} for m in moved])
        starts = np.broadcast_to(start, (len(theta), *start.shape))
        now, path = self._in_parts(self._program(base[None]), segments, base[None], start[None])
        result = np.empty((len(theta), *segments.measured.shape))
        exact = np.flatnonzero(~looks)
        for kind in dict.fromkeys(k for i in exact for k in kinds[i]):
            rows = [i for i in exact if kind in kinds[i] and not cheap[i]]
            if rows:
                result[rows] = self.predict(theta[rows], starts[rows], segments) - now
        rows = np.flatnonzero(cheap & ~looks)
        result[rows] = self.predict(theta[rows], starts[rows], segments) - now
        rows = np.flatnonzero(looks)
        if len(rows):
            run = self._jitted(("along", ()), self._predict_along, 3)
            both = np.concatenate([base[None], theta[rows]])
            changed = self._in_parts(run, segments, both, starts[: len(both)], path[0])[0]
            result[rows] = changed[1:] - changed[0]
        return result

    def _is_at_once(self, theta: np.ndarray) -> bool:
        acting = set(self._owner[theta != self.base].tolist())
        return self._any_at_once and acting <= {*self._blind}

    def _program(self, thetas: np.ndarray) -> Callable:
        """Return the compiled program for parameters [P, num_parameters] that go together."""
        if all(self._is_at_once(theta) for theta in thetas):
            return self._jitted(("at once", ()), self._predict_at_once, 2)
        acting = self._owner[np.any(thetas != self.base, axis=0)]
        chosen = tuple(int(i) for i in np.unique(acting))
        return self._jitted(("stepped", chosen), functools.partial(self._predict, chosen), 2)

    def _jitted(self, key, function, num_by_segment: int) -> Callable:
        if key not in self._programs:
            by_segment = (None, 0) + (0,) * num_by_segment
            by_row = (0, 0) + (None,) * num_by_segment
            self._programs[key] = jax.jit(jax.vmap(jax.vmap(function, by_segment), by_row))
        return self._programs[key]

    def _in_parts(self, run, segments: Segments, theta, start, *more):
        """Run a program on rows [P] in batches of a width that is compiled once."""
        widest = next((w for w in BATCH_SIZES if w >= len(theta)), BATCH_SIZES[-1])
        found, paths = [], []
        for first in range(0, len(theta), widest):
            rows = np.minimum(np.arange(first, first + widest), len(theta) - 1)
            kept = slice(0, len(theta) - first)
            with jax.enable_x64(True):
                result = run(theta[rows], start[rows], segments.ctrl, segments.place, *more)
                found.append(np.asarray(result[0])[kept, ..., : segments.measured.shape[2]])
                paths.append(result[1])
        return np.concatenate(found), paths[0]

    def with_parameters(self, theta) -> tuple[Effect, ...]:
        """Return the candidate effects with the values of `theta`, [num_parameters]."""
        values: list[dict] = [{} for _ in self.effects]
        for j, slot in enumerate(self.slots):
            values[slot.effect][slot.parameter.name] = theta[j]
        return tuple(e.replace(**v) for e, v in zip(self.effects, values, strict=True))

    def _world_with(self, theta, chosen: Sequence[int]) -> dynamics.Dynamics:
        """Return the model with some of the candidates, at the values of `theta`."""
        candidates = self.with_parameters(theta)
        return self._world.replace(effects=(*self._own, *(candidates[i] for i in chosen)))

    def _begin(self, world: dynamics.Dynamics, start):
        num_position = self.host.nq
        return dynamics.initial_state(world, start[:num_position], start[num_position:])

    def _predict_at_once(self, theta, start, ctrl, place):
        """Predict one segment with the candidates that do not look at the state."""
        world = self._world_with(theta, self._blind)
        return self._trace(world, start, ctrl, place, None)

    def _predict_along(self, theta, start, ctrl, place, path):
        """Predict one segment with candidates that look at a path [T + 1, nq + nv] instead."""
        world = self._world_with(theta, (*self._blind, *self._along))
        between = (path[:-1] + path[1:]) / 2
        before = jnp.broadcast_to(path[0], (self._warm_up, *path.shape[1:]))
        return self._trace(world, start, ctrl, place, jnp.concatenate([before, between]))

    def _trace(self, world: dynamics.Dynamics, start, ctrl, place, along):
        state = self._begin(world, start)
        states = dynamics.trajectory(world, state, ctrl, self._substeps, self._warm_up, along)
        states = jax.tree.map(lambda x, rest: jnp.concatenate([x[None], rest]), state, states)
        sensed = jax.vmap(dynamics.sensed, (None, 0))(world, states)
        signals, true = (jnp.concatenate([s.qpos, s.qvel], axis=1) for s in (sensed, states))
        return self._at_samples(signals, place), true

    def _predict(self, chosen: tuple[int, ...], theta, start, ctrl, place):
        """Predict one segment step by step: what the sensors report, and the path on the grid.

        During the warm-up the mechanism is held at its start. It is let go, within a step where
        need be, as long before the first sample as the sensors are late: what they report there
        is then the start, and all that they report later was simulated.
        """
        world = self._world_with(theta, chosen)
        state = self._begin(world, start)
        interval = self._substeps * world.timestep
        late = dynamics.sensor_lag(world) / interval

        def whole(state):
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
            return moved, (whole(dynamics.sensed(world, moved)), whole(moved))

        _, paths = jax.lax.scan(advance, state, (jnp.arange(len(ctrl)), ctrl))
        firsts = (whole(dynamics.sensed(world, state)), whole(state))
        signals, true = (
            jnp.concatenate([first[None], path[self._warm_up :]])
            for first, path in zip(firsts, paths, strict=True)
        )
        return self._at_samples(signals, place), true

    def _at_samples(self, path, place):
        """Interpolate a path on the grid [steps + 1, nq + nv] at the samples."""
        if self._on_grid:
            return path
        below = jnp.minimum(place.astype(int), len(path) - 2)
        fraction = (place - below)[:, None]
        return (1 - fraction) * path[below] + fraction * path[below + 1]
