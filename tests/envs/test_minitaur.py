"""Minitaur: the robot stands, its legs stay closed, its motors are the published ones."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from garat_jax import dynamics
from garat_jax.dynamics import Override
from garat_jax.effects import Backlash, JointFlexibility
from garat_jax.env import make_world
from garat_jax.envs import minitaur, minitaur_motors
from garat_jax.envs.minitaur import Minitaur
from garat_jax.envs.pairs import PAIRS
from garat_jax.errors import UserError

LEGS = ("front_left", "back_left", "front_right", "back_right")
SUPPLY, RESISTANCE, TORQUE_CONSTANT, TORQUE_LIMIT, KD = 16.0, 0.186, 0.0954, 5.7, 0.02


@pytest.fixture(scope="module")
def world():
    return make_world(Minitaur(), engine="mujoco")


def opening(world, qpos) -> float:
    """Return how far apart [m] the two halves of the worst leg are."""
    model = world.params.host.model
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    ends = [[data.site(f"{leg}_{link}").xpos for link in ("ahead", "behind")] for leg in LEGS]
    return max(np.linalg.norm(ahead - behind) for ahead, behind in ends)


def rollout(world, policy, num_steps: int, num_envs: int):
    """Step from resets: positions [num_steps, num_envs, nq] and whether the robot was up so far."""

    def run(key):
        def step(carry, key):
            state, up = carry
            result = world.env.step(world.params, state, policy(key), key)
            up = up & ~result.terminated
            return (result.state, up), (result.state.physics.qpos, up)

        start = world.env.reset(world.params, key), jnp.ones((), bool)
        return jax.lax.scan(step, start, jax.random.split(key, num_steps))[1]

    over_keys = jax.vmap(run, out_axes=1)
    return jax.tree.map(
        np.asarray, jax.jit(over_keys)(jax.random.split(jax.random.key(0), num_envs))
    )


def test_legs_start_closed(world):
    for seed in range(10):
        qpos = world.env.reset(world.params, jax.random.key(seed)).physics.qpos
        assert opening(world, np.asarray(qpos)) < 1e-6


def test_knees_close_a_leg_for_every_extension(world):
    qpos = np.array(world.params.host.model.qpos0)
    for extension in np.linspace(0.2, 3.0, 9):
        qpos[7 + minitaur.MOTORS] = extension
        qpos[8 + minitaur.MOTORS] = minitaur.knee_angle(jnp.asarray(extension))
        assert opening(world, qpos) < 1e-6


def test_it_stands_under_a_held_command(world):
    qpos, up = rollout(world, lambda key: jnp.zeros(8), 300, 4)
    assert up.all()
    np.testing.assert_allclose(qpos[-1, :, 2], 0.2, atol=0.02)
    assert np.abs(qpos[-1, :, :2]).max() < 0.05
    assert max(opening(world, row) for row in qpos[-1]) < 1e-4


def test_legs_stay_closed_under_random_commands(world):
    def uniform(key):
        return jax.random.uniform(key, (8,), minval=-1, maxval=1)

    qpos, up = rollout(world, uniform, 300, 8)
    assert up.mean() > 0.5
    assert max(opening(world, row) for row in qpos[up]) < 2e-3  # of legs that reach 0.3 m
    assert np.ptp(qpos[up], axis=0)[7 + minitaur.MOTORS].min() > 0.5


@pytest.mark.parametrize("rate", [-30.0, 0.0, 12.0])
@pytest.mark.parametrize("command", [-1.0, 0.2, 1.0])
@pytest.mark.parametrize("angle", [1.3, 1.9, 2.4])
def test_motors_are_the_published_dc_motors(world, angle, rate, command):
    model = world.params.host.model
    data = mujoco.MjData(model)
    data.qpos[7 + minitaur.MOTORS], data.qvel[6 + minitaur.MOTORS] = angle, rate
    data.ctrl[:] = command
    mujoco.mj_forward(model, data)
    desired = np.pi * 5 / 8 + np.pi / 4 * command
    duty = desired - angle - KD * rate
    current = (SUPPLY * duty - TORQUE_CONSTANT * rate) / RESISTANCE
    torque = np.clip(TORQUE_CONSTANT * current, -TORQUE_LIMIT, TORQUE_LIMIT)
    np.testing.assert_allclose(data.actuator_force, torque, rtol=1e-5)


def test_masses_are_the_published_ones(world):
    model = world.params.host.model
    mass = {model.body(i).name: model.body_mass[i] for i in range(1, model.nbody)}
    assert mass.pop("base") == pytest.approx(3.0)
    assert (mass.pop("left"), mass.pop("right")) == pytest.approx((0.1, 0.1))
    for name, value in mass.items():
        assert value == pytest.approx(0.05 if name.endswith("lower") else 0.25 + 0.05)
    assert len(mass) == 16


def test_numbers_are_the_models(world):
    model = world.params.host.model
    motors = [model.actuator(i).name for i in range(model.nu)]
    assert [model.joint(1 + i).name for i in minitaur.MOTORS] == motors
    assert motors == [f"{leg}_{link}" for leg in LEGS for link in ("ahead", "behind")]
    assert world.params.timestep * Minitaur.num_substeps == pytest.approx(Minitaur.control_seconds)
    assert (world.env.obs_size, world.env.action_size) == (28, 8)
    np.testing.assert_allclose(model.qpos0[7 + minitaur.MOTORS], minitaur.SPLAY)


def test_reward_is_distance_less_energy_and_a_fall_ends_the_episode(world):
    model = world.params.host.model
    start = dynamics.initial_state(world.params, jnp.asarray(model.qpos0), jnp.zeros(model.nv))
    after = start._replace(
        qpos=start.qpos.at[0].set(0.02),
        qvel=start.qvel.at[6].set(10.0).at[8].set(-4.0),
        sensordata=jnp.asarray([3.0, 1.0, 0, 0, 0, 0, 0, 0]),
    )
    assert Minitaur().reward(start, jnp.zeros(8), after) == pytest.approx(0.02 - 1e-3 * 26 * 0.01)
    assert not Minitaur().terminated(after)
    for index, value in ((2, 0.12), (4, 0.6), (9, np.nan)):
        assert Minitaur().terminated(after._replace(qpos=after.qpos.at[index].set(value)))


def test_the_duty_cycle_saturates_beyond_the_torque_limit(world):
    """The model has no bound of the duty cycle, ±1; the torque's bound has to come first."""
    stall = TORQUE_CONSTANT * SUPPLY / RESISTANCE
    assert stall > TORQUE_LIMIT
    slow = (stall - TORQUE_LIMIT) / (TORQUE_CONSTANT**2 / RESISTANCE)
    assert slow > 50  # rad/s, up to which both bounds give the same torque


