"""How far a source is from the target, one step at a time: no policy, no learning in it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from garat_jax import rollout
from garat_jax.env import Env
from garat_jax.errors import UserError
from garat_jax.rollout import Recorded
from garat_jax.types import Params

CONSTANT_ACTIONS = 21
"""Values of an actuator that the constant baseline tries, over its range."""


class TransitionError(NamedTuple):
    """How far off single steps are.

    Attributes:
        mean: L2 error of the next observations of all sound steps, []; NaN if there are none.
        faulty_share: Share of the steps in which physics left the finite numbers, [].
    """

    mean: jax.Array
    faulty_share: jax.Array


def transition_error(env: Env, params: Params, recorded: Recorded) -> TransitionError:
    """Return the error of next observations, each step from the recorded state."""
    # No environment that this is called with draws anything.
    next_obs, faulty = rollout.replay(env, params, recorded, jax.random.key(0))
    wanted = recorded.transitions.next_obs.reshape(next_obs.shape)
    sound = ~(faulty | recorded.transitions.faulty.reshape(-1))
    distance = jnp.linalg.norm(next_obs - wanted, axis=-1)
    return TransitionError(jnp.sum(distance * sound) / sound.sum(), faulty.mean())


def check_differs(source_error: np.ndarray) -> None:
    """Refuse a source whose transition error, [...], is nil: there is nothing to ground.

    Raises:
        UserError: It is, of some seed.
    """
    if np.any(source_error == 0.0):
        raise UserError(
            "from the recorded states the source does just what the target did, so there is "
            "nothing to ground"
        )


def constant_error(
    env: Env, params: Params, recorded: Recorded, action: jax.Array | float
) -> TransitionError:
    """Return the transition error with the same action [action_size] in every step."""
    transitions = recorded.transitions
    fixed = transitions._replace(action=jnp.broadcast_to(action, transitions.action.shape))
    return transition_error(env, params, recorded._replace(transitions=fixed))


def best_constant(env: Env, params: Params, recorded: Recorded) -> jax.Array:
    """Return the constant action [action_size] of least transition error that a search finds.

    It tries `CONSTANT_ACTIONS` values of all actuators at once, the same fraction of the range of
    each; then, from the best of those, as many values of each actuator by itself, one after the
    other. Actions that differ from what is found in several actuators may be better still.
    """
    fractions = jnp.linspace(0.0, 1.0, CONSTANT_ACTIONS)
    grid = env.action_low + fractions[:, None] * (env.action_high - env.action_low)

    def search(action: jax.Array, moves: jax.Array) -> tuple[jax.Array, None]:
        actions = jnp.where(moves, grid, action)
        errors = jax.lax.map(lambda a: constant_error(env, params, recorded, a).mean, actions)
        return actions[jnp.nanargmin(errors)], None

    together, each = jnp.ones((1, env.action_size), bool), jnp.eye(env.action_size, dtype=bool)
    return jax.lax.scan(search, grid[0], jnp.concatenate([together, each]))[0]
