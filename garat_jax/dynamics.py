"""Dynamics: a compiled model, its physical effects, and the engine that steps it.

`step` is the one seam between the engines. MJX is the reference: differentiable, for
accelerators. C MuJoCo, called from within the compiled program, is the faster on a CPU.
Effects reach both in the same two ways: as native model fields, which may change from one substep
to the next, and as commands and generalised forces.
"""

import copy
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from garat_jax._mjx import mjx
from garat_jax.effects import Effect, ModelView, in_order
from garat_jax.effects.bounds import check_bounds
from garat_jax.engine import HostModel
from garat_jax.errors import unknown_name
from garat_jax.mjx_model import put_model, with_fields
from garat_jax.overrides import Override, compiled
from garat_jax.precision import full_precision
from garat_jax.setconst import CONSTANT_INPUTS

ENGINES = ("auto", "mjx", "mujoco")


class PhysicsState(NamedTuple):
    """The state of one simulation.

    Attributes:
        time: Seconds, [].
        qpos: Generalised position, [nq].
        qvel: Generalised velocity, [nv].
        act: Actuator activation, [na].
        qacc_warmstart: Where the constraint solver starts, [nv].
        sensordata: Sensors at the last substep, [nsensordata].
        memory: What each effect remembers.
    """

    time: jax.Array
    qpos: jax.Array
    qvel: jax.Array
    act: jax.Array
    qacc_warmstart: jax.Array
    sensordata: jax.Array
    memory: tuple


@struct.dataclass
class Dynamics:
    """A model with effects; its leaves are the parameters of the physics.

    Attributes:
        effects: The physical effects beyond the compiled model.
        model: The MJX model, or None when C MuJoCo steps.
        host: The compiled MuJoCo model.
        engine: `mjx` or `mujoco`.
    """

    effects: tuple[Effect, ...]
    model: mjx.Model | None
    host: HostModel = struct.field(pytree_node=False)
    engine: str = struct.field(pytree_node=False)

    @property
    def timestep(self) -> float:
        """Seconds of one physics substep."""
        return self.host.model.opt.timestep


def compile(
    spec: mujoco.MjSpec,
    overrides: tuple[Override, ...] = (),
    effects: tuple[Effect, ...] = (),
    engine: str = "auto",
) -> Dynamics:
    """Compile a model with overrides and effects; the spec itself stays as it is.

    Args:
        spec: MuJoCo's editable model.
        overrides: Changes written into the spec; they pass through the compiler, so that every
            derived constant follows.
        effects: Physical effects to add, in any order; they act `in_order`.
        engine: `mjx`, `mujoco`, or `auto`: C MuJoCo on a CPU and MJX elsewhere.

    Raises:
        UserError: An override or effect does not fit the model, a parameter is outside its bounds,
            or the engine cannot step the model or would ignore a part of it.
    """
    if engine not in ENGINES:
        raise unknown_name("engine", engine, ENGINES)
    if engine == "auto":
        engine = "mujoco" if jax.default_backend() == "cpu" else "mjx"
    spec, effects = spec.copy(), in_order(effects)
    for override in overrides:
        override.apply(spec)
    for effect in effects:
        bare = compiled(spec)
        effect.check(bare)
        check_bounds(effect, bare)
        effect.unlock(spec)
        effect.prepare(spec)
    host = HostModel(compiled(spec))
    model = put_model(host.model) if engine == "mjx" else None
    as_arrays = jax.tree.map(jnp.asarray, effects)
    return Dynamics(effects=as_arrays, model=model, host=host, engine=engine)


@full_precision
def view(dynamics: Dynamics) -> ModelView:
    """Return the model's native fields as the effects leave them."""
    root: Any = dynamics.model if dynamics.engine == "mjx" else dynamics.host.model

    def read(name: str) -> jax.Array:
        owner, _, field = name.rpartition(".")
        return jnp.asarray(getattr(getattr(root, owner) if owner else root, field))

    model = ModelView(dynamics.host.model, read, engine=dynamics.engine)
    for effect in dynamics.effects:
        model = model.replace(effect.fields(model))
    return model


