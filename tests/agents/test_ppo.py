"""PPO's loss, term by term, by hand."""

import distrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from garat_jax.agents import actor_critic, ppo, trpo
from garat_jax.agents.actor_critic import Batch
from garat_jax.agents.ppo import PPOConfig, ppo_loss
from garat_jax.agents.trpo import TRPOConfig
from tests.probe_envs import Walk, WalkParams

CONFIG = PPOConfig(clip=0.2, value_weight=0.5, entropy_weight=0.0)
ACTION = 0.7


def loss_of(mean, ratio: float, advantage: float, config=CONFIG, value=0.0, target=0.0):
    """Return loss and metrics of one action whose probability is `ratio` times the old one's."""
    distribution = distrax.MultivariateNormalDiag(jnp.reshape(mean, (1, 1)), jnp.ones((1, 1)))
    action = jnp.full((1, 1), ACTION)
    batch = Batch(
        obs=jnp.zeros((1, 1)),
        action=action,
        # At mean 0, so that a gradient with respect to the mean is taken at this ratio.
        log_prob=distrax.Normal(0.0, 1.0).log_prob(ACTION)[None] - jnp.log(ratio),
        advantage=jnp.asarray([advantage]),
        value_target=jnp.asarray([target]),
    )
    return ppo_loss(distribution, jnp.asarray([value]), batch, config)


@pytest.mark.parametrize(
    ("ratio", "advantage", "loss", "pushes"),
    [
        (1.0, 2.0, -2.0, True),
        (1.1, 2.0, -2.2, True),
        (1.5, 2.0, -2.4, False),  # a good action is likely enough
        (0.5, 2.0, -1.0, True),
        (0.5, -2.0, 1.6, False),  # a bad action is unlikely enough
        (1.5, -2.0, 3.0, True),
    ],
)
def test_the_clipped_surrogate_and_where_it_stops_pushing(ratio, advantage, loss, pushes):
    value, metrics = loss_of(jnp.zeros(()), ratio, advantage)
    np.testing.assert_allclose(value, loss, rtol=1e-5)
    np.testing.assert_allclose(metrics["policy_loss"], loss, rtol=1e-5)
    slope = jax.grad(lambda mean: loss_of(mean, ratio, advantage)[0])(jnp.zeros(()))
    if not pushes:
        assert slope == 0
    else:  # descending the loss moves the mean towards a good action, away from a bad one
        np.testing.assert_allclose(slope, -ratio * advantage * ACTION, rtol=1e-5)


def test_value_and_entropy_terms():
    config = PPOConfig(value_weight=0.5, entropy_weight=0.1)
    loss, metrics = loss_of(jnp.zeros(()), 1.0, 0.0, config, value=1.0, target=4.0)
    entropy = 0.5 * np.log(2 * np.pi * np.e)
    np.testing.assert_allclose(metrics["value_loss"], 9.0, rtol=1e-6)
    np.testing.assert_allclose(metrics["entropy"], entropy, rtol=1e-6)
    np.testing.assert_allclose(loss, 0.5 * 9.0 - 0.1 * entropy, rtol=1e-6)


def test_kl_is_zero_for_the_same_policy_and_positive_for_another():
    assert loss_of(jnp.zeros(()), 1.0, 1.0)[1]["kl"] == pytest.approx(0, abs=1e-6)
    for ratio in (0.8, 1.3):
        assert loss_of(jnp.zeros(()), ratio, 1.0)[1]["kl"] == pytest.approx(
            ratio - 1 - np.log(ratio), rel=1e-4
        )


def test_minibatches_hold_every_row_once_and_whole():
    rows = jnp.arange(12.0)
    batch = Batch(rows[:, None], rows[:, None] * 2, rows * 3, rows * 4, rows * 5)
    cut = actor_critic.minibatches(batch, jax.random.key(0), 4)
    assert cut.obs.shape == (4, 3, 1)
    order = cut.obs.ravel()
    np.testing.assert_array_equal(jnp.sort(order), rows)
    assert (order != rows).any()
    np.testing.assert_array_equal(cut.action.ravel(), 2 * order)
    np.testing.assert_array_equal(cut.value_target.ravel(), 5 * order)


def test_no_episode_is_said_to_be_longer_than_it_may_be():
    """The first batch, of 4 environments and 5 steps, ends before any episode of 6 steps does."""
    env, params = Walk(), WalkParams(0.0)
    config = PPOConfig(num_envs=4, num_steps=5, num_minibatches=1)
    agent = ppo.make(env, config)
    state = agent.init(jax.random.key(0), params)
    state, metrics, _ = agent.step(state, params)
    assert metrics["episode_length"] == env.episode_length
    _, metrics, _ = agent.step(state, params)  # each ends one
    assert metrics["episode_length"] == 5


@pytest.mark.parametrize(
    ("agent", "config"), [(ppo, PPOConfig), (trpo, TRPOConfig)], ids=["ppo", "trpo"]
)
def test_after_a_batch_observations_are_normalised_by_all_that_was_seen(agent, config):
    env, params = Walk(), WalkParams(0.1)
    step, state = started(agent.make(env, config(num_envs=4, num_steps=10)), params)
    seen = []
    for _ in range(2):
        state, _, transitions = step(state, params)
        seen.append(np.asarray(env.features(transitions.obs)).reshape(-1, env.obs_size))
        both = np.concatenate(seen)
        np.testing.assert_allclose(state.policy.normaliser.mean, both.mean(axis=0), rtol=1e-5)
        np.testing.assert_allclose(state.policy.normaliser.std, both.std(axis=0), rtol=1e-5)


def test_a_batch_is_learned_from_as_it_was_normalised_when_it_was_collected():
    params = WalkParams(0.1)
    config = PPOConfig(num_envs=4, num_steps=10, learning_rate=0.0)
    step, state = started(ppo.make(Walk(), config), params)
    for _ in range(2):
        state, metrics, _ = step(state, params)
        assert metrics["kl"] == pytest.approx(0, abs=1e-6)


def started(agent, params):
    """Return an agent's compiled step, and its start."""
    return jax.jit(agent.step), agent.init(jax.random.key(0), params)
