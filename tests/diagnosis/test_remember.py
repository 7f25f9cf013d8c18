"""What an effect remembers of the commands before a segment, from where the recording begins."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from garat_jax import dynamics
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.model_card import Model
from garat_jax.diagnosis.past import LEAD_IN
from garat_jax.diagnosis.segments import choose_grid, cut
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.effects import Effect, JointFlexibility, QuadraticDrag
from garat_jax.effects.catalogue import load_catalogue
from tests import models

MINE = Path(__file__).parents[2] / "examples" / "my_effects.py"
FADE = load_catalogue([MINE])["thermal_fade"]
GEARED = models.PENDULUM.replace('damping="0.01"', 'armature="0.01"')
INTERVAL, NUM = 0.004, 2000


def recording(
    seed: int, time: np.ndarray, xml: str = models.PENDULUM, effects: tuple[Effect, ...] = ()
) -> Recording:
    """Return the true motion of a pendulum whose driver warms up, without noise."""
    fades = (*effects, FADE("all", fade=0.5))
    model = Model("model", MINE, MINE, models.spec(xml), effects=fades)
    with jax.enable_x64(True):
        world = model.compile("mujoco")
        held = np.random.default_rng(seed).uniform(-3, 3, NUM)
        ctrl = held[(np.arange(NUM) // 100)][:, None]
        begin = dynamics.initial_state(world, jnp.zeros(1), jnp.zeros(1))

        def step(state, command):
            return dynamics.step(world, state, command, 2), (state.qpos, state.qvel)

        _, (qpos, qvel) = jax.jit(lambda ctrl: jax.lax.scan(step, begin, ctrl))(ctrl)
    at = np.round(time / INTERVAL).astype(int)
    qpos, qvel = (np.asarray(x)[at] for x in (qpos, qvel))
    return Recording("made", time, qpos, qvel, ctrl[at], {}, True, ((0, len(time)),), ())


@pytest.mark.parametrize("drag", [0.0, 1e-12])
def test_a_segment_begins_as_warm_as_its_recording_had_become(drag):
    even = np.arange(NUM) * INTERVAL
    recordings = [recording(1, even), recording(2, even[:1500])]
    model = Model("model", MINE, MINE, models.spec(models.PENDULUM))
    grid = choose_grid(recordings, 0.002)
    # A drag that is not felt looks at the state, which takes a call a substep.
    simulator = Simulator(model, (FADE("all", fade=0.0), QuadraticDrag("joint/hinge")), grid)
    segments = cut(recordings, grid, 0.5)
    errors = {}
    for fade in (0.0, 0.5):
        theta = np.asarray([fade, drag])
        predicted = simulator.predict(theta[None], segments.start[None], segments)[0]
        counted = segments.weight[..., None] * (predicted - segments.measured)
        # Before a recording its first command is taken to have held for 0.1 s, which warms a bit.
        errors[fade] = np.abs(counted).max(axis=(1, 2))[segments.first > 0]
    assert errors[0.5].max() < 1e-7
    assert errors[0.0].min() > 10 * errors[0.5].max()


def test_what_is_led_along_the_motion_does_not_warm_twice():
    bends = JointFlexibility("joint/hinge", stiffness=2.0, damping=0.1)
    made = recording(5, np.arange(NUM) * INTERVAL, GEARED, (bends,))
    model = Model("model", MINE, MINE, models.spec(GEARED), effects=(bends,))
    grid = choose_grid([made], 0.002)
    simulator = Simulator(model, (FADE("all", fade=0.0),), grid)
    segments = cut([made], grid, 0.2)
    theta = np.asarray([[0.0], [0.45], [0.5], [0.55]])
    starts = np.broadcast_to(segments.start, (len(theta), *segments.start.shape))
    predicted = simulator.predict(theta, starts, segments)
    led = segments.num_past * INTERVAL > LEAD_IN
    cold, less, right, more = np.square(predicted - segments.measured)[:, led].mean(axis=(1, 2, 3))
    assert right < 0.01 * cold
    assert right < min(less, more)


def test_past_commands_are_those_on_the_simulated_steps():
    time = np.delete(np.arange(400) * INTERVAL, slice(150, 250))  # a gap
    made = dataclasses.replace(recording(3, time), spans=((0, 150), (150, 300)))
    other = recording(4, np.arange(200) * INTERVAL)
    grid = choose_grid([made, other], 0.002)
    segments = cut([made, other], grid, 0.2)
    late = np.flatnonzero((segments.recording == 0) & (segments.first == 150))[0]
    assert segments.num_past[late] == 250
    assert segments.num_past[0] == 0
    np.testing.assert_array_equal(segments.past[0, :150], made.ctrl[:150])
    np.testing.assert_array_equal(segments.past[0, 150:250], np.tile(made.ctrl[149], (100, 1)))
    np.testing.assert_array_equal(segments.past[0, 250:399], made.ctrl[150:299])
    np.testing.assert_array_equal(segments.past[1, :199], other.ctrl[:199])


def test_an_effect_that_remembers_may_not_read_the_state():
    with pytest.raises(TypeError, match="remembers commands, so it may not read the state"):

        @struct.dataclass
        class Both(Effect):
            kind = "both"
            remembers = True
            reads_state = True