@pytest.mark.parametrize(("command", "rate"), [(0.1, 0.0), (-0.4, 3.0), (0.9, -8.0), (-1.0, 0.0)])
def test_the_targets_motors_follow_the_measured_curve(command, rate):
    """One substep from rest in the air: the target moves as the source does under that torque."""
    angle = 5 / 8 * np.pi
    duty = np.pi / 4 * command - KD * rate
    linear = TORQUE_CONSTANT * (SUPPLY * duty - TORQUE_CONSTANT * rate) / RESISTANCE
    linear = np.clip(linear, -TORQUE_LIMIT, TORQUE_LIMIT)
    currents, torques = [0, 10, 20, 30, 40, 50, 60], [0, 1, 1.9, 2.45, 3.0, 3.25, 3.5]
    torque = np.sign(linear) * np.interp(abs(linear) / TORQUE_CONSTANT, currents, torques)
    _, target = PAIRS["minitaur"].worlds("mujoco")
    model = target.params.host.model
    data = mujoco.MjData(model)
    data.qpos[2] = 2.0
    data.qpos[7 + minitaur.MOTORS], data.qvel[6 + minitaur.MOTORS] = angle, rate
    data.qpos[8 + minitaur.MOTORS] = minitaur.knee_angle(jnp.asarray(angle))
    state = dynamics.initial_state(target.params, jnp.asarray(data.qpos), jnp.asarray(data.qvel))
    after = dynamics.step(target.params, state, jnp.full(8, command))
    data.ctrl[:] = command
    data.qfrc_applied[6 + minitaur.MOTORS] = torque - linear
    mujoco.mj_step(model, data)
    np.testing.assert_allclose(after.qvel, data.qvel, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(after.sensordata, linear, rtol=1e-4)
    assert abs(torque - linear) > 1e-3


def test_the_measured_curve_is_below_the_line_beyond_its_first_point():
    current = minitaur_motors.CURRENTS[2:]
    line = minitaur_motors.TORQUE_CONSTANT * current
    assert (np.asarray(minitaur_motors.torque_of(jnp.asarray(current))) < line).all()


def test_effects_that_exclude_each_other_are_no_world():
    joint = f"joint/{make_world(Minitaur(), engine='mujoco').params.host.model.joint(0).name}"
    with pytest.raises(UserError, match="exclude each other; write one of them"):
        make_world(Minitaur(), effects=(Backlash(joint), JointFlexibility(joint)), engine="mujoco")


def test_a_model_whose_control_steps_last_otherwise_is_refused():
    slower = Override("option", "", "timestep", 0.004)
    with pytest.raises(UserError, match=r"Minitaur counts on control steps of 0\.01 s, and 5 sub"):
        make_world(Minitaur(), (slower,), engine="mujoco")
    world = make_world(
        dataclasses.replace(Minitaur(), num_substeps=10),
        (Override("option", "", "timestep", 0.001),),
        engine="mujoco",
    )
    assert world.env.obs_size == 28
