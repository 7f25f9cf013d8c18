"""Effects act in one order, however they are listed: a card lists them as they were found."""

from pathlib import Path
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from garat_jax import dynamics
from garat_jax.diagnosis.model_card import Model
from garat_jax.diagnosis.segments import choose_grid, cut
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.effects import (
    CATALOGUE,
    ActuatorDelay,
    Backlash,
    CoulombFriction,
    Effect,
    EncoderOffset,
    EncoderScale,
    JointFlexibility,
    LoadFriction,
    MotorDeadband,
    TorqueSaturation,
    ViscousDamping,
    in_order,
    parameter,
)
from tests import models
from tests.diagnosis.test_fit import UNIFORM, record
from tests.effects.truth import RIG, commands, predict


@struct.dataclass
class Fade(Effect):
    """A law of one's own."""

    kind: ClassVar[str] = "fade"
    elements: ClassVar[tuple[str, ...]] = ("actuator",)
    law: ClassVar[str] = "u ← (1 − f)·u"
    identified_by: ClassVar[str] = "anything"
    acts: ClassVar[bool] = True

    fade: jax.Array = parameter(0.0, unit="1", low=0.0, high=1.0, scale=0.1, source="A test")


HERE = Path(__file__)
DELAY = ActuatorDelay("all", delay=0.03)
LOOKING = {
    "flexible": JointFlexibility("joint/hinge", stiffness=5.0, damping=0.05),
    "play": Backlash("joint/hinge", gap=0.05),
    "load": LoadFriction("joint/hinge", ratio=0.2),
}


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True):
        yield


@pytest.mark.parametrize("name", LOOKING)
def test_what_looks_at_a_torque_sees_the_command_that_reaches_the_motor(name):
    ctrl, effect = commands(), LOOKING[name]
    late = np.concatenate([np.repeat(ctrl[:1], 7, axis=0), ctrl])[: len(ctrl)]  # 28 of 4 ms
    delay = DELAY.replace(delay=0.028)
    listed = predict(RIG, (effect, delay), ctrl)
    np.testing.assert_array_equal(listed, predict(RIG, (delay, effect), ctrl))
    np.testing.assert_allclose(listed, predict(RIG, (effect,), late), atol=1e-9)


def test_the_order_is_the_catalogues_with_ones_own_after_commands():
    own, damping = Fade("actuator/motor"), ViscousDamping("joint/hinge", coefficient=0.1)
    listed = (damping, *LOOKING.values(), own, TorqueSaturation("actuator/motor"), DELAY)
    kinds = [effect.kind for effect in in_order((*listed, MotorDeadband("actuator/motor")))]
    assert kinds[:4] == ["motor_deadband", "actuator_delay", "torque_saturation", own.kind]
    assert sorted(kinds[4:], key=[*CATALOGUE].index) == kinds[4:]
    twice = (damping.replace(target="joint/b"), CoulombFriction("joint/b"), damping)
    assert [effect.target for effect in in_order(twice)] == ["joint/b", "joint/hinge", "joint/b"]


def test_a_scale_acts_before_an_offset():
    effects = (EncoderOffset("joint/hinge", offset=0.1), EncoderScale("joint/hinge", scale=1.5))
    world = dynamics.compile(models.spec(models.PENDULUM), (), effects, "mujoco")
    state = dynamics.initial_state(world, jnp.full(1, 0.4), jnp.zeros(1))
    assert float(dynamics.sensed(world, state).qpos[0]) == pytest.approx(1.5 * 0.4 + 0.1)


def test_a_candidate_acts_before_an_effect_of_the_card_that_looks_at_torques():
    card = Model("pendulum", HERE, HERE, models.spec(RIG), effects=(LOOKING["play"],))
    recording = record(UNIFORM)
    grid = choose_grid([recording], 0.002)
    segments = cut([recording], grid, 0.4)
    simulator = Simulator(card, (DELAY.replace(delay=0.0),), grid)
    both = Simulator(
        Model("pendulum", HERE, HERE, card.spec, effects=(DELAY, *card.effects)), (), grid
    )
    found = simulator.predict(np.array([[0.03]]), segments.start[None], segments)
    wanted = both.predict(np.zeros((1, 0)), segments.start[None], segments)
    np.testing.assert_allclose(found, wanted, atol=1e-9)
