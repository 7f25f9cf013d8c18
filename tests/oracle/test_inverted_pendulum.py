"""Our InvertedPendulum against Gymnasium's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.envs.mujoco.inverted_pendulum_v4 import InvertedPendulumEnv as PendulumV4
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv as PendulumV5

from garat_jax import dynamics
from garat_jax.env import EnvState, make_world
from garat_jax.envs.inverted_pendulum import RESET_NOISE, InvertedPendulum

# Cart position, pole angle, their rates, action.
CASES = np.asarray(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0],
        [0.1, -0.05, 0.3, 0.4, 1.3],
        [-0.4, 0.1, -1.0, -0.5, -2.7],
        [0.2, 0.05, 0.0, 0.0, 5.0],  # beyond the action's bounds
        [0.0, 0.199, 0.0, 0.0, 0.0],  # falls, but not within the step
        [0.0, 0.199, 0.0, 0.5, 0.0],  # falls
        [0.0, -0.199, 0.0, -0.5, 0.0],
        [0.0, 0.21, 0.0, -1.0, 0.0],  # comes back
        [0.99, 0.0, 2.0, 0.0, 3.0],  # the cart hits its stop
        [-0.99, 0.1, -2.0, 0.3, -3.0],
    ]
)


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True):
        yield


def step_ours(engine: str, cases: np.ndarray):
    """Take one step from each case: observations, rewards and terminations."""
    world = make_world(InvertedPendulum(), engine=engine)

    def step(case):
        physics = dynamics.initial_state(world.params, case[:2], case[2:4])
        state = EnvState(physics, case[:4], jnp.zeros((), jnp.int32))
        result = world.env.step(world.params, state, case[4:], jax.random.key(0))
        return result.state.obs, result.reward, result.terminated

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(step))(jnp.asarray(cases)))


def step_gymnasiums(make, cases: np.ndarray):
    env = make()
    observations, rewards, terminations = [], [], []
    low, high = env.action_space.low, env.action_space.high
    for case in cases:
        env.reset(seed=0)
        env.set_state(case[:2], case[2:4])
        obs, reward, terminated, _, _ = env.step(np.clip(case[4:], low, high))
        observations.append(obs)
        rewards.append(reward)
        terminations.append(terminated)
    env.close()
    return np.asarray(observations), np.asarray(rewards), np.asarray(terminations)


@pytest.mark.parametrize(
    ("engine", "tolerance"),
    [("mujoco", 1e-7), pytest.param("mjx", 2e-4, marks=pytest.mark.slow)],
)
@pytest.mark.parametrize("make", [PendulumV4, PendulumV5])
def test_a_step_is_gymnasiums(engine, tolerance, make):
    obs, reward, terminated = step_ours(engine, CASES)
    expected_obs, expected_reward, expected_terminated = step_gymnasiums(make, CASES)
    np.testing.assert_allclose(obs, expected_obs, atol=tolerance)
    np.testing.assert_array_equal(terminated, expected_terminated)
    assert 0 < terminated.sum() < len(CASES)
    if make is PendulumV4:
        np.testing.assert_array_equal(reward, expected_reward)
    else:  # from v5 on the step that ends an episode pays nothing; Desai et al. 2020 precede it
        np.testing.assert_array_equal(reward * ~terminated, expected_reward)


def test_a_state_that_is_not_finite_ends_the_episode():
    world = make_world(InvertedPendulum(), engine="mujoco")
    physics = world.env.reset(world.params, jax.random.key(0)).physics
    assert not InvertedPendulum().terminated(physics)
    for field in ("qpos", "qvel"):
        for number in (0, 1):
            for bad in (np.nan, np.inf):
                lost = getattr(physics, field).at[number].set(bad)
                assert InvertedPendulum().terminated(physics._replace(**{field: lost}))


def test_action_bounds_time_step_and_time_limit_are_gymnasiums():
    world = make_world(InvertedPendulum(), engine="mujoco")
    reference = PendulumV4()
    np.testing.assert_array_equal(world.env.action_low, reference.action_space.low)
    np.testing.assert_array_equal(world.env.action_high, reference.action_space.high)
    assert world.params.timestep * InvertedPendulum.num_substeps == pytest.approx(reference.dt)
    assert world.env.episode_length == 1000
    assert world.env.obs_size == reference.observation_space.shape[0]
    reference.close()


def test_reset_draws_uniformly_from_the_same_range():
    world = make_world(InvertedPendulum(), engine="mujoco")
    keys = jax.random.split(jax.random.key(0), 500)
    obs = np.asarray(jax.jit(jax.vmap(lambda key: world.env.reset(world.params, key).obs))(keys))
    reference = PendulumV4()
    theirs = np.stack([reference.reset(seed=i)[0] for i in range(500)])
    reference.close()
    assert np.abs(obs).max() <= RESET_NOISE
    for sample in (obs, theirs):
        np.testing.assert_allclose(sample.min(axis=0), -RESET_NOISE, atol=5e-4)
        np.testing.assert_allclose(sample.max(axis=0), RESET_NOISE, atol=5e-4)
        np.testing.assert_allclose(sample.std(axis=0), RESET_NOISE / np.sqrt(3), rtol=0.1)
    assert np.abs(np.corrcoef(obs.T) - np.eye(4)).max() < 0.2


def test_the_time_limit_truncates_and_a_fall_at_that_step_terminates():
    world = make_world(InvertedPendulum(), engine="mujoco")
    for angle_rate, terminates in ((0.0, False), (50.0, True)):
        physics = dynamics.initial_state(world.params, jnp.zeros(2), jnp.asarray([0.0, angle_rate]))
        state = EnvState(physics, jnp.zeros(4), jnp.asarray(999, jnp.int32))
        result = world.env.step(world.params, state, jnp.zeros(1), jax.random.key(0))
        assert (bool(result.terminated), bool(result.truncated)) == (terminates, not terminates)
