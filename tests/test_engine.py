"""What C MuJoCo is spared in every step."""

import mujoco
import numpy as np
import pytest

from garat_jax import dynamics, engine
from garat_jax.engine import profiling_clock
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
