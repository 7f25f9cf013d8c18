"""Generalised advantage estimation against sums done by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from garat_jax.agents.advantage import gae, standardise
from garat_jax.types import Transition

GAMMA, LAMBDA = 0.5, 0.5
REWARD = [1.0, 2.0, 4.0]
VALUE = [0.5, 1.5, 2.5]
NEXT_VALUE = [10.0, 20.0, 40.0]


def transitions(reward, terminated=(), truncated=()) -> Transition:
    """Return one environment's steps [T, 1]; `terminated` and `truncated` list the steps."""
    steps = np.arange(len(reward))
    empty = jnp.zeros((len(reward), 1, 1))
    return Transition(
        obs=empty,
        action=empty,
        reward=jnp.asarray(reward)[:, None],
        next_obs=empty,
        terminated=jnp.asarray(np.isin(steps, terminated))[:, None],
        truncated=jnp.asarray(np.isin(steps, truncated))[:, None],
        log_prob=empty[..., 0],
        faulty=jnp.zeros((len(reward), 1), bool),
    )


def column(values) -> jax.Array:
    return jnp.asarray(values)[:, None]


@pytest.mark.parametrize(
    ("terminated", "truncated", "deltas", "carries_on"),
    [
        ((), (), [5.5, 10.5, 21.5], [1, 1]),
        ((1,), (), [5.5, 0.5, 21.5], [1, 0]),  # no value beyond a terminated step
        ((), (1,), [5.5, 10.5, 21.5], [1, 0]),  # a truncated step bootstraps
        ((2,), (0,), [5.5, 10.5, 1.5], [0, 1]),
    ],
)
def test_gae_is_the_sum_by_hand(terminated, truncated, deltas, carries_on):
    third = deltas[2]
    second = deltas[1] + GAMMA * LAMBDA * carries_on[1] * third
    first = deltas[0] + GAMMA * LAMBDA * carries_on[0] * second
    advantage, target = gae(
        transitions(REWARD, terminated, truncated),
        column(VALUE),
        column(NEXT_VALUE),
        GAMMA,
        LAMBDA,
    )
    np.testing.assert_allclose(advantage[:, 0], [first, second, third])
    np.testing.assert_allclose(target, advantage + column(VALUE))


def test_with_a_full_trace_targets_are_discounted_returns():
    steps = transitions(REWARD, terminated=(2,))
    values = column([7.0, -3.0, 5.0])
    next_values = column([-3.0, 5.0, 99.0])
    _, target = gae(steps, values, next_values, 0.9, 1.0)
    np.testing.assert_allclose(target[:, 0], [1 + 0.9 * 2 + 0.81 * 4, 2 + 0.9 * 4, 4], rtol=1e-6)


def test_without_discount_or_trace_an_advantage_is_reward_less_value():
    advantage, target = gae(transitions(REWARD), column(VALUE), column(NEXT_VALUE), 0.0, 0.0)
    np.testing.assert_allclose(advantage, column(REWARD) - column(VALUE))
    np.testing.assert_allclose(target, column(REWARD))


def test_environments_do_not_mix():
    one, other = transitions(REWARD, (1,)), transitions([3.0, -1.0, 0.5], (), (0,))
    both = jax.tree.map(lambda *x: jnp.concatenate(x, axis=1), one, other)
    values = jnp.concatenate([column(VALUE), column(NEXT_VALUE)], axis=1)
    together, _ = gae(both, values, values[:, ::-1], GAMMA, LAMBDA)
    apart = [
        gae(steps, values[:, i : i + 1], values[:, 1 - i : 2 - i], GAMMA, LAMBDA)[0]
        for i, steps in enumerate((one, other))
    ]
    np.testing.assert_allclose(together, jnp.concatenate(apart, axis=1))


def test_standardise_keeps_the_order_and_survives_a_constant():
    values = jnp.asarray([[3.0, -1.0], [10.0, 4.0]])
    shifted = standardise(values)
    np.testing.assert_allclose([shifted.mean(), shifted.std()], [0.0, 1.0], atol=1e-6)
    np.testing.assert_array_equal(jnp.argsort(shifted.ravel()), jnp.argsort(values.ravel()))
    np.testing.assert_array_equal(standardise(jnp.full((3, 2), 7.0)), np.zeros((3, 2)))
