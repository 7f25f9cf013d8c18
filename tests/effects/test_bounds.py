"""A world whose effects have impossible sizes is refused."""

import jax
import jax.numpy as jnp
import mujoco
import pytest

from garat_jax import dynamics
from garat_jax.effects import ActuatorDelay, ContactFriction, ViscousDamping
from garat_jax.errors import UserError
from tests import models


@pytest.mark.parametrize("coefficient", [-1.0, 101.0, float("nan"), jnp.asarray([0.1, -1.0])])
def test_what_is_outside_the_bounds_is_refused(coefficient):
    effect = ViscousDamping("joint/hinge", coefficient=coefficient)
    with pytest.raises(UserError, match=r"viscous_damping coefficient = \S+ is outside its bounds"):
        dynamics.compile(models.spec(models.PENDULUM), effects=(effect,))


def test_a_bound_rounded_to_single_precision_is_let_pass():
    (delay,) = ActuatorDelay.parameters()
    effect = ActuatorDelay("actuator/motor", delay=jnp.float32(delay.high))
    assert float(effect.delay) > delay.high
    dynamics.compile(models.spec(models.PENDULUM), effects=(effect,))


def test_what_the_model_has_already_is_let_pass():
    spec = mujoco.MjSpec.from_string("""
    <mujoco>
      <worldbody>
        <geom name="floor" type="plane" size="1 1 1" friction="90 0.1 0.1"/>
        <body pos="0 0 0.1"><freejoint/><geom type="sphere" size="0.1"/></body>
      </worldbody>
    </mujoco>""")
    (sliding,) = ContactFriction.parameters()
    assert sliding.high < 90
    none = ContactFriction.at(spec.compile(), "geom/floor")
    dynamics.compile(spec, effects=(ContactFriction("geom/floor", **none),))


def test_a_value_that_is_mapped_over_is_not_looked_at():
    def damping(coefficient):
        effect = ViscousDamping("joint/hinge", coefficient=coefficient)
        world = dynamics.compile(models.spec(models.PENDULUM), effects=(effect,))
        return dynamics.view(world)["dof_damping"][0]

    base, more = jax.vmap(damping)(jnp.asarray([0.0, 0.5]))
    assert more - base == pytest.approx(0.5)
