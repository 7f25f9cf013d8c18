"""A mistake in a user's own effect is one line that names the effect, its file and where in it."""

import contextlib
import functools
import inspect
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from garat_jax.dynamics import Dynamics, PhysicsState, compile, initial_state, step, view
from garat_jax.effects import CATALOGUE, Effect
from garat_jax.effects.base import ModelView
from garat_jax.effects.catalogue import line_in
from garat_jax.errors import UserError, unknown_name
from garat_jax.overrides import Override

CLOSE = 1e-5
"""By how much a law without effect may change a number, or a part of it."""
TRIALS = 8
"""States and commands that a law without effect is tried at."""


def is_own(effect: Effect) -> bool:
    """Say whether an effect is none of the built-in catalogue."""
    return type(effect) is not CATALOGUE.get(effect.kind)


def try_own(
    spec: mujoco.MjSpec, overrides: tuple[Override, ...], effects: Sequence[Effect]
) -> None:
    """Try each effect of the user's own in a model that has no other.

    It is traced through one step, and computed where its parameters mean "no effect".

    Raises:
        UserError: One fails, in whatever way, returns what is of another shape than it should be,
            or changes something without effect.
    """
    for effect in filter(is_own, effects):
        with _named(effect):
            try:
                alone = compile(spec, overrides, (effect,), "mujoco")
            except UserError:
                continue  # it may need another effect; compiling all of them says what is amiss
            jax.eval_shape(_check_shapes, alone)
            jax.eval_shape(_one_step, alone)
            check_identity(spec, type(effect), effect.target)


@functools.lru_cache(maxsize=1000)
def check_identity(spec: mujoco.MjSpec, cls: type[Effect], target: str) -> None:
    """Refuse a law that changes something where its parameters mean "no effect".

    Raises:
        UserError: It changes a field of the model, a command or a sensor, or adds a force.
    """
    nominal = cls.at(spec.copy().compile(), target)
    alone = compile(spec, (), (cls(target=target, **nominal),), "mujoco")
    (effect,), host = alone.effects, alone.host.model
    rng = np.random.default_rng(0)
    low, high = _command_range(host)
    ctrl = rng.uniform(low, high, (TRIALS, host.nu))
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
            same = np.isclose(after, before, rtol=CLOSE, atol=CLOSE, equal_nan=True)
            if not same.all():
                i = tuple(np.argwhere(~same)[0])
                raise _mistake(
                    effect,
                    method,
                    f"at {values}, which means no effect, {method} makes {after[i]:.6g} of "
                    f"{before[i]:.6g} in {what}; there a law may change nothing",
                )


def _done_by(dynamics: Dynamics, qpos: jax.Array, qvel: jax.Array, ctrl: jax.Array):
    """Return what each method of the only effect makes of what: (after, before) by method, name."""
    (effect,), host = dynamics.effects, dynamics.host.model
    bare, model = view(dynamics.replace(effects=())), view(dynamics)
    state = initial_state(dynamics, qpos, qvel)
    seen = state if effect.reads_state else None
    tuned = effect.tune(model, seen, ctrl) if effect.tunes else {}
    sent, force, _ = effect.apply(model.replace(tuned), seen, ctrl, state.memory[0])
    nothing = jnp.zeros(host.nv)
    sensed = effect.sense(host, state, state.memory[0])
    # What `prepare` adds to the model it may also set.
    fields = {} if type(effect).prepare is not Effect.prepare else effect.fields(bare)
    return {
        "fields": {name: (value, bare[name]) for name, value in fields.items()},
        "tune": {name: (value, model[name]) for name, value in tuned.items()},
        "apply": {
            "the command": (sent, ctrl),
            "the force": (nothing if force is None else force, nothing),
        },
        "sense": {"qpos": (sensed.qpos, state.qpos), "qvel": (sensed.qvel, state.qvel)},
    }


def _check_shapes(dynamics: Dynamics) -> None:
    """Refuse what an effect returns of another shape than it should be."""
    (effect,) = dynamics.effects
    host = dynamics.host.model
    bare = view(dynamics.replace(effects=()))
    fields = effect.fields(bare)
    _check_fields(effect, "fields", bare, fields)
    model, state = bare.replace(fields), _rest(dynamics)
    ctrl, memory = jnp.zeros(host.nu), state.memory[0]
    seen = state if effect.reads_state else None
    if effect.tunes:
        _check_fields(effect, "tune", model, effect.tune(model, seen, ctrl))
    returned = effect.apply(model, seen, ctrl, memory)
    if not isinstance(returned, tuple) or len(returned) != 3:
        what = "apply returns something else than (command, force or None, memory)"
        raise _mistake(effect, "apply", what)
    sent, force, after = returned
    _check_shape(effect, "apply", "the command", sent, (host.nu,))
    if force is not None:
        _check_shape(effect, "apply", "the force", force, (host.nv,))
    shapes = [jax.tree.map(jnp.shape, each) for each in (after, memory)]
    if shapes[0] != shapes[1]:
        what = f"apply returns a memory of shape {shapes[0]}; expected {shapes[1]}, as of init"
        raise _mistake(effect, "apply", what)
    sensed = effect.sense(host, state, memory)
    _check_shape(effect, "sense", "qpos", sensed.qpos, (host.nq,))
    _check_shape(effect, "sense", "qvel", sensed.qvel, (host.nv,))


def _check_fields(
    effect: Effect, method: str, model: ModelView, fields: Mapping[str, jax.Array]
) -> None:
    for name, value in fields.items():
        try:
            shape = model[name].shape
        except (AttributeError, TypeError):
            known = [n for n in dir(mujoco.MjModel) if not n.startswith("_")]
            raise _mistake(
                effect, method, f"{method} returns an {unknown_name('field', name, known)}"
            ) from None
        _check_shape(effect, method, name, value, shape)


def _check_shape(effect: Effect, method: str, what: str, value: Any, shape: tuple) -> None:
    if jnp.shape(value) != shape:
        returned = f"{method} returns {what} of shape {jnp.shape(value)}; expected {shape}"
        raise _mistake(effect, method, returned)


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
def _named(effect: Effect) -> Iterator[None]:
    """Make whatever fails within an effect one line that names it."""
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
    code = getattr(inspect.unwrap(getattr(type(effect), method)), "__code__", None)
    line = f" line {code.co_firstlineno}" if code else ""
    return UserError(_told(effect, f"{_file_of(effect)}{line}", what))


def _told(effect: Effect, where: str, what: str) -> str:
    return f"effect {effect.kind}{f' ({where})' if _file_of(effect) else ''}: {what}"


def _file_of(effect: Effect) -> str:
    """Return the file of an effect; empty if it was written in a notebook."""
    try:
        return inspect.getfile(type(effect))
    except (OSError, TypeError):
        return ""
