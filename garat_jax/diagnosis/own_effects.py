"""A mistake in a user's own effect is one line that names the effect, its file and where in it."""

import inspect
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco

from garat_jax.dynamics import Dynamics, compile, initial_state, step
from garat_jax.effects import CATALOGUE, Effect
from garat_jax.effects.catalogue import line_in
from garat_jax.errors import UserError
from garat_jax.overrides import Override


def is_own(effect: Effect) -> bool:
    """Say whether an effect is none of the built-in catalogue."""
    return type(effect) is not CATALOGUE.get(effect.kind)


def try_own(
    spec: mujoco.MjSpec, overrides: tuple[Override, ...], effects: Sequence[Effect]
) -> None:
    """Trace each effect of the user's own through one step of a model that has no other.

    Raises:
        UserError: One fails, in whatever way.
    """
    for effect in filter(is_own, effects):
        try:
            jax.eval_shape(_one_step, compile(spec, overrides, (effect,), "mujoco"))
        except UserError:
            continue  # it may need another effect; compiling all of them says if it does not fit
        except Exception as error:
            said = str(error).partition("\n")[0]
            where = _where(effect, error)
            what = f"{type(error).__name__}: {said}"
            raise UserError(f"effect {effect.kind}{where}: {what}") from error


def _one_step(dynamics: Dynamics):
    host = dynamics.host.model
    state = initial_state(dynamics, jnp.asarray(host.qpos0), jnp.zeros(host.nv))
    return step(dynamics, state, jnp.zeros(host.nu))


def _where(effect: Effect, error: Exception) -> str:
    """Return the file of an effect, and the last line of it that an error came through."""
    try:
        path = inspect.getfile(type(effect))
    except (OSError, TypeError):  # written in a notebook
        return ""
    return f" ({path}{line_in(path, error)})"
