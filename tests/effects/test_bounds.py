"""A world whose effects have impossible sizes is refused."""

import jax
import jax.numpy as jnp
import mujoco
import pytest

from garat_jax import dynamics
from garat_jax.effects import (
    CATALOGUE,
    ActuatorDelay,
    ContactFriction,
    ViscousDamping,
    parameter_at,
)
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


@pytest.mark.parametrize(
    ("kind", "number", "unit", "high"),
    [
        ("coulomb_friction", 0, "N", 500.0),
        ("viscous_damping", 0, "N s/m", 1e4),
        ("quadratic_drag", 0, "N s²/m²", 1e4),
        ("rotor_inertia", 0, "kg", 1e3),
        ("joint_stiffness", 0, "N/m", 1e6),
        ("stribeck_friction", 2, "m/s", 10.0),
        ("joint_flexibility", 0, "N/m", 1e9),  # the bound means "no effect"
        ("back_emf", 0, "N s/m", 1e4),
    ],
)
def test_bounds_at_a_slide_are_a_hinges_at_a_lever(kind, number, unit, high):
    host = models.spec(models.SLIDER).compile()
    declared = CATALOGUE[kind].parameters()[number]
    target = "actuator/push" if kind == "back_emf" else "joint/along"
    there = parameter_at(declared, host, target)
    assert there.unit == unit
    assert there.high == pytest.approx(high)
    hinge = models.spec(models.PENDULUM).compile()
    turns = "actuator/motor" if kind == "back_emf" else "joint/hinge"
    assert parameter_at(declared, hinge, turns) == declared


def test_a_heavy_axis_may_have_more_damping_than_a_hinge():
    axis = models.spec(models.SLIDER)
    dynamics.compile(axis, effects=(ViscousDamping("joint/along", coefficient=250.0),))
    with pytest.raises(UserError, match="0 to 10000 N s/m"):
        dynamics.compile(axis, effects=(ViscousDamping("joint/along", coefficient=2e4),))


def test_a_payload_may_be_at_the_end_of_a_long_body():
    boom = models.spec(
        models.PENDULUM.replace('fromto="0 0 0 0 0 -0.5"', 'fromto="0 0 0 0 0 -4"')
    ).compile()
    short = models.spec(models.PENDULUM).compile()
    place = next(p for p in CATALOGUE["payload_mass"].parameters() if p.name == "z")
    there = parameter_at(place, boom, "body/pole")
    assert there.low == -there.high < -4.0
    assert parameter_at(place, short, "body/pole") == place
    mass = CATALOGUE["payload_mass"].parameters()[0]
    assert parameter_at(mass, boom, "body/pole") == mass
