"""Dynamics: a compiled model, its physical effects, and the engine that steps it.

`step` is the one seam between the engines. MJX is the reference: differentiable, for
accelerators. C MuJoCo, called from within the compiled program, is the faster on a CPU.
Effects reach both in the same two ways: as native model fields and as commands and generalised
forces.
"""

import copy
import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from garat_jax._mjx import mjx
from garat_jax.effects.base import OBJECT_TYPES, Effect, ModelView
from garat_jax.engine import HostModel
from garat_jax.errors import UserError, unknown_name
from garat_jax.setconst import CONSTANT_INPUTS, set_const

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


@dataclasses.dataclass(frozen=True)
class Override:
    """One change of a model before it is compiled.

    Attributes:
        element: `body`, `joint`, `geom`, `actuator` or `option`.
        name: The element's name; empty for `option`.
        field: The field of MuJoCo's spec. A body's `mass` scales its inertia with it, whether it
            is given explicitly or comes from the body's geoms.
        value: The new value.
    """

    element: str
    name: str
    field: str
    value: Any

    def apply(self, spec: mujoco.MjSpec) -> None:
        """Write the change into a spec.

        Raises:
            UserError: There is no such element or field.
        """
        target = self._find(spec)
        if self.element == "body" and self.field == "mass":
            _scale_mass(spec, target, float(self.value))
            return
        known = [name for name in dir(target) if not name.startswith("_")]
        if self.field not in known:
            raise unknown_name(f"{self.element} field", self.field, known)
        try:
            current = getattr(target, self.field)
            if jnp.ndim(current) == 1 and jnp.ndim(self.value) == 0:
                current[0] = self.value
            else:
                setattr(target, self.field, self.value)
        except (TypeError, ValueError) as error:
            raise UserError(f"{self.element}/{self.name} {self.field}: {error}") from error

    def _find(self, spec: mujoco.MjSpec):
        if self.element == "option":
            return spec.option
        if self.element not in OBJECT_TYPES:
            raise unknown_name("element", self.element, [*OBJECT_TYPES, "option"])
        target = getattr(spec, self.element)(self.name)
        if target is None:
            listing = {"body": "bodies"}.get(self.element, f"{self.element}s")
            raise unknown_name(self.element, self.name, [e.name for e in getattr(spec, listing)])
        return target


def _scale_mass(spec: mujoco.MjSpec, body, mass: float) -> None:
    """Scale a body's inertial and its geoms: the compiler decides which of them counts."""
    if mass <= 0:
        raise UserError(f"body/{body.name} mass must be positive, not {mass:g} kg")
    ratio = mass / float(spec.copy().compile().body(body.name).mass[0])
    body.mass = body.mass * ratio
    body.inertia = body.inertia * ratio
    body.fullinertia = body.fullinertia * ratio
    for geom in body.geoms:
        if geom.mass > 0:
            geom.mass = geom.mass * ratio
        else:
            geom.density = geom.density * ratio
    compiled = float(spec.copy().compile().body(body.name).mass[0])
    if abs(compiled - mass) > 1e-6 * mass:
        raise UserError(
            f"body/{body.name} mass is {compiled:g} kg whatever is asked for: "
            "settotalmass or boundmass of the model's compiler overrules it"
        )


def load_spec(mjcf: str | Path) -> mujoco.MjSpec:
    """Read an MJCF file.

    Raises:
        UserError: The file is missing or MuJoCo cannot read it.
    """
    path = Path(mjcf)
    if not path.is_file():
        raise UserError(f"{path}: no such model file")
    try:
        return mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise UserError(f"{path}: {' '.join(str(error).split())}") from error


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
        effects: Physical effects to add.
        engine: `mjx`, `mujoco`, or `auto`: C MuJoCo on a CPU and MJX elsewhere.

    Raises:
        UserError: An override or effect does not fit the model, or the engine cannot step it.
    """
    if engine not in ENGINES:
        raise unknown_name("engine", engine, ENGINES)
    if engine == "auto":
        engine = "mujoco" if jax.default_backend() == "cpu" else "mjx"
    spec = spec.copy()
    for override in overrides:
        override.apply(spec)
    for effect in effects:
        effect.check(spec.copy().compile())
        effect.prepare(spec)
    try:
        host = HostModel(spec.compile())
    except ValueError as error:
        raise UserError(f"MuJoCo cannot compile the model: {error}") from error
    model = mjx.put_model(host.model) if engine == "mjx" else None
    as_arrays = jax.tree.map(jnp.asarray, tuple(effects))
    return Dynamics(effects=as_arrays, model=model, host=host, engine=engine)


def view(dynamics: Dynamics) -> ModelView:
    """Return the model's native fields as the effects leave them."""
    if dynamics.engine == "mjx":
        root: Any = dynamics.model
    else:
        root = dynamics.host.model

    def read(name: str) -> jax.Array:
        owner, _, field = name.rpartition(".")
        return jnp.asarray(getattr(getattr(root, owner) if owner else root, field))

    model = ModelView(dynamics.host.model, read)
    for effect in dynamics.effects:
        model = model.replace(effect.fields(model))
    return model


def native_model(dynamics: Dynamics) -> mujoco.MjModel:
    """Return a MuJoCo model with the native fields of the effects written into it.

    What effects do to commands and by forces is not in it: no MuJoCo field says that.
    """
    model = copy.copy(dynamics.host.model)
    changed = view(dynamics).changed
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
        memory=tuple(effect.init(host) for effect in dynamics.effects),
    )
    return note(dynamics, state, 0.0)


