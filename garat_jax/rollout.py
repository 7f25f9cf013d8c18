"""The only callers of `Env.step`: batches of experience, evaluation, recorded transitions."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from garat_jax.env import Env, EnvState
from garat_jax.types import Params, Policy, Transition


class Recorded(NamedTuple):
    """Transitions with the environment states in which their steps began; axes [T, B]."""

    transitions: Transition
    states: EnvState


def reset(env: Env, params: Params, key: jax.Array, num_envs: int) -> EnvState:
    """Start a batch of episodes [B]."""
    return jax.vmap(env.reset, (None, 0))(params, jax.random.split(key, num_envs))


def _step(env: Env, params: Params, policy: Policy, policy_params: Params, state, key):
    """Step a batch [B] and reset what has ended."""
    num_envs = state.steps.shape[0]
    act_keys, step_keys, reset_keys = jax.random.split(key, (3, num_envs))
    action, log_prob = jax.vmap(policy, (None, 0, 0))(policy_params, state.obs, act_keys)
    result = jax.vmap(env.step, (None, 0, 0, 0))(params, state, action, step_keys)
    transition = Transition(
        obs=state.obs,
        action=action,
        reward=result.reward,
        next_obs=result.state.obs,
        terminated=result.terminated,
        truncated=result.truncated,
        log_prob=log_prob,
    )
    fresh = jax.vmap(env.reset, (None, 0))(params, reset_keys)
    done = result.terminated | result.truncated

    def select(new: jax.Array, old: jax.Array) -> jax.Array:
        return jnp.where(done.reshape(done.shape + (1,) * (new.ndim - 1)), new, old)

    return jax.tree.map(select, fresh, result.state), transition


def unroll(
    env: Env,
    params: Params,
    policy: Policy,
    policy_params: Params,
    state: EnvState,
    key: jax.Array,
    length: int,
) -> tuple[EnvState, Transition]:
    """Let a policy act in a batch of environments.

    Args:
        env: The environment.
        params: Its parameters.
        policy: The policy.
        policy_params: The policy's parameters.
        state: Where the environments stand, [B].
        key: PRNG key.
        length: Control steps T.

    Returns:
        Where the environments stand now, [B], and the transitions, [T, B].
    """

    def step(state, key):
        return _step(env, params, policy, policy_params, state, key)

    return jax.lax.scan(step, state, jax.random.split(key, length))


def record(
    env: Env,
    params: Params,
    policy: Policy,
    policy_params: Params,
    key: jax.Array,
    num_envs: int,
    length: int,
) -> Recorded:
    """Collect transitions from fresh episodes, with the states they began in, [T, B]."""

    def step(state, key):
        after, transition = _step(env, params, policy, policy_params, state, key)
        return after, Recorded(transition, state)

    reset_key, key = jax.random.split(key)
    state = reset(env, params, reset_key, num_envs)
    return jax.lax.scan(step, state, jax.random.split(key, length))[1]


def evaluate(
    env: Env,
    params: Params,
    policy: Policy,
    policy_params: Params,
    key: jax.Array,
    num_episodes: int,
) -> jax.Array:
    """Return the undiscounted returns [num_episodes] of whole episodes."""

    def step(carry, key):
        state, alive, total = carry
        state, transition = _step(env, params, policy, policy_params, state, key)
        total = total + alive * transition.reward
        alive = alive & ~(transition.terminated | transition.truncated)
        return (state, alive, total), None

    reset_key, key = jax.random.split(key)
    state = reset(env, params, reset_key, num_episodes)
    carry = (state, jnp.ones(num_episodes, bool), jnp.zeros(num_episodes))
    keys = jax.random.split(key, env.episode_length)
    return jax.lax.scan(step, carry, keys)[0][2]


def replay(env: Env, params: Params, recorded: Recorded, key: jax.Array) -> jax.Array:
    """Take every recorded action from its recorded state.

    Args:
        env: The environment to take them in.
        params: Its parameters.
        recorded: Transitions and states, leading axes [T, B].
        key: PRNG key.

    Returns:
        The observations that follow, [T * B, obs_size].
    """
    states, actions = jax.tree.map(
        lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]),
        (recorded.states, recorded.transitions.action),
    )
    keys = jax.random.split(key, actions.shape[0])
    return jax.vmap(env.step, (None, 0, 0, 0))(params, states, actions, keys).state.obs
