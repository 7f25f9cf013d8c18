"""What TRPO and PPO share: their state, their policy, and how they collect a batch."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from brax.training.acme import running_statistics, specs

from garat_jax import rollout
from garat_jax.agents import advantage
from garat_jax.env import Env, EnvState
from garat_jax.networks import GaussianPolicy, ValueNet, forward
from garat_jax.rollout import Fault
from garat_jax.shuffle import minibatch_size, shuffled
from garat_jax.types import Number, Params, Policy, Transition


def static(default: Any) -> Any:
    """Declare a setting that decides shapes or loops, which `vmap` cannot vary."""
    return dataclasses.field(default=default, metadata={"static": True})


class PolicyParams(NamedTuple):
    """A policy's weights and the statistics that normalise its observations."""

    weights: Params
    normaliser: running_statistics.RunningStatisticsState


class ActorCriticState(NamedTuple):
    """Everything that one learner carries from a batch to the next.

    Attributes:
        policy: What acts.
        value: The value network's weights.
        optimiser: Its state.
        env: Where the environments stand, [B].
        fault: What went wrong in the last batch.
        key: PRNG key.
        env_steps: Control steps so far, [].
    """

    policy: PolicyParams
    value: Params
    optimiser: optax.OptState
    env: EnvState
    fault: Fault
    key: jax.Array
    env_steps: jax.Array


class Batch(NamedTuple):
    """A batch flattened over time and environments, [N], ready to learn from."""

    obs: jax.Array
    action: jax.Array
    log_prob: jax.Array
    advantage: jax.Array
    value_target: jax.Array


def init_state(
    env: Env,
    env_params: Params,
    policy: GaussianPolicy,
    value: ValueNet,
    key: jax.Array,
    num_envs: int,
) -> ActorCriticState:
    """Initialise networks, statistics and environments; the optimiser is left to the agent."""
    policy_key, value_key, env_key, key = jax.random.split(key, 4)
    obs = env.features(jnp.zeros(env.obs_size))
    normaliser = running_statistics.init_state(specs.Array(obs.shape, jnp.dtype("float32")))
    env_state = rollout.reset(env, env_params, env_key, num_envs)
    return ActorCriticState(
        policy=PolicyParams(policy.init(policy_key, obs), normaliser),
        value=value.init(value_key, obs),
        optimiser=(),
        env=env_state,
        fault=rollout.no_fault(env, env_state),
        key=key,
        env_steps=jnp.zeros((), jnp.int32),
    )


def make_policy(env: Env, network: GaussianPolicy) -> tuple[Policy, Any]:
    """Return the stochastic policy and its mean action, both on raw observations."""

    def sample(params: PolicyParams, obs: jax.Array, key: jax.Array):
        distribution = forward(network, params.weights, normalise(env, params, obs))
        return distribution.sample_and_log_prob(seed=key)

    def mean(params: PolicyParams, obs: jax.Array) -> jax.Array:
        return forward(network, params.weights, normalise(env, params, obs)).loc

    return sample, mean


def normalise(env: Env, params: PolicyParams, obs: jax.Array) -> jax.Array:
    """Normalise the features of observations [..., obs_size] with the running statistics."""
    return running_statistics.normalize(env.features(obs), params.normaliser, max_abs_value=10.0)


def collect(
    env: Env,
    env_params: Params,
    policy: Policy,
    state: ActorCriticState,
    length: int,
) -> tuple[ActorCriticState, Transition]:
    """Act for `length` steps in every environment with the statistics as they are."""
    key, unroll_key = jax.random.split(state.key)
    env_state, transitions, fault = rollout.unroll(
        env, env_params, policy, state.policy, state.env, unroll_key, length
    )
    env_steps = state.env_steps + transitions.reward.size
    state = state._replace(env=env_state, fault=fault, key=key, env_steps=env_steps)
    return state, transitions


def prepare(
    env: Env,
    value: ValueNet,
    state: ActorCriticState,
    transitions: Transition,
    discount: Number,
    trace: Number,
) -> Batch:
    """Estimate advantages and flatten the batch; observations come out normalised."""
    both = jnp.stack([transitions.obs, transitions.next_obs])
    obs, next_obs = normalise(env, state.policy, both)
    values = forward(value, state.value, jnp.stack([obs, next_obs]))
    advantages, targets = advantage.gae(transitions, values[0], values[1], discount, trace)
    batch = Batch(
        obs=obs,
        action=transitions.action,
        log_prob=transitions.log_prob,
        advantage=advantage.standardise(advantages),
        value_target=targets,
    )
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch)


def observe(env: Env, state: ActorCriticState, transitions: Transition) -> ActorCriticState:
    """Take a batch's observations into the running statistics, for the next batch."""
    updated = running_statistics.update(state.policy.normaliser, env.features(transitions.obs))
    return state._replace(policy=state.policy._replace(normaliser=updated))


def episode_metrics(
    env: Env, state: ActorCriticState, transitions: Transition
) -> dict[str, jax.Array]:
    """Return a batch's mean reward a step, mean steps an episode and share of faulty steps.

    Episodes that go on count as far as they went: their mean is the batch's steps for each that
    ended, as many as truncate one at most.
    """
    ended = jnp.sum(transitions.terminated | transitions.truncated)
    length = transitions.reward.size / jnp.maximum(ended, 1)
    return {
        "reward": transitions.reward.mean(),
        "episode_length": jnp.minimum(length, env.episode_length),
        "faulty_share": state.fault.num_steps / transitions.reward.size,
    }


def minibatches(batch: Batch, key: jax.Array, num_minibatches: int) -> Batch:
    """Shuffle a batch [N] and cut it into [num_minibatches, N // num_minibatches].

    Raises:
        UserError: There are more minibatches than steps, or none.
    """
    total = batch.action.shape[0]
    size = minibatch_size(total, num_minibatches)
    order = shuffled(key, total)[: size * num_minibatches]
    return jax.tree.map(lambda x: x[order].reshape(num_minibatches, size, *x.shape[1:]), batch)
