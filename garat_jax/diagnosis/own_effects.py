"""A mistake in a user's own effect is one line that names the effect, its file and where in it."""

import contextlib
import functools
import inspect
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from garat_jax.dynamics import Dynamics, PhysicsState, compile, initial_state, step, view
from garat_jax.effects import CATALOGUE, Effect, Suggestion
from garat_jax.effects.base import ModelView
from garat_jax.effects.catalogue import line_in
from garat_jax.engine import HostModel
from garat_jax.errors import UserError, nearest, unknown_name
from garat_jax.overrides import Override

CLOSE = 1e-5
"""By which part of the largest of its kind a law without effect may change a number."""
TRIALS, STEPS = 8, 3
"""States that a law without effect is tried at, and commands in a row at each."""


def is_own(effect: Effect | type[Effect]) -> bool:
    """Say whether an effect, or a kind of effect, is none of the built-in catalogue."""
    cls = effect if isinstance(effect, type) else type(effect)
    return cls is not CATALOGUE.get(cls.kind)


def everywhere(cls: type[Effect], host: mujoco.MjModel) -> list[Effect]:
    """Make a kind of effect at every place of a model, each without effect.

    Args:
        cls: The kind.
        host: The compiled model.

    Raises:
        UserError: It is a user's own, and fails at that or at telling sizes to try.
    """
    made: list[Effect] = []
    with _named(cls) if is_own(cls) else contextlib.nullcontext():
        for target in cls.targets(host):
            made.append(cls(target=target, **cls.at(host, target)))
            if is_own(cls):
                _check_choices(made[-1], host)
    return made


def try_own(
    spec: mujoco.MjSpec, overrides: tuple[Override, ...], effects: Sequence[Effect]
) -> None:
    """Try each effect of the user's own in a model that has no other.

    It is traced through one step, and computed where its parameters mean "no effect".

    Raises:
        UserError: One fails, in whatever way, returns what is of another shape than it should be,
            changes something without effect, or tells no sizes at which to try it.
    """
    for effect in filter(is_own, effects):
        with _named(effect):
            try:
                alone = compile(spec, overrides, (effect,), "mujoco")
            except UserError:
                continue  # it may need another effect; compiling all of them says what is amiss
            _check_choices(effect, alone.host.model)
            # Functions of their own: JAX would take a law that was read anew for the one before.
            jax.eval_shape(lambda world: _check_shapes(world), alone)
            jax.eval_shape(lambda world: _one_step(world), alone)
            check_identity(alone.host, type(effect), effect.target)


def try_choices(effects: Sequence[Effect], host: mujoco.MjModel) -> None:
    """Ask each effect of the user's own for sizes to try it at, and what it excludes.

    Raises:
        UserError: One fails at that, or tells no sizes.
    """
    for effect in filter(is_own, effects):
        with _named(effect):
            _check_choices(effect, host)


def asked(effect: Effect, method: str, *seen: Any) -> Suggestion | None:
    """Return what an effect's `suggested` or `suggested_by_commands` says of what was seen.

    Raises:
        UserError: It is a user's own, and fails, or returns anything but sizes at which to try it.
    """
    suggest = getattr(effect, method)
    if not is_own(effect):
        return suggest(*seen)
    with _named(effect):
        answer = suggest(*seen)
        if answer is None:
            return None
        if not isinstance(answer, Suggestion):
            what = f"{method} returns something else than a Suggestion or None"
            raise _mistake(effect, method, what)
        if not isinstance(answer.num_tried, int | np.integer) or answer.num_tried < 0:
            what = (
                f"{method} has num_tried = {answer.num_tried!r}; expected how many were looked at"
            )
            raise _mistake(effect, method, what)
        _check_sizes(effect, method, answer.starts)
        return answer


@functools.lru_cache(maxsize=1000)
def check_identity(compiled: HostModel, cls: type[Effect], target: str) -> None:
    """Refuse a law that changes something where its parameters mean "no effect".

    What `prepare` does, and to what it adds, is left to it.

    Args:
        compiled: A model that is compiled for the effect, with its overrides.
        cls: The kind of effect.
        target: Where it acts.

    Raises:
        UserError: It changes a field of the model, a command or a sensor, or adds a force.
    """
    host = compiled.model
    nominal = cls.at(host, target)
    effect = cls(target=target, **{name: jnp.asarray(v) for name, v in nominal.items()})
    alone = Dynamics((effect,), None, compiled, "mujoco")
    rng = np.random.default_rng(0)
    low, high = _command_range(host)
    ctrl = rng.uniform(low, high, (TRIALS, STEPS, host.nu))
    qvel = rng.normal(size=(TRIALS, host.nv))
    qpos = np.repeat(host.qpos0[None], TRIALS, axis=0)
    for place, velocity in zip(qpos, qvel, strict=True):
        mujoco.mj_integratePos(host, place, velocity, 0.3)
    trials = (jnp.asarray(x, jnp.float32) for x in (qpos, qvel, ctrl))
    done = jax.jit(jax.vmap(functools.partial(_done_by, alone)))(*trials)
    values = ", ".join(f"{name} = {value:g}" for name, value in nominal.items())
    for method, changes in done.items():
        for what, pair in changes.items():
            after, before = (np.asarray(x, float) for x in pair)
            largest = np.max(np.abs(before), initial=0.0) or 1.0
            same = np.isclose(after, before, rtol=CLOSE, atol=CLOSE * largest, equal_nan=True)
            if not same.all():
                i = tuple(np.argwhere(~same)[0])
                raise _mistake(
                    effect,
                    method,
                    f"at {values}, which means no effect, {method} makes {after[i]:.6g} of "
                    f"{before[i]:.6g} in {what}; there a law may change nothing",
                )


