"""MuJoCo Playground's environments as ours."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from garat_jax.adapters import from_brax
from garat_jax.agents import ppo
from garat_jax.errors import UserError

with warnings.catch_warnings():  # Playground's dependencies' own deprecations
    warnings.simplefilter("ignore")
    registry = pytest.importorskip(
        "mujoco_playground", reason="MuJoCo Playground is not installed: pip install playground"
    ).registry

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]


@pytest.fixture(scope="module")
def cartpole():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return registry.load("CartpoleBalance", config_overrides={"impl": "jax"})


def test_a_playground_environment_steps_as_it_does_there(cartpole):
    env = from_brax(cartpole, episode_length=3)
    assert (env.obs_size, env.action_size) == (5, 1)
    key, action = jax.random.key(0), jnp.asarray([0.3])
    ours = jax.jit(env.reset)(None, key)
    theirs = jax.jit(cartpole.reset)(jax.random.key_data(key))
    our_step, their_step = jax.jit(env.step), jax.jit(cartpole.step)
    for count in range(1, 4):
        result = our_step(None, ours, action, key)
        ours, theirs = result.state, their_step(theirs, action)
        np.testing.assert_array_equal(ours.obs, theirs.obs)
        assert result.reward == theirs.reward
        assert (bool(result.terminated), bool(result.truncated)) == (False, count == 3)


def test_ppo_trains_on_a_playground_environment(cartpole):
    env = from_brax(cartpole, episode_length=100)
    agent = ppo.make(env, ppo.PPOConfig(num_envs=8, num_steps=16))
    state = jax.jit(lambda key: agent.init(key, None))(jax.random.key(0))
    step = jax.jit(lambda state: agent.step(state, None)[:2])
    for _ in range(2):
        state, metrics = step(state)
    assert int(state.env_steps) == 256
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((state.policy, metrics)))
    assert 0 < metrics["reward"] <= 1


def test_wrapped_playground_environments_are_refused(cartpole):
    from mujoco_playground import wrapper

    wrapped = wrapper.wrap_for_brax_training(cartpole, episode_length=10)
    with pytest.raises(UserError, match="wraps"):
        from_brax(wrapped, episode_length=10)
