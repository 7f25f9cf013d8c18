"""GARAT: an action transformer learned by adversarial imitation from observation.

Desai et al. 2020 (arXiv 2008.01594), algorithm 1, lines 4 to 9: with the agent fixed, a
discriminator tells grounded from target transitions, and the transformer learns to fool it.
"""

import dataclasses
from typing import NamedTuple, get_args

import jax
import jax.numpy as jnp
import optax

from garat_jax import rollout
from garat_jax.agents import ppo
from garat_jax.agents.actor_critic import ActorCriticState, PolicyParams
from garat_jax.agents.ppo import PPOConfig
from garat_jax.env import Env
from garat_jax.errors import unknown_name
from garat_jax.methods.grounded import (
    GroundedEnv,
    Output,
    TransformerEnv,
    TransformerParams,
    decode_action,
)
from garat_jax.networks import Discriminator, forward
from garat_jax.shuffle import minibatch_size, picked, shuffled
from garat_jax.types import Metrics, Params, Policy, Transition


@dataclasses.dataclass(frozen=True)
class GARATConfig:
    """Hyper-parameters; docs/grounding.md has the measurements behind the defaults.

    Raises:
        UserError: The transformer's batch cannot make its minibatches, or the discriminator's, or
            its output is unknown.
    """

    transformer: PPOConfig = dataclasses.field(
        default_factory=lambda: PPOConfig(
            initial_log_std=-2.0,  # one half-range lets D separate on noise alone
            num_epochs=10,
            num_minibatches=8,
            clip=0.3,  # 0.1 bounds how far so small a deviation can move in 50 updates
            discount=0.0,  # -log D is about one transition; a later one is no credit to this
            trace=0.0,
        )
    )
    output: Output = "change"
    reach: float = 1.0
    hidden: tuple[int, ...] = (64, 64)
    learning_rate: float = 1e-3
    num_minibatches: int = 20  # one pass over the batch, as the paper's "update D" is read
    gradient_penalty: float = 10.0  # Desai et al. 2020
    weight_penalty: float = 1e-3  # L2 on the weights, Desai et al. 2020; size by measurement
    centre_reward: bool = True  # of no effect where PPO standardises and the discount is 0

    def __post_init__(self) -> None:
        """Refuse what would fail when grounding begins, after hours of training policies."""
        if self.output not in get_args(Output):
            raise unknown_name("output", self.output, get_args(Output))
        for num in (self.transformer.num_minibatches, self.num_minibatches):
            minibatch_size(self.transformer.num_envs * self.transformer.num_steps, num)


class Normaliser(NamedTuple):
    """Mean and standard deviation of what D sees in the target's data; see `evidence`."""

    mean: jax.Array
    std: jax.Array


class RewardParams(NamedTuple):
    """What the transformer's reward depends on.

    Attributes:
        weights: The discriminator's.
        normaliser: Of its features.
        offset: Mean of -log D over the last batch if rewards are centred, else 0.
    """

    weights: Params
    normaliser: Normaliser
    offset: jax.Array


class GARATState(NamedTuple):
    """The adversarial pair: transformer and discriminator."""

    transformer: ActorCriticState
    reward: RewardParams
    optimiser: optax.OptState
    key: jax.Array


