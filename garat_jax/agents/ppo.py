"""Proximal policy optimisation (Schulman et al. 2017, arXiv 1707.06347)."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import optax

from garat_jax.agents import actor_critic
from garat_jax.agents.actor_critic import ActorCriticState, Batch, static
from garat_jax.env import Env
from garat_jax.errors import check_at_least
from garat_jax.networks import GaussianPolicy, ValueNet, forward
from garat_jax.types import Agent, Number, Params


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """Hyper-parameters; the defaults are Desai et al. 2020, appendix, action transformer.

    Raises:
        UserError: There is nothing to learn, or to learn from.
    """

    num_envs: int = static(50)
    num_steps: int = static(100)  # 50 x 100 = 5000 steps a batch, as the paper
    hidden: tuple[int, ...] = static((64, 64))
    initial_log_std: Number = 0.0
    num_epochs: int = static(1)
    num_minibatches: int = static(2)
    learning_rate: Number = 3e-4
    discount: Number = 0.99
    trace: Number = 0.95
    clip: Number = 0.1
    value_weight: Number = 0.5  # stable-baselines3 PPO
    entropy_weight: Number = 0.0
    max_grad_norm: Number = 0.5  # stable-baselines PPO2

    def __post_init__(self) -> None:
        """Refuse what would fail in the first step; the leaves may be anything."""
        check_at_least(self, num_envs=1, num_steps=1, num_epochs=1)


def make(env: Env, config: PPOConfig) -> Agent:
    """Build a PPO agent for an environment.

    The config's numbers are leaves: a function that is given some, builds an agent with them and
    trains it can be mapped over them by `jax.vmap`, as over seeds (`examples/05_sweep.py`).
    """
    policy_net = GaussianPolicy(env.action_size, config.hidden, config.initial_log_std)
    value_net = ValueNet(config.hidden)
    policy, mean = actor_critic.make_policy(env, policy_net)
    optimiser = optax.chain(
        optax.clip_by_global_norm(config.max_grad_norm),
        optax.adam(config.learning_rate, eps=1e-5),
    )

    def init(key: jax.Array, env_params: Params) -> ActorCriticState:
        state = actor_critic.init_state(
            env, env_params, policy_net, value_net, key, config.num_envs
        )
        return state._replace(optimiser=optimiser.init((state.policy.weights, state.value)))

    def loss(weights, batch: Batch) -> tuple[jax.Array, dict[str, jax.Array]]:
        policy_weights, value_weights = weights
        distribution = forward(policy_net, policy_weights, batch.obs)
        value = forward(value_net, value_weights, batch.obs)
        return ppo_loss(distribution, value, batch, config)

    def minibatch_step(carry, batch: Batch):
        weights, optimiser_state = carry
        grads, metrics = jax.grad(loss, has_aux=True)(weights, batch)
        updates, optimiser_state = optimiser.update(grads, optimiser_state, weights)
        return (optax.apply_updates(weights, updates), optimiser_state), metrics

    def step(state: ActorCriticState, env_params: Params):
        state, transitions = actor_critic.collect(env, env_params, policy, state, config.num_steps)
        batch = actor_critic.prepare(
            env, value_net, state, transitions, config.discount, config.trace
        )

        def epoch(carry, key):
            shuffled = actor_critic.minibatches(batch, key, config.num_minibatches)
            return jax.lax.scan(minibatch_step, carry, shuffled)

        key, epoch_key = jax.random.split(state.key)
        carry: Any = ((state.policy.weights, state.value), state.optimiser)
        carry, metrics = jax.lax.scan(epoch, carry, jax.random.split(epoch_key, config.num_epochs))
        (weights, value), optimiser_state = carry
        state = state._replace(
            policy=state.policy._replace(weights=weights),
            value=value,
            optimiser=optimiser_state,
            key=key,
        )
        metrics = jax.tree.map(jnp.mean, metrics)
        metrics = metrics | actor_critic.episode_metrics(env, state, transitions)
        return actor_critic.observe(env, state, transitions), metrics, transitions

    return Agent(init, step, policy, mean, config.num_envs * config.num_steps)


def ppo_loss(
    distribution, value: jax.Array, batch: Batch, config: PPOConfig
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Return the clipped surrogate loss plus the value loss, [], and metrics (eq. 7 and 9)."""
    log_ratio = distribution.log_prob(batch.action) - batch.log_prob
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1 - config.clip, 1 + config.clip)
    policy_loss = -jnp.mean(jnp.minimum(ratio * batch.advantage, clipped * batch.advantage))
    value_loss = jnp.mean(jnp.square(value - batch.value_target))
    entropy = jnp.mean(distribution.entropy())
    loss = policy_loss + config.value_weight * value_loss - config.entropy_weight * entropy
    return loss, {
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "entropy": entropy,
        "kl": jnp.mean(ratio - 1 - log_ratio),
    }
