"""Ant: its numbers are its model's, and its reward is what it says."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from garat_jax import dynamics
from garat_jax.env import make_world
from garat_jax.envs import ant
from garat_jax.envs.ant import Ant
from garat_jax.envs.pairs import PAIRS
from garat_jax.envs.rotation import roll_pitch_yaw, uprightness
from garat_jax.overrides import load_spec


@pytest.fixture(scope="module")
def world():
    return make_world(Ant(), engine="mujoco")


def state_at(world, **changed):
    """Return a state at rest in the bent pose, with some positions or velocities changed."""
    host = world.params.host.model
    qpos = np.concatenate([[0, 0, ant.HEIGHT, 1, 0, 0, 0], ant.BENT])
    state = dynamics.initial_state(world.params, jnp.asarray(qpos), jnp.zeros(host.nv))
    for name, entries in changed.items():
        value = getattr(state, name)
        for index, number in entries.items():
            value = value.at[index].set(number)
        state = state._replace(**{name: value})
    return state


def test_numbers_are_the_models(world):
    host = world.params.host.model
    np.testing.assert_allclose(ant.RANGES, host.jnt_range[1:], atol=1e-12)
    assert world.params.timestep * Ant.num_substeps == pytest.approx(Ant.control_seconds)
    assert (world.env.obs_size, world.env.action_size) == (28, 8)
    joints = [host.joint(i).name for i in range(1, host.njnt)]
    assert joints == [host.actuator(i).name for i in range(host.nu)]
    feet = [host.sensor(i).name for i in range(host.nsensor)]
    assert feet == [name.replace("ankle", "foot") for name in joints[1::2]]


@pytest.mark.parametrize("angles", [(0.3, -0.5, 2.0), (-1.2, 0.9, -3.0), (0.0, 0.0, 0.0)])
def test_angles_of_an_orientation(angles):
    quaternion = np.zeros(4)
    mujoco.mju_euler2Quat(quaternion, np.asarray(angles), "XYZ")  # about the fixed axes
    np.testing.assert_allclose(roll_pitch_yaw(jnp.asarray(quaternion)), angles, atol=1e-6)
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    np.testing.assert_allclose(uprightness(jnp.asarray(quaternion)), matrix[8], atol=1e-6)


def test_the_observation_turns_with_the_robot(world):
    half = np.pi / 4
    turned = {3: np.cos(half), 6: np.sin(half)}  # a quarter turn to the left
    state = state_at(world, qpos={2: 0.7, **turned}, qvel={0: 1.0, 1: 2.0, 2: 3.0, 7: 4.0})
    obs = Ant().observe(state)
    expected = [0.1, -1.0, 0.0, 0.6, -0.3, 0.9, 0.0, 0.0]
    np.testing.assert_allclose(obs[:8], expected, atol=1e-6)
    np.testing.assert_allclose(
        obs[8:11], [0.0, 0.0, (1 - np.radians(65)) / np.radians(35)], atol=1e-6
    )
    assert obs[11] == pytest.approx(0.4)
    np.testing.assert_array_equal(obs[24:], 0.0)


def test_the_reward_is_progress_and_life_less_effort(world):
    before = state_at(world)
    action = jnp.full(8, 0.5)
    after = state_at(world, qpos={0: 0.033, 7: np.radians(40)}, qvel={6: -8.0})
    power, limit = 2.0 * 0.5 * 0.8 / 8, 0.1
    assert Ant().reward(before, action, after) == pytest.approx(1 + 2 - power - 0.025 - limit)
    fallen = state_at(world, qpos={2: 0.25})
    assert Ant().reward(before, jnp.zeros(8), fallen) == pytest.approx(-1.0)
    assert Ant().terminated(fallen)
    assert not Ant().terminated(after)
    assert Ant().terminated(state_at(world, qvel={9: np.nan}))


def test_it_stands_on_four_feet_when_it_does_nothing(world):
    def step(state, _):
        result = world.env.step(world.params, state, jnp.zeros(8), jax.random.key(0))
        return result.state, result.terminated

    def run(key):
        return jax.lax.scan(step, world.env.reset(world.params, key), length=200)

    state, terminated = jax.jit(jax.vmap(run))(jax.random.split(jax.random.key(0), 8))
    assert not terminated.any()
    assert (np.asarray(state.obs[:, 24:]).sum(axis=1) >= 3).all()


def test_gravity_is_the_papers():
    spec = load_spec(Ant().mjcf)
    for overrides, gravity in ((PAIRS["ant"].source, -4.91), (PAIRS["ant"].target, -9.81)):
        model = dynamics.compile(spec, overrides, engine="mujoco").host.model
        np.testing.assert_array_equal(model.opt.gravity, [0, 0, gravity])
