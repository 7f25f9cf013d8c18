"""A mechanism that is held while commands get under way."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from garat_jax import dynamics
from garat_jax.effects import ActuatorDelay, JointFlexibility
from tests.models import MUSCLE, PENDULUM, spec


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True):
        yield


def compiled(mjcf: str, *effects) -> dynamics.Dynamics:
    return dynamics.compile(spec(mjcf), (), effects, "mujoco")


def test_while_a_mechanism_is_held_late_commands_get_under_way():
    late = compiled(PENDULUM, ActuatorDelay("all", delay=0.012))
    start = dynamics.initial_state(late, jnp.asarray([0.4]), jnp.asarray([-1.0]))
    held = dynamics.hold(late, start, jnp.asarray([2.0]), 6)  # of 2 ms each
    np.testing.assert_array_equal(held.qpos, start.qpos)
    np.testing.assert_array_equal(held.qvel, start.qvel)
    moved = dynamics.step(late, held, jnp.asarray([0.0]), 6)
    plain = compiled(PENDULUM)
    reference = dynamics.initial_state(plain, start.qpos, start.qvel)
    reference = dynamics.step(plain, reference, jnp.asarray([2.0]), 6)
    np.testing.assert_allclose(moved.qpos, reference.qpos, rtol=1e-12)


def test_while_a_mechanism_is_held_its_muscles_are_activated():
    world = compiled(MUSCLE)
    start = dynamics.initial_state(world, jnp.asarray([0.1, 0.2]), jnp.zeros(2))
    held = dynamics.hold(world, start, jnp.ones(world.host.model.nu), 10)
    np.testing.assert_array_equal(held.qpos, start.qpos)
    assert np.all(held.act > 0.1)
    for before, after in ((start.time, held.time), (start.qvel, held.qvel)):
        np.testing.assert_array_equal(before, after)


def test_while_a_mechanism_is_held_its_gears_bend_however_fast_it_goes():
    geared = PENDULUM.replace('damping="0.01"', 'armature="0.01"')
    bent = compiled(geared, JointFlexibility("joint/hinge", stiffness=20.0, damping=0.5))

    def wound(speed: float):
        state = dynamics.initial_state(bent, jnp.asarray([0.4]), jnp.asarray([speed]))
        return dynamics.hold(bent, state, jnp.asarray([2.0]), 200).memory[0]

    motors = [wound(speed) for speed in (0.0, 1e-4, 1.0)]
    for motor in motors:  # the torque of 2 N m, and nothing goes on
        np.testing.assert_allclose(motor.deflection, 2.0 / 20.0, rtol=0.05)
        np.testing.assert_allclose(motor.slip, motors[0].slip, atol=1e-9)