def sensed(dynamics: Dynamics, state: PhysicsState) -> PhysicsState:
    """Return the state with the qpos and qvel that the sensors report; `sensordata` stays true.

    The effects' order is the signal's: of a scale before an offset comes scale * q + offset.
    """
    for effect, memory in zip(dynamics.effects, state.memory, strict=True):
        state = effect.sense(dynamics.host.model, state, memory)
    return state


def sensor_lag(dynamics: Dynamics) -> jax.Array | float:
    """Return the seconds by which all sensors are late."""
    return sum((effect.sensor_lag() for effect in dynamics.effects), 0.0)


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
        commands, forces, memory = _commands(dynamics, model, state, ctrl, num_substeps)
        state = _advance(dynamics, constants, state, commands, forces, num_substeps)
        return state._replace(memory=memory)

    def substep(state: PhysicsState, _):
        command, force, memory = _act(dynamics, model, state, ctrl, state.memory)
        state = _advance(dynamics, constants, state, command[None], force[None], 1)
        return state._replace(memory=memory), None

    return jax.lax.scan(substep, state, length=num_substeps)[0]


def steps_at_once(dynamics: Dynamics) -> bool:
    """Say whether `trajectory` can step these dynamics: nothing looks at the state on the way."""
    if dynamics.engine != "mujoco" or dynamics.host.model.na:
        return False
    return not any(effect.reads_state or effect.notes for effect in dynamics.effects)


def trajectory(
    dynamics: Dynamics, state: PhysicsState, ctrl: jax.Array, num_substeps: int, warm_up: int = 0
) -> PhysicsState:
    """Take many control steps in one call of C MuJoCo; see `steps_at_once`.

    Args:
        dynamics: The physics.
        state: Where the first step after the warm-up begins.
        ctrl: Commands, [warm_up + T, nu].
        num_substeps: Physics substeps of a control step.
        warm_up: Commands that fill the effects' memories before the motion begins.

    Returns:
        The states after each of the T control steps; of them only qpos and qvel are new.
    """
    model = view(dynamics)
    constants = _constants(dynamics, model)
    num_steps, host = ctrl.shape[0] - warm_up, dynamics.host

    def control_step(memory, command):
        state_then = state._replace(memory=memory)
        *inputs, memory = _commands(dynamics, model, state_then, command, num_substeps)
        return memory, tuple(inputs)

    _, (commands, forces) = jax.lax.scan(control_step, state.memory, ctrl)
    commands, forces = (x[warm_up:].reshape(-1, x.shape[-1]) for x in (commands, forces))
    path = host.trace(constants, state, commands, forces, num_steps, num_substeps)
    states = jax.tree.map(lambda x: jnp.broadcast_to(x, (num_steps, *x.shape)), state)
    return states._replace(qpos=path[:, : host.model.nq], qvel=path[:, host.model.nq :])


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


def _act(dynamics: Dynamics, model: ModelView, state, ctrl, memories):
    """Apply every effect once: command [nu], generalised force [nv], memories."""
    force = jnp.zeros(dynamics.host.model.nv, ctrl.dtype)
    updated = []
    for effect, memory in zip(dynamics.effects, memories, strict=True):
        ctrl, added, memory = effect.apply(model, state, ctrl, memory)
        force = force if added is None else force + added
        updated.append(memory)
    return ctrl, force, tuple(updated)


def _commands(dynamics: Dynamics, model: ModelView, state, ctrl, num_substeps: int):
    """Return commands [substeps or 1, nu], forces alike [.., nv], and the memory after them."""
    if not any(effect.acts for effect in dynamics.effects):
        return ctrl[None], jnp.zeros((1, dynamics.host.model.nv), ctrl.dtype), state.memory

    def substep(memory, _):
        command, force, memory = _act(dynamics, model, None, ctrl, memory)
        return memory, (command, force)

    memory, (commands, forces) = jax.lax.scan(substep, state.memory, length=num_substeps)
    return commands, forces, memory


def _constants(dynamics: Dynamics, model: ModelView) -> Any:
    """Return what the engine needs of the changed fields: an MJX model, or the fields."""
    if dynamics.engine == "mujoco":
        return model.changed
    options = {n[4:]: v for n, v in model.changed.items() if n.startswith("opt.")}
    fields = {n: v for n, v in model.changed.items() if not n.startswith("opt.")}
    changed = dynamics.model.replace(**fields)  # pyright: ignore[reportOptionalMemberAccess]
    if options:
        changed = changed.replace(opt=changed.opt.replace(**options))
    if CONSTANT_INPUTS & fields.keys():
        changed = set_const(changed, dynamics.host.model)
    return changed


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

    def substep(state: PhysicsState, inputs):
        ctrl, force = inputs
        after = mjx.step(
            constants,
            data.replace(
                time=state.time,
                qpos=state.qpos,
                qvel=state.qvel,
                act=state.act,
                qacc_warmstart=state.qacc_warmstart,
                ctrl=ctrl,
                qfrc_applied=force,
            ),
        )
        kept = {name: getattr(after, name) for name in PhysicsState._fields if name != "memory"}
        return PhysicsState(**kept, memory=state.memory), None

    repeat = (num_substeps, 1)
    inputs = tuple(jnp.tile(x, repeat) if x.shape[0] == 1 else x for x in (commands, forces))
    return jax.lax.scan(substep, state, inputs)[0]