def native_model(dynamics: Dynamics) -> mujoco.MjModel:
    """Return a MuJoCo model with the native fields of the effects written into it.

    What effects do to commands and by forces is not in it: no MuJoCo field says that. Of a field
    that changes with the state it has the part that does not.
    """
    model = copy.copy(dynamics.host.model)
    steady = dynamics.replace(effects=tuple(effect.along_path() for effect in dynamics.effects))
    changed = view(steady).changed
    for name, value in changed.items():
        owner, _, field = name.rpartition(".")
        getattr(model.opt if owner else model, field)[...] = np.asarray(value)
    if CONSTANT_INPUTS & changed.keys():
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def initial_state(dynamics: Dynamics, qpos: jax.Array, qvel: jax.Array) -> PhysicsState:
    """Return the state at rest in memory and activation for a position and velocity."""
    host = dynamics.host.model
    dtype = qpos.dtype
    state = PhysicsState(
        time=jnp.zeros((), dtype),
        qpos=qpos,
        qvel=qvel,
        act=jnp.zeros(host.na, dtype),
        qacc_warmstart=jnp.zeros(host.nv, dtype),
        sensordata=jnp.zeros(host.nsensordata, dtype),
        memory=(),
    )
    return adopt(dynamics, state)


def adopt(dynamics: Dynamics, state: PhysicsState) -> PhysicsState:
    """Return the state of a world with other effects as one of this, whose effects begin anew."""
    memory = tuple(effect.init(dynamics.host.model) for effect in dynamics.effects)
    return note(dynamics, state._replace(memory=memory), 0.0)


def sensed(dynamics: Dynamics, state: PhysicsState) -> PhysicsState:
    """Return the state with the qpos and qvel that the sensors report; `sensordata` stays true.

    A scale acts before an offset: of both comes scale * q + offset.
    """
    for effect, memory in zip(dynamics.effects, state.memory, strict=True):
        state = effect.sense(dynamics.host.model, state, memory)
    return state


def step(
    dynamics: Dynamics, state: PhysicsState, ctrl: jax.Array, num_substeps: int = 1
) -> PhysicsState:
    """Hold a command for some physics substeps, and let the sensors note where that led.

    Args:
        dynamics: The physics.
        state: One simulation's state; batch with `jax.vmap`.
        ctrl: Command, [nu].
        num_substeps: Substeps of the model's timestep.
    """
    state = move(dynamics, state, ctrl, num_substeps)
    return note(dynamics, state, num_substeps * dynamics.timestep)


def move(
    dynamics: Dynamics, state: PhysicsState, ctrl: jax.Array, num_substeps: int = 1
) -> PhysicsState:
    """Do the first half of `step`: no sensor has noted the result yet."""
    model = view(dynamics)
    constants = _constants(dynamics, model)
    if not any(effect.reads_state for effect in dynamics.effects):
        inputs = _commands(dynamics, model, None, state.memory, ctrl, num_substeps)
        commands, forces, memory = inputs
        state = _advance(dynamics, constants, state, commands, forces, num_substeps)
        return state._replace(memory=memory)

    def substep(state: PhysicsState, _):
        tuned, command, force, memory = apply_effects(dynamics, model, state, ctrl, state.memory)
        now = _tuned(dynamics, constants, model, tuned)
        state = _advance(dynamics, now, state, command[None], force[None], 1)
        return state._replace(memory=memory), None

    return jax.lax.scan(substep, state, length=num_substeps)[0]


