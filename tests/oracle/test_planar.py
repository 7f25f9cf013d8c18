"""Our Hopper, HalfCheetah and Walker2d against Gymnasium's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.envs.mujoco.half_cheetah_v4 import HalfCheetahEnv as HalfCheetahV4
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv as HalfCheetahV5
from gymnasium.envs.mujoco.hopper_v4 import HopperEnv as HopperV4
from gymnasium.envs.mujoco.hopper_v5 import HopperEnv as HopperV5
from gymnasium.envs.mujoco.walker2d_v4 import Walker2dEnv as Walker2dV4
from gymnasium.envs.mujoco.walker2d_v5 import Walker2dEnv as Walker2dV5

from garat_jax import dynamics
from garat_jax.dynamics import Override
from garat_jax.env import EnvState, make_world
from garat_jax.envs.half_cheetah import HalfCheetah
from garat_jax.envs.hopper import Hopper
from garat_jax.envs.walker2d import Walker2d

TASKS = {
    "hopper": (Hopper, HopperV4),
    "half_cheetah": (HalfCheetah, HalfCheetahV4),
    "walker2d": (Walker2d, Walker2dV4),
}
EACH_TASK = pytest.mark.parametrize(("task", "reference"), TASKS.values(), ids=TASKS)
# From v5 on only the steps of a robot that is up pay for being alive, and both of the walker's
# feet grip alike; Desai et al. 2020 precede it.
VERSIONS = pytest.mark.parametrize(
    ("task", "reference", "overrides"),
    [
        (Hopper, HopperV4, ()),
        (Hopper, HopperV5, ()),
        (HalfCheetah, HalfCheetahV4, ()),
        (HalfCheetah, HalfCheetahV5, ()),
        (Walker2d, Walker2dV4, ()),
        (Walker2d, Walker2dV5, (Override("geom", "right_foot", "friction", 1.9),)),
    ],
)


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True):
        yield


def gather(make, count: int) -> tuple[np.ndarray, ...]:
    """Step Gymnasium's environment under random actions: `count` steps before, action, and after.

    Actions go beyond their bounds, and episodes on past their end, so that the robot also lies.
    """
    env = make()
    random = np.random.default_rng(0)
    low, high = env.action_space.low, env.action_space.high
    rows = []
    for number in range(count):
        if number % 25 == 0:
            env.reset(seed=number)
        qpos, qvel = env.data.qpos.copy(), env.data.qvel.copy()
        env.set_state(qpos, qvel)
        num_contacts = env.data.ncon
        action = random.normal(0, 1.2, env.action_space.shape)
        obs, reward, terminated, _, _ = env.step(np.clip(action, low, high))
        rows.append((qpos, qvel, action, obs, reward, terminated, num_contacts))
    env.close()
    return tuple(np.asarray(column) for column in zip(*rows, strict=True))


def step_ours(world, qpos, qvel, actions):
    """Take a step for each of `actions` [steps, N, nu] from N states."""

    def run(qpos, qvel, actions):
        physics = dynamics.initial_state(world.params, qpos, qvel)
        state = EnvState(physics, world.env.task.observe(physics), jnp.zeros((), jnp.int32))

        def step(state, action):
            result = world.env.step(world.params, state, action, jax.random.key(0))
            return result.state, (result.state.obs, result.reward, result.terminated)

        return jax.lax.scan(step, state, actions)[1]

    over_states = jax.vmap(run, in_axes=(0, 0, 1), out_axes=1)
    return jax.tree.map(np.asarray, jax.jit(over_states)(qpos, qvel, actions))


@VERSIONS
def test_a_step_is_gymnasiums(task, reference, overrides):
    qpos, qvel, action, obs, reward, terminated, contacts = gather(reference, 300)
    world = make_world(task(), overrides, engine="mujoco")
    ours = step_ours(world, qpos, qvel, action[None])
    np.testing.assert_allclose(ours[0][0], obs, rtol=1e-6, atol=1e-6)
    alive = 0.0
    if reference in (HopperV5, Walker2dV5):
        alive = task().alive_reward
    np.testing.assert_allclose(ours[1][0] - alive * terminated, reward, rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(ours[2][0], terminated)
    assert 30 < (contacts > 0).sum() < 300
    if task is not HalfCheetah:
        assert 30 < terminated.sum() < 270


@EACH_TASK
def test_action_bounds_time_step_and_time_limit_are_gymnasiums(task, reference):
    world, env = make_world(task(), engine="mujoco"), reference()
    np.testing.assert_array_equal(world.env.action_low, env.action_space.low)
    np.testing.assert_array_equal(world.env.action_high, env.action_space.high)
    assert world.params.timestep * task().num_substeps == pytest.approx(env.dt)
    assert task().control_seconds == pytest.approx(env.dt)
    assert world.env.episode_length == 1000
    assert world.env.obs_size == env.observation_space.shape[0]
    env.close()


@EACH_TASK
def test_reset_draws_from_the_same_distribution(task, reference):
    world, env = make_world(task(), engine="mujoco"), reference()
    keys = jax.random.split(jax.random.key(0), 1000)
    ours = np.asarray(jax.jit(jax.vmap(lambda key: world.env.reset(world.params, key).obs))(keys))
    theirs = np.stack([env.reset(seed=i)[0] for i in range(1000)])
    env.close()
    scale = task().reset_noise
    np.testing.assert_allclose(ours.mean(axis=0), theirs.mean(axis=0), atol=0.1 * scale)
    np.testing.assert_allclose(ours.std(axis=0), theirs.std(axis=0), rtol=0.1)
    assert (np.abs(ours).max(axis=0) <= np.abs(theirs).max(axis=0) + 0.8 * scale).all()
    assert np.abs(np.corrcoef(ours.T) - np.eye(ours.shape[1])).max() < 0.2


@EACH_TASK
def test_a_state_that_is_not_finite_ends_the_episode(task, reference):
    del reference
    world = make_world(task(), engine="mujoco")
    physics = world.env.reset(world.params, jax.random.key(0)).physics
    assert not task().terminated(physics)
    for number in (0, 3, -1):
        for bad in (np.nan, np.inf):
            assert task().terminated(physics._replace(qvel=physics.qvel.at[number].set(bad)))