class GARAT:
    """Grounds one environment for one agent.

    Args:
        env: The source environment.
        agent: The fixed agent's stochastic policy.
        config: Hyper-parameters.
    """

    def __init__(self, env: Env, agent: Policy, config: GARATConfig):
        self.source = env
        self.config = config
        self.network = Discriminator(config.hidden)
        self.decode = decode_action(env, config.output, config.reach)
        self.env = TransformerEnv(env, agent, self.decode, self.reward)
        self.transformer = ppo.make(self.env, config.transformer)
        self.grounded = GroundedEnv(env, self.transform)
        self.optimiser = optax.adam(config.learning_rate)

    def transform(
        self, params: PolicyParams, obs: jax.Array, action: jax.Array, key: jax.Array
    ) -> jax.Array:
        """Return the transformer's mean action for what the agent wants to do."""
        del key
        return self.decode(action, self.transformer.mean(params, jnp.concatenate([obs, action])))

    def reward(
        self, params: RewardParams, obs: jax.Array, action: jax.Array, next_obs: jax.Array
    ) -> jax.Array:
        """Return -log D of a transition, less the offset, []."""
        seen = evidence(self.source, params.normaliser, obs, action, next_obs)
        return jax.nn.softplus(-forward(self.network, params.weights, seen)) - params.offset

    def init(self, key: jax.Array, env_params: Params, agent: Params, target: Transition):
        """Start an untrained pair.

        Args:
            key: PRNG key.
            env_params: The source's parameters.
            agent: The agent's policy parameters.
            target: Target transitions, [N]; actions within bounds.
        """
        policy_key, discriminator_key, key = jax.random.split(key, 3)
        raw = _stack(self.source, target.obs, target.action, target.next_obs)
        normaliser = Normaliser(raw.mean(0), raw.std(0) + 1e-6)
        reward = RewardParams(
            self.network.init(discriminator_key, raw[0]), normaliser, jnp.zeros(())
        )
        transformer = self.transformer.init(
            policy_key, TransformerParams(env_params, agent, reward)
        )
        return GARATState(transformer, reward, self.optimiser.init(reward.weights), key)

    def step(
        self, state: GARATState, env_params: Params, agent: Params, target: Transition
    ) -> tuple[GARATState, Metrics]:
        """Do one adversarial update: the transformer's by PPO, the discriminator's by one pass.

        The transformer is paid by the discriminator of the update before, and the discriminator
        learns from the transitions that this transformer made: algorithm 1 with its two lines
        in the order that lets one batch of experience serve both.

        Args:
            state: The pair.
            env_params: The source's parameters.
            agent: The agent's policy parameters.
            target: Target transitions, [N]; actions within bounds.
        """
        params = TransformerParams(env_params, agent, state.reward)
        transformer, metrics, transitions = self.transformer.step(state.transformer, params)
        transitions = rollout.without_faults(transitions, transitions.faulty)
        obs, action = self.env.split(transitions.obs)
        next_obs, _ = self.env.split(transitions.next_obs)
        normaliser = state.reward.normaliser
        grounded = evidence(self.source, normaliser, obs, action, next_obs)
        grounded = grounded.reshape(-1, grounded.shape[-1])
        wanted = evidence(self.source, normaliser, target.obs, target.action, target.next_obs)
        key, update_key = jax.random.split(state.key)
        reward, optimiser, losses = self._update_discriminator(
            state.reward, state.optimiser, grounded, wanted, update_key
        )
        state = GARATState(transformer, reward, optimiser, key)
        return state, {f"transformer_{k}": v for k, v in metrics.items()} | losses

    def _update_discriminator(self, reward: RewardParams, optimiser, grounded, wanted, key):
        grounded_key, target_key, penalty_key = jax.random.split(key, 3)
        num = self.config.num_minibatches
        size = minibatch_size(grounded.shape[0], num)
        order = shuffled(grounded_key, grounded.shape[0])[: num * size]
        picks = picked(target_key, num * size, wanted.shape[0])
        batches = [data.reshape(num, size, -1) for data in (grounded[order], wanted[picks])]
        keys = jax.random.split(penalty_key, num)

        def minibatch_step(carry, inputs):
            weights, optimiser = carry
            grads, metrics = jax.grad(self._loss, has_aux=True)(weights, *inputs)
            updates, optimiser = self.optimiser.update(grads, optimiser, weights)
            return (optax.apply_updates(weights, updates), optimiser), metrics

        (weights, optimiser), metrics = jax.lax.scan(
            minibatch_step, (reward.weights, optimiser), (*batches, keys)
        )
        mean_reward = jnp.mean(jax.nn.softplus(-forward(self.network, weights, grounded)))
        offset = mean_reward if self.config.centre_reward else jnp.zeros(())
        reward = reward._replace(weights=weights, offset=offset)
        return reward, optimiser, jax.tree.map(jnp.mean, metrics)

    def _loss(self, weights: Params, grounded: jax.Array, wanted: jax.Array, key: jax.Array):
        """Return -(E_grounded[log D] + E_target[log(1 - D)]) plus both penalties, []."""
        logits_grounded = forward(self.network, weights, grounded)
        logits_target = forward(self.network, weights, wanted)
        loss = jnp.mean(jax.nn.softplus(-logits_grounded)) + jnp.mean(
            jax.nn.softplus(logits_target)
        )
        penalty = gradient_penalty(
            lambda x: forward(self.network, weights, x), grounded, wanted, key
        )
        accuracy = (jnp.mean(logits_grounded > 0) + jnp.mean(logits_target < 0)) / 2
        squares = weight_penalty(weights)
        total = loss + self.config.gradient_penalty * penalty
        return total + self.config.weight_penalty * squares, {
            "discriminator_loss": loss,
            "discriminator_accuracy": accuracy,
            "gradient_penalty": penalty,
            "weight_penalty": squares,
        }


def weight_penalty(weights: Params) -> jax.Array:
    """Return the sum of the squares of all kernels, biases left out, []."""
    kernels = [leaf for leaf in jax.tree.leaves(weights) if leaf.ndim > 1]
    return jnp.sum(jnp.stack([jnp.sum(jnp.square(kernel)) for kernel in kernels]))


def gradient_penalty(logit, grounded: jax.Array, wanted: jax.Array, key: jax.Array) -> jax.Array:
    """Return E[(|d logit / d x| - 1)^2] between the two batches [N, features], [].

    Gulrajani et al. 2017 (arXiv 1704.00028), equation 3.
    """
    mix = jax.random.uniform(key, (grounded.shape[0], 1))
    between = mix * grounded + (1 - mix) * wanted
    slopes = jax.vmap(jax.grad(logit))(between)
    norms = jnp.sqrt(jnp.sum(jnp.square(slopes), axis=-1) + 1e-12)
    return jnp.mean(jnp.square(norms - 1))


def evidence(
    env: Env, normaliser: Normaliser, obs: jax.Array, action: jax.Array, next_obs: jax.Array
) -> jax.Array:
    """Return what the discriminator sees, [..., features + action_size + obs_size]."""
    raw = _stack(env, obs, action, next_obs)
    return jnp.clip((raw - normaliser.mean) / normaliser.std, -10, 10)


def _stack(env: Env, obs: jax.Array, action: jax.Array, next_obs: jax.Array) -> jax.Array:
    return jnp.concatenate([env.features(obs), action, next_obs - obs], axis=-1)
