"""A mechanism that is held while commands get under way."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from garat_jax import dynamics
from garat_jax.effects import ActuatorDelay
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