def hold(
    dynamics: Dynamics, state: PhysicsState, ctrl: jax.Array, num_substeps: int = 1
) -> PhysicsState:
    """Do a `step` in which the mechanism stays where it is, with the velocity that it has.

    Commands that are late get under way, gears bend, actuators are activated and sensors note.
    """
    still = state._replace(qvel=jnp.zeros_like(state.qvel))  # so that gears do not lose it
    *_, memory = _commands(dynamics, view(dynamics), still, state.memory, ctrl, num_substeps)
    held = state._replace(memory=memory)
    if dynamics.host.model.na:
        held = held._replace(act=move(dynamics, state, ctrl, num_substeps).act)
    return note(dynamics, held, num_substeps * dynamics.timestep)


def lead(
    dynamics: Dynamics, state: PhysicsState, ctrl: jax.Array, qpos: jax.Array, qvel: jax.Array
) -> PhysicsState:
    """Do a `step` in which the mechanism is led along a path, whatever moves it.

    Motors turn against the joints that are led, actuators are activated and sensors note.

    Args:
        dynamics: The physics.
        state: One simulation's state; of it the memory goes on, and the activation.
        ctrl: Command, [nu].
        qpos: Positions at the start of the substeps, [num_substeps, nq].
        qvel: Velocities that led there, [num_substeps, nv].
    """
    model = view(dynamics)

    def substep(memory, place):
        now = state._replace(qpos=place[0], qvel=place[1])
        *_, memory = apply_effects(dynamics, model, now, ctrl, memory)
        return memory, None

    memory, _ = jax.lax.scan(substep, state.memory, (qpos, qvel))
    if dynamics.host.model.na:
        state = state._replace(act=move(dynamics, state, ctrl, len(qpos)).act)
    state = state._replace(qpos=qpos[-1], qvel=qvel[-1], memory=memory)
    return note(dynamics, state, len(qpos) * dynamics.timestep)


def steps_at_once(dynamics: Dynamics) -> bool:
    """Say whether one call can take many steps: nothing looks at the state on the way."""
    if dynamics.engine != "mujoco" or dynamics.host.model.na:
        return False
    return not any(effect.reads_state or effect.notes for effect in dynamics.effects)


def trajectory(
    dynamics: Dynamics,
    state: PhysicsState,
    ctrl: jax.Array,
    num_substeps: int,
    warm_up: int = 0,
    along: jax.Array | None = None,
) -> PhysicsState:
    """Take many control steps in one call of C MuJoCo.

    Args:
        dynamics: The physics; see `steps_at_once`.
        state: Where the first step after the warm-up begins.
        ctrl: Commands, [warm_up + T, nu].
        num_substeps: Physics substeps of a control step.
        warm_up: Commands that fill the effects' memories before the motion begins.
        along: qpos and qvel that the effects see in each control step, [warm_up + T, nq + nv],
            instead of those that they lead to: then effects may look at the state, if none tunes
            the model.

    Returns:
        The states after each of the T control steps; of them only qpos and qvel are new.
    """
    model = view(dynamics)
    constants = _constants(dynamics, model)
    num_steps, host, nq = ctrl.shape[0] - warm_up, dynamics.host, dynamics.host.model.nq
    remembering = [i for i, memory in enumerate(state.memory) if jax.tree.leaves(memory)]
    count = max(remembering, default=-1) + 1
    first = dynamics.replace(effects=dynamics.effects[:count])
    then = dynamics.replace(effects=dynamics.effects[count:])

    def look(seen):
        return None if seen is None else state._replace(qpos=seen[:nq], qvel=seen[nq:])

    def control_step(memory, inputs):
        command, seen = inputs
        *results, memory = _commands(first, model, look(seen), memory, command, num_substeps)
        return memory, tuple(results)

    def without_memory(command, force, seen):
        _, command, more, _ = apply_effects(then, model, look(seen), command, state.memory[count:])
        return command, force + more

    if count:
        _, (commands, forces) = jax.lax.scan(control_step, state.memory[:count], (ctrl, along))
    else:
        commands, forces = ctrl[:, None], jnp.zeros((len(ctrl), 1, host.model.nv), ctrl.dtype)
    in_substeps = jax.vmap(without_memory, (0, 0, None))
    commands, forces = jax.vmap(in_substeps)(commands, forces, along)
    commands, forces = (
        x[warm_up:].reshape(num_steps * x.shape[1], x.shape[2]) for x in (commands, forces)
    )
    path = host.trace(constants, state, commands, forces, num_steps, num_substeps)
    states = jax.tree.map(lambda x: jnp.broadcast_to(x, (num_steps, *x.shape)), state)
    return states._replace(qpos=path[:, :nq], qvel=path[:, nq:])


