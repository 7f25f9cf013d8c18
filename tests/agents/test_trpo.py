"""Natural gradient, trust region and line search against closed forms."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from garat_jax.agents import trpo
from garat_jax.agents.actor_critic import Batch, minibatches
from garat_jax.agents.trpo import TRPOConfig
from garat_jax.networks import GaussianPolicy, ValueNet, forward

NETWORK = GaussianPolicy(size=2, hidden=(5,), initial_log_std=-0.5)
CONFIG = TRPOConfig(fisher_share=1.0)
policy_step = jax.jit(functools.partial(trpo.policy_step, NETWORK), static_argnames="config")


@functools.cache
def weights_and_batch(seed: int = 0, num: int = 64):
    """Return weights, and a batch drawn from the policy with random advantages."""
    keys = jax.random.split(jax.random.key(seed), 4)
    obs = jax.random.normal(keys[0], (num, 3))
    weights = NETWORK.init(keys[1], obs)
    # The output layer starts near zero, which would hide what lies below it.
    weights = jax.tree.map(
        lambda w: w + 0.2 * jnp.cos(jnp.arange(w.size)).reshape(w.shape), weights
    )
    action, log_prob = forward(NETWORK, weights, obs).sample_and_log_prob(seed=keys[2])
    advantage = jax.random.normal(keys[3], (num,)) + action[:, 0]
    return weights, Batch(obs, action, log_prob, advantage, jnp.zeros(num))


@jax.jit
def kl_between(old, new, obs) -> jax.Array:
    return jnp.mean(forward(NETWORK, old, obs).kl_divergence(forward(NETWORK, new, obs)))


@jax.jit
def kl_hessian(weights, obs) -> jax.Array:
    flat, unflatten = ravel_pytree(weights)
    return jax.hessian(lambda x: kl_between(weights, unflatten(x), obs))(flat)


@jax.jit
def surrogate(weights, batch: Batch) -> jax.Array:
    ratio = jnp.exp(forward(NETWORK, weights, batch.obs).log_prob(batch.action) - batch.log_prob)
    return jnp.mean(ratio * batch.advantage)


def test_conjugate_gradient_solves_like_numpy():
    matrix = np.random.default_rng(0).normal(size=(12, 12))
    matrix = (matrix @ matrix.T + np.eye(12)).astype(np.float32)
    target = np.linspace(-1, 2, 12, dtype=np.float32)
    solution = trpo.conjugate_gradient(lambda v: matrix @ v, jnp.asarray(target), 40)
    np.testing.assert_allclose(solution, np.linalg.solve(matrix, target), rtol=2e-3, atol=1e-4)
    early = trpo.conjugate_gradient(lambda v: matrix @ v, jnp.asarray(target), 2)
    assert np.abs(matrix @ early - target).max() > 10 * np.abs(matrix @ solution - target).max()


def test_conjugate_gradient_of_zero_is_zero():
    solution = trpo.conjugate_gradient(lambda v: 2 * v, jnp.zeros(3), 20)
    np.testing.assert_array_equal(solution, np.zeros(3))


def test_fisher_vector_product_is_the_hessian_of_the_kl():
    weights, batch = weights_and_batch()
    flat, unflatten = ravel_pytree(weights)
    hessian = kl_hessian(weights, batch.obs)

    def columns(flat):
        product = trpo.fisher_vector_product(NETWORK, flat, unflatten, batch.obs, 0.3)
        return jax.vmap(product)(jnp.eye(flat.size))

    np.testing.assert_allclose(
        jax.jit(columns)(flat), hessian + 0.3 * jnp.eye(flat.size), atol=2e-5
    )
    assert np.abs(hessian).max() > 0.1


@pytest.mark.parametrize("seed", range(3))
def test_a_step_improves_the_surrogate_within_the_trust_region(seed):
    weights, batch = weights_and_batch(seed)
    new, metrics = policy_step(weights, batch, config=CONFIG)
    kl = kl_between(weights, new, batch.obs)
    gain = surrogate(new, batch) - surrogate(weights, batch)
    assert 0.1 * CONFIG.max_kl < kl <= 1.5 * CONFIG.max_kl
    assert gain > 0
    assert metrics["step_fraction"] > 0
    np.testing.assert_allclose([metrics["kl"], metrics["surrogate"]], [kl, gain], atol=1e-5)


def test_the_step_is_the_natural_gradient_of_the_trust_region_length():
    weights, batch = weights_and_batch()
    flat, unflatten = ravel_pytree(weights)
    config = TRPOConfig(cg_iterations=200, fisher_share=1.0)
    new, metrics = policy_step(weights, batch, config=config)
    gradient = jax.grad(lambda x: surrogate(unflatten(x), batch))(flat)
    hessian = kl_hessian(weights, batch.obs)
    damped = np.asarray(hessian) + config.cg_damping * np.eye(flat.size)
    direction = np.linalg.solve(damped, gradient)
    length = np.sqrt(2 * config.max_kl / (direction @ damped @ direction))
    step = (ravel_pytree(new)[0] - flat) / metrics["step_fraction"]
    np.testing.assert_allclose(step, length * direction, rtol=0.01, atol=1e-4)


def test_fisher_information_of_a_share_of_the_batch_gives_nearly_the_same_step():
    weights, batch = weights_and_batch(num=6400)
    whole, _ = policy_step(weights, batch, config=CONFIG)
    part, metrics = policy_step(weights, batch, config=TRPOConfig(fisher_share=0.1))
    steps = [ravel_pytree(new)[0] - ravel_pytree(weights)[0] for new in (whole, part)]
    lengths = [jnp.linalg.norm(step) for step in steps]
    assert steps[0] @ steps[1] > 0.9 * lengths[0] * lengths[1]
    assert not np.array_equal(*steps)
    assert 0.1 * CONFIG.max_kl < metrics["kl"] <= 1.5 * CONFIG.max_kl
    assert metrics["surrogate"] > 0


def test_a_share_is_spread_over_the_batch():
    np.testing.assert_array_equal(trpo.spread(5, 1.0), np.arange(5))
    np.testing.assert_array_equal(trpo.spread(5, 0.6), [0, 2, 4])
    assert len(trpo.spread(5, 0.01)) == 1
    assert len(set(trpo.spread(5000, 0.1) % 50)) == 50  # not always the same environments
    with pytest.raises(ValueError, match="expected more than 0"):
        trpo.spread(5, 0.0)


def test_without_an_advantage_the_weights_stay():
    weights, batch = weights_and_batch()
    flat_batch = batch._replace(advantage=jnp.zeros_like(batch.advantage))
    new, metrics = policy_step(weights, flat_batch, config=CONFIG)
    jax.tree.map(np.testing.assert_array_equal, new, weights)
    assert metrics["step_fraction"] == 0


def test_line_search_refuses_what_never_improves_and_what_leaves_the_region():
    flat, step = jnp.ones(2), jnp.asarray([1.0, -1.0])
    for improvement, kl in ((-1.0, 0.0), (1.0, 1.0), (jnp.nan, 0.0), (1.0, jnp.nan)):
        found, fraction = trpo.line_search(
            flat, step, lambda _, i=improvement, k=kl: (jnp.asarray(i), jnp.asarray(k)), CONFIG
        )
        np.testing.assert_array_equal(found, flat)
        assert fraction == 0


@pytest.mark.parametrize(("longest", "fraction"), [(1.0, 1.0), (0.6, 0.5), (0.2, 0.125)])
def test_line_search_takes_the_longest_good_step(longest, fraction):
    def evaluate(x):
        return jnp.where(x[0] <= longest, 1.0, -1.0), jnp.zeros(())

    found, taken = trpo.line_search(jnp.zeros(1), jnp.ones(1), evaluate, CONFIG)
    assert taken == fraction
    np.testing.assert_array_equal(found, [fraction])


def test_a_limit_on_the_mean_of_the_components_allows_their_number_of_times_as_much():
    weights, batch = weights_and_batch()
    summed = TRPOConfig(max_kl=1e-5)
    averaged = summed.averaged(NETWORK.size)
    assert averaged.cg_damping == pytest.approx(NETWORK.size * summed.cg_damping)
    undamped = (dataclasses.replace(config, cg_damping=0.0) for config in (summed, averaged))
    one, two = (float(policy_step(weights, batch, config=c)[1]["kl"]) for c in undamped)
    assert two == pytest.approx(NETWORK.size * one, rel=0.05)


def test_a_batch_smaller_than_a_minibatch_is_one():
    _, batch = weights_and_batch(num=20)
    value_net = ValueNet((5,))
    value = value_net.init(jax.random.key(0), batch.obs)
    optimiser = trpo.value_optimiser(CONFIG).init(value)
    fitted = trpo.fit_value(value_net, value, optimiser, batch, jax.random.key(1), CONFIG)
    assert np.isfinite(fitted[2])
    with pytest.raises(ValueError, match="a batch of 20 steps cannot make 21 minibatches"):
        minibatches(batch, jax.random.key(0), 21)
