"""Batches of experience, evaluation, recorded transitions: all in guarded steps.

A world whose physics leaves the finite numbers ends its episode (`env.guarded_step`). The step is
counted wherever worlds are stepped, and the first one of a batch of experience, on the first device
that has one, is kept as it was, so that nothing is hidden.
"""

import functools
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from garat_jax import dynamics, split
from garat_jax.env import Env, EnvState, World, guarded_step
from garat_jax.types import Params, Policy, Transition

Tree = TypeVar("Tree")


class Fault(NamedTuple):
    """Where worlds left the finite numbers in a batch of experience.

    Attributes:
        num_steps: Steps in which one did, [].
        before: The environment in which the first of them began; zeros if there was none.
        action: The action taken in it, [action_size].
        after: The environment that came of it.
    """

    num_steps: jax.Array
    before: EnvState
    action: jax.Array
    after: EnvState


class Recorded(NamedTuple):
    """Transitions with the environment states in which their steps began; axes [T, B]."""

    transitions: Transition
    states: EnvState


class Evaluation(NamedTuple):
    """What whole episodes gave.

    Attributes:
        returns: Undiscounted, [num_episodes].
        faulty_share: Share of their steps in which physics left the finite numbers, [].
    """

    returns: jax.Array
    faulty_share: jax.Array


def reset(env: Env, params: Params, key: jax.Array, num_envs: int) -> EnvState:
    """Start a batch of episodes [B]."""
    return jax.vmap(env.reset, (None, 0))(params, jax.random.split(key, num_envs))


def no_fault(env: Env, state: EnvState) -> Fault:
    """Return the record of a batch in which nothing has gone wrong yet; `state` is [B]."""
    nothing = jax.tree.map(lambda x: jnp.zeros_like(x[0]), state)
    return Fault(jnp.zeros((), jnp.int32), nothing, jnp.zeros(env.action_size), nothing)


def _step(env: Env, params: Params, policy: Policy, policy_params: Params, state, key, shares=1):
    """Step a batch [B], or this device's share of one, and reset what has ended.

    Returns:
        The next states, the transitions, and the true next states.
    """
    *keys, reset_keys = _keys(state, key, shares)
    reached, transition, after = _act(env, params, policy, policy_params, state, *keys)
    fresh = jax.vmap(env.reset, (None, 0))(params, reset_keys)
    return _select(transition.terminated | transition.truncated, fresh, reached), transition, after


def _keys(state: EnvState, key: jax.Array, shares: int) -> jax.Array:
    """Return keys to act, to step and to reset with, [3, B]."""
    keys = jax.random.split(key, (3, state.steps.shape[0] * shares))
    return split.own_share(keys, shares, axis=1)


def _act(env: Env, params: Params, policy: Policy, policy_params: Params, state, act_keys, keys):
    """Step a batch [B]; return as `_step`, but what has ended stays where it is."""
    action, log_prob = jax.vmap(policy, (None, 0, 0))(policy_params, state.obs, act_keys)
    result, faulty, after = _guarded_steps(env, params, state, action, keys)
    transition = Transition(
        obs=state.obs,
        action=action,
        reward=result.reward,
        next_obs=result.state.obs,
        terminated=result.terminated,
        truncated=result.truncated,
        log_prob=log_prob,
        faulty=faulty,
    )
    return result.state, transition, after


def _guarded_steps(env: Env, params: Params, states: EnvState, actions: jax.Array, keys: jax.Array):
    """Take one guarded step in each of a batch of environments [B]."""
    step = functools.partial(guarded_step, env)
    return jax.vmap(step, (None, 0, 0, 0))(params, states, actions, keys)


def _select(chosen: jax.Array, these: EnvState, others: EnvState) -> EnvState:
    """Return these environments [B] where chosen, else the others."""

    def select(this: jax.Array, other: jax.Array) -> jax.Array:
        return jnp.where(chosen.reshape(chosen.shape + (1,) * (this.ndim - 1)), this, other)

    return jax.tree.map(select, these, others)


def _note(fault: Fault, before: EnvState, transition: Transition, after: EnvState) -> Fault:
    """Count the faulty steps of a batch [B] and keep the first of all."""
    faulty = transition.faulty
    worst = jnp.argmax(faulty)
    found = jax.tree.map(lambda x: x[worst], (before, transition.action, after))
    is_first = (fault.num_steps == 0) & faulty[worst]
    kept = jax.tree.map(lambda new, old: jnp.where(is_first, new, old), found, tuple(fault[1:]))
    return Fault(fault.num_steps + faulty.sum(dtype=jnp.int32), *kept)


