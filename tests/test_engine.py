"""What C MuJoCo is spared in every step, and what it is not to take for a number."""

from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from garat_jax import dynamics, engine
from garat_jax.engine import profiling_clock
from garat_jax.env import guarded_step, make_world
from garat_jax.envs.inverted_pendulum import InvertedPendulum
from garat_jax.errors import UserError
from tests.models import ARM, spec


def test_a_model_of_one_tree_is_not_searched_for_islands_and_no_clock_is_read():
    floating = "<body><freejoint/><geom type='sphere' size='1' mass='1'/></body>"
    two = ARM.replace("</worldbody>", f"{floating}</worldbody>")
    flags = [
        dynamics.compile(spec(mjcf), engine="mujoco").host.model.opt.disableflags
        for mjcf in (ARM, two)
    ]
    islands = int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
    assert [flag & islands for flag in flags] == [islands, 0]
    clock = profiling_clock()
    if clock is None:
        pytest.skip("MuJoCo's library does not show its clock on this platform")
    assert clock.value is None
    world = dynamics.compile(spec(ARM), engine="mujoco")
    rest, still = np.zeros(2, np.float32), np.zeros(2, np.float32)
    state = dynamics.initial_state(world, rest, still + 1)
    try:
        mujoco.set_mjcb_time(None)  # as the documentation says
        assert clock.value is not None
        timed = dynamics.step(world, state, still)
    finally:
        clock.value = None
    np.testing.assert_array_equal(timed.qpos, dynamics.step(world, state, still).qpos)


@pytest.mark.parametrize("name", ["mujoco", "mjx"])
def test_a_model_that_sleeps_is_refused(name):
    sleepy = ARM.replace("<worldbody>", '<option><flag sleep="enable"/></option><worldbody>', 1)
    with pytest.raises(UserError, match=r"^the model lets bodies sleep"):
        dynamics.compile(spec(sleepy), engine=name)


def test_a_spring_that_yields_is_refused_since_it_remembers():
    yielding = ARM.replace('damping="0.02"', 'stiffness="1" springyield="3"')
    world = dynamics.compile(spec(yielding), engine="mujoco")
    state = dynamics.initial_state(world, jnp.zeros(2), jnp.zeros(2))
    with pytest.raises(UserError, match=r"springyield"):
        dynamics.step(world, state, jnp.zeros(2))


@pytest.mark.parametrize("name", ["mujoco", "mjx"])
def test_a_command_that_is_no_number_is_a_faulty_step(name):
    world = make_world(InvertedPendulum(), engine=name)
    state = world.env.reset(world.params, jax.random.key(0))
    step = jax.jit(partial(guarded_step, world.env))
    for action, faulty in ((0.5, False), (np.nan, True)):
        found = step(world.params, state, jnp.full(1, action), jax.random.key(1))
        assert found.faulty == faulty
        assert found.result.reward == (not faulty)


def test_a_clock_of_the_users_own_is_left_alone():
    if (clock := profiling_clock()) is None:
        pytest.skip("MuJoCo's library does not show its clock on this platform")
    mujoco.set_mjcb_time(lambda: 1.0)
    try:
        engine._stop_profiling.__wrapped__()
        assert clock.value is not None
    finally:
        mujoco.set_mjcb_time(None)
        clock.value = None
