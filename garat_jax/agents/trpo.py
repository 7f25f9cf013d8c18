"""Trust region policy optimisation (Schulman et al. 2015, arXiv 1502.05477)."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree

from garat_jax.agents import actor_critic
from garat_jax.agents.actor_critic import ActorCriticState, Batch, static
from garat_jax.env import Env
from garat_jax.networks import GaussianPolicy, ValueNet, forward
from garat_jax.types import Agent, Number, Params


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TRPOConfig:
    """Hyper-parameters; the defaults are Desai et al. 2020, appendix, agent policy."""

    num_envs: int = static(50)
    num_steps: int = static(100)  # 50 x 100 = 5000 steps a batch, as the paper
    hidden: tuple[int, ...] = static((64, 64))
    initial_log_std: Number = 0.0
    max_kl: Number = 0.01
    discount: Number = 0.995
    trace: Number = 0.97
    cg_damping: Number = 0.1
    cg_iterations: int = static(20)
    fisher_share: float = static(1.0)  # of the batch; stable-baselines takes every fifth sample
    line_search_steps: int = static(10)  # stable-baselines TRPO
    value_learning_rate: Number = 1e-3
    value_epochs: int = static(5)
    value_minibatch: int = static(128)  # stable-baselines TRPO

    def averaged(self, num_actions: int) -> "TRPOConfig":
        """Return it with its trust region's limit on the mean over the action's components.

        The paper limits their sum. sb3-contrib's TRPO averages the KL divergence, and with it its
        Hessian, to which the damping is added.
        """
        return dataclasses.replace(
            self, max_kl=num_actions * self.max_kl, cg_damping=num_actions * self.cg_damping
        )


def make(env: Env, config: TRPOConfig) -> Agent:
    """Build a TRPO agent for an environment.

    The config's numbers are leaves: a function that is given some, builds an agent with them and
    trains it can be mapped over them by `jax.vmap`, as over seeds (`examples/05_sweep.py`).
    """
    policy_net = GaussianPolicy(env.action_size, config.hidden, config.initial_log_std)
    value_net = ValueNet(config.hidden)
    policy, mean = actor_critic.make_policy(env, policy_net)

    def init(key: jax.Array, env_params: Params) -> ActorCriticState:
        state = actor_critic.init_state(
            env, env_params, policy_net, value_net, key, config.num_envs
        )
        return state._replace(optimiser=value_optimiser(config).init(state.value))

    def step(state: ActorCriticState, env_params: Params):
        state, transitions = actor_critic.collect(env, env_params, policy, state, config.num_steps)
        batch = actor_critic.prepare(
            env, value_net, state, transitions, config.discount, config.trace
        )
        weights, metrics = policy_step(policy_net, state.policy.weights, batch, config)

        key, value_key = jax.random.split(state.key)
        value, optimiser_state, value_loss = fit_value(
            value_net, state.value, state.optimiser, batch, value_key, config
        )
        state = state._replace(
            policy=state.policy._replace(weights=weights),
            value=value,
            optimiser=optimiser_state,
            key=key,
        )
        metrics = metrics | actor_critic.episode_metrics(env, state, transitions)
        metrics["value_loss"] = value_loss
        return actor_critic.observe(env, state, transitions), metrics, transitions

    return Agent(init, step, policy, mean, config.num_envs * config.num_steps)


def value_optimiser(config: TRPOConfig) -> optax.GradientTransformation:
    """Return what fits the value network."""
    return optax.adam(config.value_learning_rate)


def fit_value(
    network: ValueNet,
    weights: Params,
    optimiser_state: optax.OptState,
    batch: Batch,
    key: jax.Array,
    config: TRPOConfig,
) -> tuple[Params, optax.OptState, jax.Array]:
    """Fit the value network to a batch's targets.

    Args:
        network: The value network.
        weights: Its weights.
        optimiser_state: State of `value_optimiser`.
        batch: Experience, [N].
        key: PRNG key.
        config: Epochs and size of the minibatches.

    Returns:
        The new weights, the optimiser's state and the mean loss on the way, [].
    """
    optimiser = value_optimiser(config)

    def minibatch_step(carry, batch: Batch):
        weights, optimiser_state = carry

        def loss(weights):
            error = forward(network, weights, batch.obs) - batch.value_target
            return jnp.mean(jnp.square(error))

        value_loss, grads = jax.value_and_grad(loss)(weights)
        updates, optimiser_state = optimiser.update(grads, optimiser_state)
        return (optax.apply_updates(weights, updates), optimiser_state), value_loss

    def epoch(carry, key):
        number = max(1, batch.action.shape[0] // config.value_minibatch)
        minibatches = actor_critic.minibatches(batch, key, number)
        return jax.lax.scan(minibatch_step, carry, minibatches)

    keys = jax.random.split(key, config.value_epochs)
    carry: Any = (weights, optimiser_state)
    (weights, optimiser_state), losses = jax.lax.scan(epoch, carry, keys)
    return weights, optimiser_state, losses.mean()


def policy_step(
    network: GaussianPolicy, weights: Params, batch: Batch, config: TRPOConfig
) -> tuple[Params, dict[str, jax.Array]]:
    """Take one natural-gradient step within the trust region.

    Args:
        network: The policy.
        weights: Its weights.
        batch: Experience, [N].
        config: Trust region and search.

    Returns:
        The new weights (the old ones if no step improves the surrogate within the trust region)
        and metrics.
    """
    flat, unflatten = ravel_pytree(weights)
    before = forward(network, weights, batch.obs)

    def surrogate(flat: jax.Array) -> jax.Array:
        log_prob = forward(network, unflatten(flat), batch.obs).log_prob(batch.action)
        return jnp.mean(jnp.exp(log_prob - batch.log_prob) * batch.advantage)

    def kl(flat: jax.Array) -> jax.Array:
        return jnp.mean(before.kl_divergence(forward(network, unflatten(flat), batch.obs)))

    base, gradient = jax.value_and_grad(surrogate)(flat)
    seen = batch.obs[spread(batch.obs.shape[0], config.fisher_share)]
    fisher = fisher_vector_product(network, flat, unflatten, seen, config.cg_damping)
    direction = conjugate_gradient(fisher, gradient, config.cg_iterations)
    curvature = direction @ fisher(direction)
    full_step = direction * jnp.sqrt(2 * config.max_kl / jnp.maximum(curvature, 1e-12))
    flat, fraction = line_search(flat, full_step, lambda x: (surrogate(x) - base, kl(x)), config)
    return unflatten(flat), {
        "kl": kl(flat),
        "surrogate": surrogate(flat) - base,
        "step_fraction": fraction,
        "entropy": jnp.mean(before.entropy()),
    }


def spread(num: int, share: float) -> np.ndarray:
    """Return a share of the indices below `num`, at even distances, one or more.

    The Fisher information is a mean over states, and a tenth of a batch estimates it well enough
    for the direction; the line search judges the step on all of it (Schulman et al. 2015,
    appendix C). OpenAI's and stable-baselines' TRPO, the latter used by Desai et al. 2020, take
    every fifth.

    Raises:
        ValueError: The share is not in (0, 1].
    """
    if not 0 < share <= 1:
        raise ValueError(f"fisher_share is {share}; expected more than 0 and at most 1")
    return np.linspace(0, num - 1, max(1, round(share * num))).round().astype(int)


def fisher_vector_product(
    network: GaussianPolicy,
    flat: jax.Array,
    unflatten: Callable[[jax.Array], Params],
    obs: jax.Array,
    damping: Number,
) -> Callable[[jax.Array], jax.Array]:
    """Return v -> (F + damping I) v, with F the policy's mean Fisher information.

    For a diagonal Gaussian with mean μ and log standard deviation l, F is
    E[J_μᵀ diag(e^-2l) J_μ + 2 J_lᵀ J_l]; the network is linearised once for all products.
    """

    def moments(flat: jax.Array):
        distribution = forward(network, unflatten(flat), obs)
        return distribution.loc, jnp.log(distribution.scale_diag)

    (_, log_std), push = jax.linearize(moments, flat)
    pull = jax.linear_transpose(push, flat)

    def product(vector: jax.Array) -> jax.Array:
        mean, spread = push(vector)
        weighted = (mean * jnp.exp(-2 * log_std), 2 * spread)
        (result,) = pull(weighted)
        return result / obs.shape[0] + damping * vector

    return product


def conjugate_gradient(
    product: Callable[[jax.Array], jax.Array], target: jax.Array, iterations: int
) -> jax.Array:
    """Solve A x = target for a positive definite A given by its product with a vector."""

    def iterate(_, carry):
        x, residual, direction, squared = carry
        image = product(direction)
        step = squared / jnp.maximum(direction @ image, 1e-20)
        x = x + step * direction
        residual = residual - step * image
        new_squared = residual @ residual
        direction = residual + new_squared / jnp.maximum(squared, 1e-20) * direction
        return x, residual, direction, new_squared

    start = (jnp.zeros_like(target), target, target, target @ target)
    return jax.lax.fori_loop(0, iterations, iterate, start)[0]


def line_search(flat, full_step, evaluate, config: TRPOConfig) -> tuple[jax.Array, jax.Array]:
    """Halve the step until it improves the surrogate and keeps the trust region.

    Args:
        flat: The weights, [P].
        full_step: The longest step, [P].
        evaluate: Weights to (surrogate's improvement, KL divergence).
        config: Trust region and number of halvings.

    Returns:
        The weights and the fraction of the step taken; 0 where none is good.
    """

    def attempt(carry):
        tries, _, _ = carry
        fraction = 0.5**tries
        improvement, kl = evaluate(flat + fraction * full_step)
        good = (improvement > 0) & (kl <= 1.5 * config.max_kl)
        return tries + 1, good, fraction

    def unfinished(carry):
        tries, good, _ = carry
        return ~good & (tries < config.line_search_steps)

    start = (jnp.zeros((), jnp.float32), jnp.zeros((), bool), jnp.ones((), jnp.float32))
    _, good, fraction = jax.lax.while_loop(unfinished, attempt, start)
    fraction = jnp.where(good, fraction, 0.0)
    return flat + fraction * full_step, fraction