def unroll(
    env: Env,
    params: Params,
    policy: Policy,
    policy_params: Params,
    state: EnvState,
    key: jax.Array,
    length: int,
) -> tuple[EnvState, Transition, Fault]:
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
        Where the environments stand now, [B], the transitions, [T, B], and what went wrong.
    """
    shares = split.num_shares(state.steps.shape[0])

    def step(carry, key):
        state, fault = carry
        new, transition, after = _step(env, params, policy, policy_params, state, key, shares)
        return (new, _note(fault, state, transition, after)), transition

    carry = (split.own_share(state, shares), no_fault(env, state))
    (state, fault), transitions = jax.lax.scan(step, carry, jax.random.split(key, length))
    faults = split.join(jax.tree.map(lambda x: x[None], fault), shares)
    first = jnp.argmax(faults.num_steps > 0)
    fault = jax.tree.map(lambda x: x[first], faults)._replace(
        num_steps=faults.num_steps.sum(dtype=jnp.int32)
    )
    return split.join(state, shares), split.join(transitions, shares, axis=1), fault


def record(
    env: Env,
    params: Params,
    policy: Policy,
    policy_params: Params,
    key: jax.Array,
    num_envs: int,
    length: int,
) -> Recorded:
    """Collect transitions from fresh episodes, with the states they began in, [T, B].

    Who learns from what happened leaves out what did not, with `without_faults`.
    """

    def step(state, key):
        after, transition, _ = _step(env, params, policy, policy_params, state, key)
        return after, Recorded(transition, state)

    reset_key, key = jax.random.split(key)
    state = reset(env, params, reset_key, num_envs)
    return jax.lax.scan(step, state, jax.random.split(key, length))[1]


def without_faults(steps: Tree, faulty: jax.Array) -> Tree:
    """Put a sound step of a batch in the place of each faulty one, as nothing sound followed that.

    Args:
        steps: Transitions, or anything else with the leading axes of `faulty`.
        faulty: In which steps physics left the finite numbers, [...].

    Returns:
        The steps, with the last sound one before it instead of each faulty one, or else the first.
    """
    flat = faulty.reshape(-1)
    last_sound = jax.lax.cummax(jnp.where(flat, -1, jnp.arange(flat.size)))
    chosen = jnp.where(last_sound < 0, jnp.argmin(flat), last_sound)

    def choose(x: jax.Array) -> jax.Array:
        return x.reshape(flat.size, *x.shape[faulty.ndim :])[chosen].reshape(x.shape)

    return jax.tree.map(choose, steps)


def as_of(source: World, target: World, recorded: Recorded) -> Recorded:
    """Return what was recorded in the target with states, [T, B], that the source can begin in."""
    effects = [jax.tree.structure(world.params.effects) for world in (source, target)]
    if effects[0] == effects[1]:
        return recorded
    adopt = jax.vmap(jax.vmap(functools.partial(dynamics.adopt, source.params)))
    states = recorded.states._replace(physics=adopt(recorded.states.physics))
    return recorded._replace(states=states)


def thinned(recorded: Recorded, num_transitions: int) -> Recorded:
    """Return about so many of the transitions of each seed, [seeds, T, B], evenly in time."""
    length, num_envs = recorded.transitions.reward.shape[1:]
    every = max(1, length * num_envs // num_transitions)
    return jax.tree.map(lambda x: x[:, ::every], recorded)


def evaluate(
    env: Env,
    params: Params,
    policy: Policy,
    policy_params: Params,
    key: jax.Array,
    num_episodes: int,
    wanted: jax.Array | bool = True,
) -> Evaluation:
    """Let a policy act for whole episodes; stop when all have ended.

    An episode that is over idles while others last; see `Env.idle`.

    Args:
        env: The environment.
        params: Its parameters.
        policy: The policy.
        policy_params: The policy's parameters.
        key: PRNG key.
        num_episodes: How many.
        wanted: False for no episodes and returns of zero, [].
    """
    shares = split.num_shares(num_episodes)
    reset_key, key = jax.random.split(key)
    keys = jax.random.split(key, env.episode_length)

    def is_unfinished(carry) -> jax.Array:
        return carry[1]

    def step(carry):
        length, _, state, alive, total, num_steps, num_faults = carry
        act_keys, step_keys, _ = _keys(state, keys[length], shares)
        idle = jax.vmap(env.idle, (None, 0))(params, state)
        state = _select(alive, state, idle)
        state, transition, _ = _act(env, params, policy, policy_params, state, act_keys, step_keys)
        total = total + alive * transition.reward
        num_steps, num_faults = num_steps + alive, num_faults + (alive & transition.faulty)
        alive = alive & ~(transition.terminated | transition.truncated)
        length = length + 1
        goes_on = (length < env.episode_length) & split.anywhere(alive.any())
        return length, goes_on, state, alive, total, num_steps, num_faults

    state = split.own_share(reset(env, params, reset_key, num_episodes), shares)
    wanted = jnp.asarray(wanted)
    alive, total = jnp.full(state.steps.shape, wanted), jnp.zeros(state.steps.shape)
    nothing = jnp.zeros(state.steps.shape, jnp.int32)
    carry = (0, split.anywhere(wanted), state, alive, total, nothing, nothing)
    counts = jax.lax.while_loop(is_unfinished, step, carry)[4:]
    returns, num_steps, num_faults = split.join(counts, shares)
    return Evaluation(returns, num_faults.sum() / jnp.maximum(num_steps.sum(), 1))


def replay(
    env: Env, params: Params, recorded: Recorded, key: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Take every recorded action from its recorded state.

    Args:
        env: The environment to take them in.
        params: Its parameters.
        recorded: Transitions and states, leading axes [T, B].
        key: PRNG key.

    Returns:
        The observations that follow, [T * B, obs_size], and in which of the steps physics left the
        finite numbers, [T * B]; nothing followed those, and the observation is the one before.
    """
    states, actions = jax.tree.map(
        lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]),
        (recorded.states, recorded.transitions.action),
    )
    keys = jax.random.split(key, actions.shape[0])
    result, faulty, _ = _guarded_steps(env, params, states, actions, keys)
    return result.state.obs, faulty
