"""GAT: an action transformer made of a forward model of the target and an inverse of the source.

Hanna and Stone 2017 (Grounded Action Transformation for Robot Learning in Simulation), as the
baseline of Desai et al. 2020 (arXiv 2008.01594): g(s, a) is the action that takes the source where
the target would go with a. Both models are learned by regression; nothing is adversarial.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from garat_jax import rollout
from garat_jax.env import Env
from garat_jax.errors import check_at_least
from garat_jax.methods.grounded import GroundedEnv
from garat_jax.networks import MLP, forward
from garat_jax.shuffle import picked
from garat_jax.types import Metrics, Params, Policy, Transition


@dataclasses.dataclass(frozen=True)
class GATConfig:
    """Hyper-parameters.

    Raises:
        UserError: There is nothing to learn, or to learn from.
    """

    hidden: tuple[int, ...] = (64, 64)
    learning_rate: float = 1e-3
    minibatch: int = 128
    num_epochs: int = 10  # over both data sets, an update
    num_envs: int = 50
    num_steps: int = 200  # 50 x 200 = 10000 transitions of the source, which are cheap

    def __post_init__(self) -> None:
        """Refuse what would fail when grounding begins, after hours of training policies."""
        check_at_least(self, minibatch=1, num_epochs=1, num_envs=1, num_steps=1)


class Scale(NamedTuple):
    """Mean and standard deviation that normalise vectors."""

    mean: jax.Array
    std: jax.Array


class Models(NamedTuple):
    """Both models; the parameters of the transformer.

    Attributes:
        forward: Weights of (obs' features, action) -> change of obs in the target.
        inverse: Weights of (obs' features, change of obs) -> action in the source.
        obs: Scale of observations' features.
        change: Scale of their changes in a step.
        action: Scale of actions.
    """

    forward: Params
    inverse: Params
    obs: Scale
    change: Scale
    action: Scale


class Transformer(NamedTuple):
    """What `GATState` shows of itself as every method does: the policy and what it cost."""

    policy: Models
    env_steps: jax.Array


class GATState(NamedTuple):
    """The models while they are learned.

    Attributes:
        transformer: Both models.
        source: The source's transitions, [M].
        faulty_share: Share of the source's steps that were faulty, [], until it has been told.
        optimiser: Of both models.
        key: PRNG key.
    """

    transformer: Transformer
    source: Transition
    faulty_share: jax.Array
    optimiser: optax.OptState
    key: jax.Array


class GAT:
    """Grounds one environment for one agent.

    Args:
        env: The source environment.
        agent: The fixed agent's stochastic policy.
        config: Hyper-parameters.
    """

    def __init__(self, env: Env, agent: Policy, config: GATConfig):
        self.env = env
        self.agent = agent
        self.config = config
        self.forward = MLP(config.hidden, env.obs_size)
        self.inverse = MLP(config.hidden, env.action_size)
        self.grounded = GroundedEnv(env, self.transform)
        self.optimiser = optax.adam(config.learning_rate)

    def transform(
        self, params: Models, obs: jax.Array, action: jax.Array, key: jax.Array
    ) -> jax.Array:
        """Return the action [action_size] that does in the source what `action` would do there."""
        del key
        change = self._change(params, obs, action)
        return params.action.mean + params.action.std * self._action(params, obs, change)

    def init(self, key: jax.Array, env_params: Params, agent: Params, target: Transition):
        """Roll the agent out in the source and start untrained models.

        Args:
            key: PRNG key.
            env_params: The source's parameters.
            agent: The agent's policy parameters.
            target: Target transitions, [N]; actions within bounds.
        """
        forward_key, inverse_key, rollout_key, key = jax.random.split(key, 4)
        config = self.config
        recorded = rollout.record(
            self.env, env_params, self.agent, agent, rollout_key, config.num_envs, config.num_steps
        )
        faulty = recorded.transitions.faulty
        source = rollout.without_faults(recorded.transitions, faulty)
        source = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), source)
        source = source._replace(action=self.env.clip(source.action))
        both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), source, target)
        columns = (self.env.features(both.obs), both.next_obs - both.obs, both.action)
        obs, change, action = (_scale(column) for column in columns)
        models = Models(
            self.forward.init(forward_key, jnp.concatenate([obs.mean, action.mean])),
            self.inverse.init(inverse_key, jnp.concatenate([obs.mean, change.mean])),
            obs,
            change,
            action,
        )
        steps = jnp.asarray(source.reward.size, jnp.int32)
        optimiser = self.optimiser.init((models.forward, models.inverse))
        return GATState(Transformer(models, steps), source, faulty.mean(), optimiser, key)

    def step(
        self, state: GATState, env_params: Params, agent: Params, target: Transition
    ) -> tuple[GATState, Metrics]:
        """Learn both models for some epochs; arguments as `init`'s."""
        del env_params, agent
        key, epochs_key = jax.random.split(state.key)
        # An epoch is a pass over the larger of both data sets.
        larger = max(target.reward.shape[0], state.source.reward.shape[0])
        num = max(1, larger // self.config.minibatch)

        def epoch(carry, key):
            target_key, source_key = jax.random.split(key)
            target_batches = self._minibatches(target, num, target_key)
            source_batches = self._minibatches(state.source, num, source_key)
            return jax.lax.scan(self._learn, carry, (target_batches, source_batches))

        carry: Any = (state.transformer.policy, state.optimiser)
        keys = jax.random.split(epochs_key, self.config.num_epochs)
        (models, optimiser), losses = jax.lax.scan(epoch, carry, keys)
        transformer = state.transformer._replace(policy=models)
        metrics = {name: loss[-1].mean() for name, loss in losses.items()}
        metrics["source_faulty_share"] = state.faulty_share
        told = jnp.zeros_like(state.faulty_share)
        return GATState(transformer, state.source, told, optimiser, key), metrics

    def _minibatches(self, data: Transition, num: int, key: jax.Array) -> Transition:
        """Return random transitions of a data set, [num, minibatch], each about equally often."""
        size = self.config.minibatch
        picks = picked(key, num * size, data.reward.shape[0]).reshape(num, size)
        return jax.tree.map(lambda x: x[picks], data)

    def _learn(self, carry, batches: tuple[Transition, Transition]):
        """Take one gradient step of both models."""
        models, optimiser = carry
        weights: Any = (models.forward, models.inverse)
        grads, losses = jax.grad(self._loss, has_aux=True)(weights, models, *batches)
        updates, optimiser = self.optimiser.update(grads, optimiser, weights)
        weights = optax.apply_updates(weights, updates)
        return (models._replace(forward=weights[0], inverse=weights[1]), optimiser), losses

    def _loss(self, weights, models: Models, target: Transition, source: Transition):
        """Return the squared errors of both models in normalised units, []."""
        models = models._replace(forward=weights[0], inverse=weights[1])
        change = (target.next_obs - target.obs - models.change.mean) / models.change.std
        there = jnp.mean(jnp.square(self._change(models, target.obs, target.action) - change))
        change = (source.next_obs - source.obs - models.change.mean) / models.change.std
        action = (source.action - models.action.mean) / models.action.std
        here = jnp.mean(jnp.square(self._action(models, source.obs, change) - action))
        return there + here, {"forward_loss": there, "inverse_loss": here}

    def _change(self, models: Models, obs: jax.Array, action: jax.Array) -> jax.Array:
        """Return the normalised change of obs in the target, [..., obs_size]."""
        inputs = [self._normalised(models, obs), _normalise(models.action, action)]
        return forward(self.forward, models.forward, jnp.concatenate(inputs, axis=-1))

    def _action(self, models: Models, obs: jax.Array, change: jax.Array) -> jax.Array:
        """Return the normalised action that makes a normalised change in the source."""
        inputs = [self._normalised(models, obs), change]
        return forward(self.inverse, models.inverse, jnp.concatenate(inputs, axis=-1))

    def _normalised(self, models: Models, obs: jax.Array) -> jax.Array:
        return _normalise(models.obs, self.env.features(obs))


def _scale(values: jax.Array) -> Scale:
    return Scale(values.mean(0), values.std(0) + 1e-6)


def _normalise(scale: Scale, values: jax.Array) -> jax.Array:
    return jnp.clip((values - scale.mean) / scale.std, -10, 10)
