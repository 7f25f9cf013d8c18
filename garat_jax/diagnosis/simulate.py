"""Simulate every segment of the recordings, for many parameters and initial states, in one call.

A program holds the candidate effects that act in it, on a model that is compiled for them, and
moves their leaves; at its nominal value an effect is the identity, so that programs agree.
"""

import dataclasses
import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from garat_jax import dynamics
from garat_jax.compiler_options import options_of_replay
from garat_jax.diagnosis.activation import Follower
from garat_jax.diagnosis.batches import Batches, Program, compile_together
from garat_jax.diagnosis.model_card import Model
from garat_jax.diagnosis.past import (
    Past,
    activation_before,
    has_memory_of_motion,
    lead_steps,
    way_to,
)
from garat_jax.diagnosis.segments import Grid, Segments, warm_up_steps
from garat_jax.diagnosis.slots import Slot, columns_of
from garat_jax.dynamics import Override
from garat_jax.effects import Effect, in_order, parameter_at
from garat_jax.errors import UserError

NUM_PROGRAMS, NUM_FINER = 40, 4
"""How many programs stay compiled: on a CPU one takes some 250 of a process's 65,530 memory maps,
and a diagnosis has two simulators, of up to two batch sizes a program, and seven finer ones."""
FEW = 4
"""Candidates up to which a program with calls a substep is optimised. In those that fit them, which
run often, few act; in those of screening, which run a few times, as many as a model has places for
them. One of whole segments in which nothing looks at the state is optimised always: memories of
commands would take most of its time."""