def _done_by(dynamics: Dynamics, qpos: jax.Array, qvel: jax.Array, ctrl: jax.Array):
    """Return what each method of the only effect makes of what: (after, before) by method, name.

    Commands are [STEPS, nu]: memories fill in the first of them.
    """
    (effect,), host = dynamics.effects, dynamics.host.model
    bare, model = view(dynamics.replace(effects=())), view(dynamics)
    state = initial_state(dynamics, qpos, qvel)
    seen, memory = state if effect.reads_state else None, state.memory[0]
    tuned, sent, force = {}, ctrl[-1], None
    for command in ctrl:
        tuned = effect.tune(model, state._replace(memory=memory), command)
        sent, force, memory = effect.apply(model.replace(tuned), seen, command, memory)
    memory = effect.note(host, state, dynamics.timestep, state.memory[0])
    sensed = effect.sense(host, state, memory)
    nothing = jnp.zeros(host.nv)
    # What `prepare` adds to the model it may also set.
    fields = {} if type(effect).prepare is not Effect.prepare else effect.fields(bare)
    return {
        "fields": {name: (value, bare[name]) for name, value in fields.items()},
        "tune": {name: (value, model[name]) for name, value in tuned.items()},
        "apply": {
            "the command": (sent, ctrl[-1]),
            "the force": (nothing if force is None else force, nothing),
        },
        "sense": {"qpos": (sensed.qpos, state.qpos), "qvel": (sensed.qvel, state.qvel)},
    }


def _check_choices(effect: Effect, host: mujoco.MjModel) -> None:
    """Refuse sizes to try an effect at that are none; call what else is asked of it on the way."""
    for cls in CATALOGUE.values():
        effect.excludes(cls(target=effect.target))
    if not effect.parameters():
        return
    sizes = effect.starts(host, effect.target)
    _check_sizes(effect, "starts", sizes)
    if not sizes:
        raise _mistake(effect, "starts", "starts lists no size at which to try it")
    for size in sizes:
        effect.beside(size, size)
        opposite = effect.opposite(size)
        if opposite is not None:
            _check_sizes(effect, "opposite", [opposite])
            if {*opposite} != {*size}:
                what = f"opposite of {dict(size)!r} has other parameters: {dict(opposite)!r}"
                raise _mistake(effect, "opposite", what)


def _check_sizes(effect: Effect, method: str, sizes: Any) -> None:
    """Refuse what are no parameters of an effect, or beyond their bounds."""
    known = {p.name: p for p in effect.parameters()}
    if not isinstance(sizes, tuple | list) or not all(isinstance(s, Mapping) for s in sizes):
        raise _mistake(effect, method, f"{method} lists something else than parameters by name")
    if not all(sizes):
        raise _mistake(effect, method, f"{method} lists a size without parameters")
    for name, value in ((name, value) for size in sizes for name, value in size.items()):
        if name not in known:
            what = str(unknown_name("parameter", name, known))
            raise _mistake(effect, method, f"{method} has an {what}")
        number, p = np.asarray(value), known[name]
        if number.shape or number.dtype.kind not in "fiu" or not p.low <= number <= p.high:
            what = f"{method} has {name} = {value!r}, not a number from {p.low:g} to {p.high:g}"
            raise _mistake(effect, method, what)


