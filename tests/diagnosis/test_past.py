"""The motion before a segment, along which memories of it are led to its start."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from garat_jax import dynamics
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.model_card import Model
from garat_jax.diagnosis.past import LEAD_IN, Past, has_memory_of_motion, way_to
from garat_jax.diagnosis.segments import Grid, choose_grid, cut
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.effects import ActuatorDelay, JointFlexibility, ViscousDamping
from tests import models

GEARED = models.PENDULUM.replace('damping="0.01"', 'armature="0.01"')
BENDS = JointFlexibility("joint/hinge", stiffness=2.0, damping=0.1)
INTERVAL, NUM = 0.004, 1000


def model(*effects) -> Model:
    return Model(
        "model", Path(models.__file__), Path(models.__file__), models.spec(GEARED), effects=effects
    )


def recording() -> Recording:
    """Return a motion of the pendulum behind a gear that bends and damps little."""
    with jax.enable_x64(True):
        world = model(BENDS).compile("mujoco")
        held = np.random.default_rng(0).uniform(-1, 1, NUM)
        ctrl = held[(np.arange(NUM) // 50)][:, None]
        begin = dynamics.initial_state(world, jnp.zeros(1), jnp.zeros(1))

        def step(state, command):
            return dynamics.step(world, state, command, 2), (state.qpos, state.qvel)

        _, path = jax.jit(lambda ctrl: jax.lax.scan(step, begin, ctrl))(ctrl)
    qpos, qvel = (np.asarray(x) for x in path)
    return Recording("made", np.arange(NUM) * INTERVAL, qpos, qvel, ctrl, {}, True, ((0, NUM),), ())


def test_the_motor_behind_a_gear_that_swings_is_where_the_motion_left_it(monkeypatch):
    made = recording()
    grid = choose_grid([made], 0.002)
    segments = cut([made], grid, 0.2)
    simulator = Simulator(model(BENDS), (), grid)
    nothing = np.zeros((1, 0))
    predicted = simulator.predict(nothing, segments.start[None], segments)[0]
    error = np.abs(predicted - segments.measured).max(axis=1)[:, 0]
    monkeypatch.setattr("garat_jax.diagnosis.past.LEAD_IN", 0.1)
    held = Simulator(model(BENDS), (), grid).predict(nothing, segments.start[None], segments)[0]
    shorter = np.abs(held - segments.measured).max(axis=1)[:, 0]
    spread = made.qpos.std()
    assert error[segments.num_past * INTERVAL > LEAD_IN].max() < 0.02 * spread
    assert np.median(shorter) > 2 * np.median(error)


def test_the_way_ends_at_the_start_and_follows_what_was_measured():
    host = models.spec(GEARED).compile()
    grid = Grid(0.01, 2, 1, True)
    qvel = np.arange(300.0)[None, :, None]
    past = Past(np.zeros((1, 300, 1)), qvel, np.zeros((1, 300, 0)), np.asarray(0), np.asarray(150))
    start = jnp.asarray([0.3, 7.0])
    ctrl, qpos, qvel = way_to(start, past, host, grid, 2)
    assert (ctrl.shape, qpos.shape, qvel.shape) == ((100, 1), (100, 2, 1), (100, 2, 1))
    np.testing.assert_allclose(qpos[-1, -1], 0.3)
    np.testing.assert_allclose(qvel[:-1, 0, 0], np.arange(50.0, 149.0))
    np.testing.assert_allclose(qvel[-1, :, 0], [149.0, 7.0])
    path, speed = qpos.reshape(-1), qvel.reshape(-1)
    np.testing.assert_allclose(np.diff(path), 0.005 * speed[1:], rtol=1e-3)


def test_before_the_recording_the_mechanism_stays():
    host = models.spec(GEARED).compile()
    past = Past(
        np.zeros((1, 300, 1)),
        np.ones((1, 300, 1)),
        np.zeros((1, 300, 0)),
        np.asarray(0),
        np.asarray(40),
    )
    _, qpos, qvel = way_to(jnp.asarray([0.3, 1.0]), past, host, Grid(0.01, 1, 1, True), 1)
    np.testing.assert_array_equal(qvel[:60, 0, 0], 0.0)
    np.testing.assert_array_equal(qvel[60:, 0, 0], 1.0)
    np.testing.assert_allclose(qpos[:61, 0, 0], 0.3 - 39 * 0.01, rtol=1e-5)
    np.testing.assert_allclose(qpos[-1, 0, 0], 0.3)


@pytest.mark.parametrize(
    ("effect", "has"),
    [
        (BENDS, True),
        (ActuatorDelay("all", delay=0.01), False),
        (ViscousDamping("joint/hinge", coefficient=0.1), False),
    ],
)
def test_memories_of_the_motion_are_told_from_those_of_commands(effect, has):
    assert has_memory_of_motion([effect], models.spec(GEARED).compile()) is has