class Simulator:
    """A model with candidate effects, simulated over segments.

    Parameters under which no effect looks at the state on the way take one call of C MuJoCo for a
    whole segment. Others take a call a physics substep, in a program of its own for each set of
    effects that act.

    Attributes:
        effects: The candidate effects; the model's own effects stay as they are.
        slots: The candidate effects' parameters, in the order of `theta`.
        base: `theta` at which no candidate acts but those that did before, [num_parameters].
        acting: Indices of these.
    """

    def __init__(
        self,
        model: Model,
        candidates: Sequence[Effect],
        grid: Grid,
        refine: int = 1,
        acting: Sequence[int] = (),
    ):
        """Compile the model; with candidates it is compiled when they first act together.

        Args:
            model: The model under diagnosis.
            candidates: The effects that may be missing, each at its nominal.
            grid: The simulated steps.
            refine: Physics substeps for each of the grid's.
            acting: Indices of candidates that are not at their nominal, and act as they are.
        """
        timestep = Override("option", "", "timestep", grid.timestep / refine)
        spec = model.spec.copy()
        for effect in candidates:
            effect.unlock(spec)
        overrides = (*model.overrides, timestep)
        self._model = dataclasses.replace(model, spec=spec, overrides=overrides)
        made = functools.partial(Simulator, model, candidates, grid, acting=acting)
        self._refined = functools.cache(lambda factor: made(refine * factor))
        self.effects = tuple(candidates)
        self._alone = self._compile(())
        self._substeps = grid.substeps * refine
        self._warm_up = warm_up_steps(grid, self.host.nu)
        self._grid = grid
        self.slots = tuple(
            Slot(i, parameter_at(p, self.host, effect.target), float(getattr(effect, p.name)))
            for i, effect in enumerate(candidates)
            for p in effect.parameters()
        )
        self.base = np.asarray([slot.base for slot in self.slots])
        self._columns = [columns_of(self.slots, i) for i in range(len(candidates))]
        self._owner = np.asarray([slot.effect for slot in self.slots], int)
        self.acting = {*acting}
        replayed = [effect.as_replayed() for effect in candidates]
        looking = [i for i, e in enumerate(replayed) if e.reads_state or e.notes]
        self._blind = tuple(i for i in range(len(candidates)) if i not in looking)
        self._memoryless = tuple(i for i in looking if self._is_memoryless(replayed[i]))
        self._plain = tuple(i for i in self._blind if self._is_memoryless(replayed[i]))
        self._transform = model.transform
        lasts = model.interval if model.transform else None
        self._num_held = max(1, round((lasts or 0.0) / grid.interval))
        self._follower = Follower(self.host, grid.interval)
        self._any_at_once = dynamics.steps_at_once(self._alone) and model.transform is None
        self._jitted = functools.lru_cache(NUM_PROGRAMS if refine <= 2 else NUM_FINER)(self._jit)

    @property
    def host(self):
        """The compiled MuJoCo model, without candidates."""
        return self._alone.host.model

    def refined(self, factor: int) -> "Simulator":
        """Return the same with `factor` physics substeps in place of each, compiled once."""
        return self._refined(factor)

    def _compile(self, chosen: tuple[int, ...]) -> dynamics.Dynamics:
        """Return the model's own effects on the model as it is compiled for some candidates.

        What a candidate needs of the model, a friction's row or a payload's body, costs time in
        every step, whether it acts or not.
        """
        with jax.enable_x64(True):
            world = self._model.compile(extra_effects=[self.effects[i] for i in chosen])
            own = jax.tree.map(jnp.asarray, self._model.effects)
        return world.replace(effects=tuple(effect.as_replayed() for effect in own))

    @staticmethod
    def _is_memoryless(effect: Effect) -> bool:
        return not effect.notes and type(effect).init is Effect.init

    def predict(self, theta: np.ndarray, start: np.ndarray, segments: Segments) -> np.ndarray:
        """Predict every segment's signals.

        Args:
            theta: Parameters, [P, num_parameters] or, each segment its own, [P, S, ..].
            start: Initial states, [P, S, nq + nv].
            segments: Commands and sample times.

        Returns:
            Predictions, [P, S, L, num_signals]; not finite where a simulation diverged, but for
            padding: beyond a recording's end that says nothing.
        """
        result = np.empty((len(theta), *segments.measured.shape))
        at_once = np.asarray([self._is_at_once(row) for row in theta], bool)
        for rows in (np.flatnonzero(at_once), np.flatnonzero(~at_once)):
            if len(rows):
                run = self._program(self._acting(theta[rows]))
                result[rows] = self._batches(run, segments, theta[rows], start[rows]).run()[0]
        is_told = (segments.weight[..., None] > 0) | np.isfinite(result)
        return np.where(is_told, result, segments.measured)

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

        Raises:
            UserError: An effect at its nominal lets no simulation stay finite.
        """
        result = np.empty((len(theta), *segments.measured.shape))
        program = self._program(self._acting(base[None]))
        alone, path = self._batches(program, segments, base[None], start[None]).run()
        calls = []
        for (way, more), rows in self._ways(theta, base).items():
            both = np.concatenate([base[None], theta[rows]])
            starts = np.broadcast_to(start, (len(both), *start.shape))
            chosen = self._acting(both)
            if way == "at once":  # a program for all that are plain, one for all that are blind
                chosen = self._blind if more else self._plain
            if way == "along":
                run, along = self._jitted("along", chosen), path[0]
            else:
                run, along = self._program(chosen), None
            calls.append((rows, chosen, self._batches(run, segments, both, starts, along)))
        compile_together([batches for *_, batches in calls])
        for rows, chosen, batches in calls:
            changed = batches.run()[0]
            if _any_stays_finite(alone[0]) and not _any_stays_finite(changed[0]):
                raise self._unstable(chosen, base, start, segments)
            result[rows] = changed[1:] - changed[0]
        return result

    def _unstable(self, chosen: Sequence[int], base, start, segments: Segments) -> UserError:
        """Name, of some effects, the one with which no simulation stays finite at its nominal."""

        def stays_finite(i: int) -> bool:
            program = self._program((i,))
            signals, _ = self._batches(program, segments, base[None], start[None]).run()
            return _any_stays_finite(signals[0])

        effect = self.effects[next((i for i in chosen if not stays_finite(i)), chosen[0])]
        named = f"{effect.kind} at {effect.target}"
        return UserError(f"no simulation with {named} stays finite, even at its nominal")

    def _ways(self, theta: np.ndarray, base: np.ndarray) -> dict[tuple[str, str], list[int]]:
        """Sort rows by how their change is had, and by what more sets programs apart.

        That is what moves that looks at the state, or that something has a memory of commands.
        """
        ways: dict[tuple[str, str], list[int]] = {}
        blind, memoryless = {*self._blind}, {*self._blind, *self._memoryless}
        for i, row in enumerate(theta):
            moved = {*self._owner[row != base].tolist()}
            kinds = " ".join(sorted({self.effects[j].kind for j in moved - blind}))
            acting = {*self._acting(np.stack([base, row]))}
            if self._any_at_once and acting <= blind:
                way = ("at once", "" if acting <= {*self._plain} else "with a memory")
            elif self._any_at_once and moved <= memoryless and acting <= memoryless:
                way = ("along", kinds)
            else:
                way = ("stepped", kinds)
            ways.setdefault(way, []).append(i)
        return ways

    def _acting(self, thetas: np.ndarray) -> tuple[int, ...]:
        """Return the effects that act under some row of parameters [.., num_parameters]."""
        rows = tuple(range(thetas.ndim - 1))
        moved = self._owner[np.any(thetas != self.base, axis=rows)].tolist()
        return tuple(sorted({*moved, *self.acting}))

    def _is_at_once(self, theta: np.ndarray) -> bool:
        return self._any_at_once and {*self._acting(theta[None])} <= {*self._blind}

    def _program(self, chosen: tuple[int, ...]) -> Program:
        """Return the compiled program in which these candidates act."""
        if self._any_at_once and {*chosen} <= {*self._blind}:
            return self._jitted("at once", chosen)
        return self._jitted("stepped", chosen)

    def _jit(self, way: str, chosen: tuple[int, ...]) -> Program:
        """Return a program that is compiled when it first runs."""
        predict = {
            "at once": self._predict_at_once,
            "along": self._predict_along,
            "stepped": self._predict,
        }[way]
        world = self._compile(chosen)
        acting = (*world.effects, *(self.effects[i] for i in chosen))
        looks_back = any(effect.remembers for effect in acting)
        looks_back |= way == "stepped" and has_memory_of_motion(acting, self.host)
        looks_back |= self.host.na > 0
        one = functools.partial(predict, world, chosen)
        past = Past._make((None, None, None, 0, 0)) if looks_back else None
        axes = (0, 0, 0, 0, past, 0)[: 6 if way == "along" else 5]
        runs_often = way == "at once" or len(chosen) <= FEW
        options = options_of_replay(self._alone.engine, runs_often)
        run = jax.jit(jax.vmap(one, axes), compiler_options=options)
        return Program(run, looks_back, self._substeps if way == "stepped" else 0)

    def _batches(self, program: Program, segments: Segments, theta, start, path=None) -> Batches:
        """Lay out the batches of a program; see `Batches`."""
        activations = self._follower(segments.begins, segments.past)
        return Batches(program, segments, activations, theta, start, path)

    def with_parameters(self, theta, chosen: Sequence[int]) -> tuple[Effect, ...]:
        """Return some of the candidates with the values of `theta`, [num_parameters]."""
        return tuple(
            self.effects[i].replace(**{n: theta[j] for n, j in self._columns[i].items()})
            for i in chosen
        )

    def _with(self, world: dynamics.Dynamics, chosen: Sequence[int], theta) -> dynamics.Dynamics:
        """Return a world with some of the candidates, at the values of `theta`."""
        acting = (effect.as_replayed() for effect in self.with_parameters(theta, chosen))
        return world.replace(effects=in_order((*world.effects, *acting)))

    def _begin(self, world: dynamics.Dynamics, start, past, num_before: int):
        """Return a segment's start, remembering all commands but the last `num_before`."""
        num_position = self.host.nq
        state = dynamics.initial_state(world, start[:num_position], start[num_position:])
        remembers = any(effect.remembers for effect in world.effects)
        if self.host.na:
            since = past.num_steps if remembers else num_before
            state = state._replace(act=activation_before(past, since))
        if not remembers:
            return state

        def remember(k, state):
            return dynamics.hold(world, state, past.ctrl[past.recording, k], self._substeps)

        return jax.lax.fori_loop(0, past.num_steps - num_before, remember, state)

    def _predict_at_once(self, world, chosen: tuple[int, ...], theta, start, ctrl, place, past):
        """Predict one segment with candidates that do not look at the state."""
        world = self._with(world, chosen, theta)
        return self._trace(world, start, ctrl, place, past, None)

    def _predict_along(self, world, chosen, theta, start, ctrl, place, past, path):
        """Predict one segment with candidates that look at a path [T + 1, nq + nv] instead."""
        world = self._with(world, chosen, theta)
        world = world.replace(effects=tuple(effect.along_path() for effect in world.effects))
        between = (path[:-1] + path[1:]) / 2
        before = jnp.broadcast_to(path[0], (self._warm_up, *path.shape[1:]))
        return self._trace(world, start, ctrl, place, past, jnp.concatenate([before, between]))

    def _trace(self, world: dynamics.Dynamics, start, ctrl, place, past, along):
        state = self._begin(world, start, past, self._warm_up)
        states = dynamics.trajectory(world, state, ctrl, self._substeps, self._warm_up, along)
        states = jax.tree.map(lambda x, rest: jnp.concatenate([x[None], rest]), state, states)
        sensed = jax.vmap(dynamics.sensed, (None, 0))(world, states)
        signals, true = (jnp.concatenate([s.qpos, s.qvel], axis=1) for s in (sensed, states))
        return self._at_samples(signals, place), true

    def _predict(self, world, chosen: tuple[int, ...], theta, start, ctrl, place, past):
        """Predict one segment step by step: what the sensors report, and the path on the grid.

        During the warm-up it is held at its start. Motors behind gears that bend swing for longer
        than a segment: with a memory of the motion it is then led along the measured one.

        An action transformer acts as it was learned: once in about `Model.interval`, counted from
        the segment's start, on the mean of the commands until it acts again, and what it sends is
        held.
        """
        world = self._with(world, chosen, theta)
        leads = has_memory_of_motion(world.effects, self.host)
        num_before = self._warm_up + (lead_steps(self._grid) if leads else 0)
        state = self._begin(world, start, past, num_before)
        if self._num_held > 1:
            ctrl = self._held_means(ctrl)

        def whole(state):
            return jnp.concatenate([state.qpos, state.qvel])

        def commanded(state, command):
            if self._transform is None:
                return command
            sent = self._transform(whole(dynamics.sensed(world, state)), command)
            return sent.astype(command.dtype)

        def since_begun(has_begun, new, old):
            if not self.host.na:  # an integrator would go on with the first command
                return new
            return new._replace(act=jnp.where(has_begun, new.act, old.act))

        def hold(state, step):
            command, has_begun = step
            held = dynamics.hold(world, state, commanded(state, command), self._substeps)
            return since_begun(has_begun, held, state), None

        def lead(state, step):
            (command, *path), has_begun = step
            led = dynamics.lead(world, state, commanded(state, command), *path)
            return since_begun(has_begun, led, state), None

        def advance(carry, step):
            (state, sent), (command, acts) = carry, step
            wanted = commanded(state, command)
            sent = wanted if self._num_held == 1 else jnp.where(acts, wanted, sent)
            state = dynamics.step(world, state, sent, self._substeps)
            return (state, sent), (whole(dynamics.sensed(world, state)), whole(state))

        looks_back = leads or self.host.na > 0
        steps = (past.num_steps if looks_back else num_before) - num_before + np.arange(num_before)
        before, after = steps[: self._warm_up], steps[self._warm_up :]
        warm_up = past.ctrl[past.recording, jnp.maximum(before, 0)] if leads else ctrl
        state, _ = jax.lax.scan(hold, state, (warm_up[: self._warm_up], before >= 0))
        if leads:
            way = way_to(start, past, self.host, self._grid, self._substeps)
            state, _ = jax.lax.scan(lead, state, (way, after >= 0))
        during = ctrl[self._warm_up :]
        acts = np.arange(len(during)) % self._num_held == 0
        _, paths = jax.lax.scan(advance, (state, during[0]), (during, acts))
        firsts = (whole(dynamics.sensed(world, state)), whole(state))
        signals, true = (
            jnp.concatenate([first[None], path]) for first, path in zip(firsts, paths, strict=True)
        )
        return self._at_samples(signals, place), true

    def _held_means(self, ctrl):
        """Return commands [warm_up + steps, nu] as means over the steps that one is held for."""
        number = (np.arange(len(ctrl)) - self._warm_up) // self._num_held
        number -= number[0]
        sums = jax.ops.segment_sum(ctrl, number, number[-1] + 1)
        return (sums / np.bincount(number)[:, None])[number]

    def _at_samples(self, path, place):
        """Interpolate a path on the grid [steps + 1, nq + nv] at the samples."""
        if self._grid.uniform:
            return path
        below = jnp.minimum(place.astype(int), len(path) - 2)
        fraction = (place - below)[:, None]
        return (1 - fraction) * path[below] + fraction * path[below + 1]


def _any_stays_finite(signals: np.ndarray) -> bool:
    """Say whether the prediction of any segment is finite to its end, [S, L, num_signals]."""
    return bool(np.isfinite(signals).all(axis=(1, 2)).any())