def _check_shapes(dynamics: Dynamics) -> None:
    """Refuse what an effect returns of another shape than it should be."""
    (effect,) = dynamics.effects
    host = dynamics.host.model
    bare = view(dynamics.replace(effects=()))
    fields = effect.fields(bare)
    _check_fields(effect, "fields", bare, fields)
    model, state = bare.replace(fields), _rest(dynamics)
    ctrl, memory = jnp.zeros(host.nu), effect.init(host)
    seen = state if effect.reads_state else None
    tuned = effect.tune(model, state._replace(memory=memory), ctrl)
    _check_fields(effect, "tune", model, tuned)
    returned = effect.apply(model, seen, ctrl, memory)
    if not isinstance(returned, tuple) or len(returned) != 3:
        what = "apply returns something else than (command, force or None, memory)"
        raise _mistake(effect, "apply", what)
    sent, force, after = returned
    _check_shape(effect, "apply", "the command", sent, (host.nu,))
    if force is not None:
        _check_shape(effect, "apply", "the force", force, (host.nv,))
    _check_memory(effect, "apply", after, memory)
    _check_memory(effect, "note", effect.note(host, state, 0.0, memory), memory)
    sensed = effect.sense(host, state, state.memory[0])
    if not isinstance(sensed, PhysicsState):
        raise _mistake(effect, "sense", "sense returns something else than the state")
    _check_shape(effect, "sense", "qpos", sensed.qpos, (host.nq,))
    _check_shape(effect, "sense", "qvel", sensed.qvel, (host.nv,))


def _check_fields(effect: Effect, method: str, model: ModelView, fields: Any) -> None:
    if not isinstance(fields, Mapping):
        raise _mistake(effect, method, f"{method} returns something else than a dict of fields")
    known = _field_names(model.host)
    for name, value in fields.items():
        if name not in known:
            close = " or ".join(nearest(str(name), known))
            advice = f"did you mean {close}?" if close else "mujoco.MjModel has those that are"
            what = f"{method} returns {name!r}, which is no field of MuJoCo's model; {advice}"
            raise _mistake(effect, method, what)
        _check_shape(effect, method, name, value, model[name].shape)


def _field_names(host: mujoco.MjModel) -> list[str]:
    """List the native numbers of a model, those of its options as `opt.NAME`."""
    arrays = [n for n in dir(host) if isinstance(getattr(host, n), np.ndarray)]
    numbers = [n for n in dir(host.opt) if isinstance(getattr(host.opt, n), float | np.ndarray)]
    return [*arrays, *(f"opt.{name}" for name in numbers)]


def _check_shape(effect: Effect, method: str, what: str, value: Any, shape: tuple) -> None:
    if not isinstance(value, jax.Array | np.ndarray):
        returned = f"{method} returns {type(value).__name__} for {what}; expected an array"
        raise _mistake(effect, method, f"{returned} of shape {shape}")
    if value.shape != shape:
        returned = f"{method} returns {what} of shape {value.shape}; expected {shape}"
        raise _mistake(effect, method, returned)


def _check_memory(effect: Effect, method: str, after: Any, before: Any) -> None:
    """Refuse another memory than that of `init`: JAX carries one shape and type along."""
    said = []
    for memory in (after, before):
        kinds = jax.tree.map(lambda x: f"{jnp.result_type(x)}{jnp.shape(x)}", memory)
        said.append(f"{kinds} ({jax.tree.structure(memory)})")
    if said[0] != said[1]:
        what = f"{method} returns the memory {said[0]}; expected {said[1]}, as of init"
        raise _mistake(effect, method, what)


def _one_step(dynamics: Dynamics) -> PhysicsState:
    return step(dynamics, _rest(dynamics), jnp.zeros(dynamics.host.model.nu))


def _rest(dynamics: Dynamics) -> PhysicsState:
    host = dynamics.host.model
    return initial_state(dynamics, jnp.asarray(host.qpos0), jnp.zeros(host.nv))


def _command_range(host: mujoco.MjModel) -> np.ndarray:
    """Return the ends of the commands, [2, nu]; -1 and 1 where there are none."""
    limited = host.actuator_ctrllimited.astype(bool)
    return np.where(limited, host.actuator_ctrlrange.T, [[-1.0], [1.0]])


@contextlib.contextmanager
def _named(effect: Effect | type[Effect]) -> Iterator[None]:
    """Make whatever fails within an effect, or a kind of effect, one line that names it."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        said = str(error).partition("\n")[0]
        where = f"{_file_of(effect)}{line_in(_file_of(effect), error)}"
        raise UserError(_told(effect, where, f"{type(error).__name__}: {said}")) from error


def _mistake(effect: Effect, method: str, what: str) -> UserError:
    """Return an error that names an effect and where one of its methods begins."""
    where = _file_of(effect)
    code = getattr(inspect.unwrap(getattr(type(effect), method)), "__code__", None)
    if code and code.co_filename == os.path.abspath(where):  # not one that it inherits
        where = f"{where} line {code.co_firstlineno}"
    return UserError(_told(effect, where, what))


def _told(effect: Effect | type[Effect], where: str, what: str) -> str:
    return f"effect {effect.kind}{f' ({where})' if _file_of(effect) else ''}: {what}"


def _file_of(effect: Effect | type[Effect]) -> str:
    """Return the file of an effect; empty if it was written in a notebook."""
    try:
        return inspect.getfile(effect if isinstance(effect, type) else type(effect))
    except (OSError, TypeError):
        return ""