def note(dynamics: Dynamics, state: PhysicsState, seconds: float) -> PhysicsState:
    """Let every sensor note the state at the end of a control step of so many seconds."""
    if not any(effect.notes for effect in dynamics.effects):
        return state
    host, reported, memories = dynamics.host.model, state, []
    for effect, memory in zip(dynamics.effects, state.memory, strict=True):
        memory = effect.note(host, reported, seconds, memory)
        reported = effect.sense(host, reported, memory)
        memories.append(memory)
    return state._replace(memory=tuple(memories))


@full_precision
def apply_effects(dynamics: Dynamics, model: ModelView, state, ctrl, memories):
    """Apply every effect once: model, command [nu], generalised force [nv], memories."""
    force = jnp.zeros(dynamics.host.model.nv, ctrl.dtype)
    updated = []
    for effect, memory in zip(dynamics.effects, memories, strict=True):
        if effect.tunes:
            model = model.replace(effect.tune(model, state._replace(memory=memory), ctrl))
        ctrl, added, memory = effect.apply(model, state, ctrl, memory)
        force = force if added is None else force + added
        updated.append(memory)
    return model, ctrl, force, tuple(updated)


def _commands(dynamics: Dynamics, model: ModelView, seen, memory, ctrl, num_substeps: int):
    """Return commands [substeps or 1, nu], forces alike [.., nv], and the memory after them.

    `seen` is the state that effects see in all of the substeps, None if none looks at it.
    """
    if not any(effect.acts for effect in dynamics.effects):
        return ctrl[None], jnp.zeros((1, dynamics.host.model.nv), ctrl.dtype), memory

    def substep(memory, _):
        _, command, force, memory = apply_effects(dynamics, model, seen, ctrl, memory)
        return memory, (command, force)

    memory, (commands, forces) = jax.lax.scan(substep, memory, length=num_substeps)
    return commands, forces, memory


def _constants(dynamics: Dynamics, model: ModelView) -> Any:
    """Return what the engine needs of the changed fields: an MJX model, or the fields."""
    if dynamics.engine == "mujoco":
        return model.changed
    return with_fields(dynamics.model, dynamics.host.model, model.changed)  # pyright: ignore[reportArgumentType]


def _tuned(dynamics: Dynamics, constants: Any, model: ModelView, tuned: ModelView) -> Any:
    """Return `constants` with the fields that `Effect.tune` has replaced."""
    fields = {n: v for n, v in tuned.changed.items() if model.changed.get(n) is not v}
    if dynamics.engine == "mujoco":
        return {**constants, **fields}
    return constants.replace(**fields)


@full_precision
def _advance(
    dynamics: Dynamics,
    constants: Any,
    state: PhysicsState,
    commands: jax.Array,
    forces: jax.Array,
    num_substeps: int,
) -> PhysicsState:
    if dynamics.engine == "mujoco":
        return dynamics.host.advance(constants, state, commands, forces, num_substeps)
    data = mjx.make_data(dynamics.host.model)
    stepped = [name for name in PhysicsState._fields if name != "memory"]

    def substep(state: PhysicsState, inputs):
        ctrl, force = inputs
        before = {name: getattr(state, name) for name in stepped}
        after = mjx.step(constants, data.replace(**before, ctrl=ctrl, qfrc_applied=force))
        return state._replace(**{name: getattr(after, name) for name in stepped}), None

    inputs = [jnp.broadcast_to(x, (num_substeps, x.shape[1])) for x in (commands, forces)]
    return jax.lax.scan(substep, state, inputs)[0]
