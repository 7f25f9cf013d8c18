"""What MJX cannot step, or would leave out without a word, is refused in one line."""

import jax
import jax.numpy as jnp
import pytest

from garat_jax import dynamics
from garat_jax.errors import UserError
from tests.models import PENDULUM, spec

TENDON = "<tendon><fixed name='cord' {}><joint joint='hinge' coef='1'/></fixed></tendon><actuator>"
IGNORED = {
    "damping": ('damping="0.01"', 'damping="0.01 0.5"', "polynomial damping (joint/hinge)"),
    "stiffness": ('damping="0.01"', 'stiffness="1 3"', "polynomial stiffness (joint/hinge)"),
    "cord's damping": (
        "<actuator>", TENDON.format("damping='0 0.5'"), "polynomial damping (tendon/cord)",
    ),
    "cord's stiffness": (
        "<actuator>", TENDON.format("stiffness='0 5'"), "polynomial stiffness (tendon/cord)",
    ),
    "delay": (
        'joint="hinge" c', 'joint="hinge" delay="0.02" nsample="20" c',
        "a native delay (actuator/motor)",
    ),
    "motor's damping": (
        'joint="hinge" c', 'joint="hinge" damping="0.3" c', "damping (actuator/motor)",
    ),
    "motor's armature": (
        'joint="hinge" c', 'joint="hinge" armature="0.3" c', "armature (actuator/motor)",
    ),
    "yielding spring": (
        'damping="0.01"', 'stiffness="1" springyield="3"', "springyield (joint/hinge)",
    ),
    "yielding cord": (
        "<actuator>", TENDON.format("stiffness='1' springyield='0.1'"), "springyield (tendon/cord)",
    ),
    "early activation": (
        '<motor name="motor"', '<general actearly="true" dyntype="filter" name="motor"',
        "actearly (actuator/motor)",
    ),
    "group": (
        'integrator="Euler"', 'actuatorgroupdisable="0"', "a group is off (actuator/motor)",
    ),
    "belt": ('type="capsule"', 'type="capsule" surfacevel="1 0 0 0 0 0"', "surfacevel (geom/rod)"),
    "adhesion": ('type="capsule"', 'type="capsule" adhesion="3"', "adhesion (geom/rod)"),
    "sensor's delay": (
        "<jointpos", '<jointpos delay="0.01" nsample="10"', "a native delay or interval (sensor/an",
    ),
}  # fmt: skip
OPTIONS = {
    "springs": ('integrator="Euler"><flag spring="disable"/></option>', "one alone is disabled"),
    "dampers": ('integrator="Euler"><flag damper="disable"/></option>', "one alone is disabled"),
    "no slip": ('noslip_iterations="3"/>', "noslip_iterations"),
}
DCMOTOR = PENDULUM.replace(
    '<motor name="motor" joint="hinge" ctrlrange="-3 3" ctrllimited="true"/>',
    '<dcmotor name="motor" joint="hinge" motorconst="0.1" resistance="1"/>',
)


def refusal(mjcf: str, engine: str = "mjx") -> str:
    with pytest.raises(UserError) as error:
        dynamics.compile(spec(mjcf), engine=engine)
    said = str(error.value)
    assert said.startswith("engine mjx cannot step this model: ")
    assert "\n" not in said
    return said


@pytest.mark.parametrize("case", IGNORED)
def test_what_mjx_would_ignore_is_refused_by_name(case):
    old, new, said = IGNORED[case]
    assert old in PENDULUM
    dynamics.compile(spec(PENDULUM), engine="mjx")
    message = refusal(PENDULUM.replace(old, new))
    assert said in message
    hint = "effect actuator_delay" if "delay" in case else "use engine mujoco"
    assert ("take it out" if "yielding" in case else hint) in message


@pytest.mark.parametrize("case", OPTIONS)
def test_options_that_mjx_would_ignore_are_refused(case):
    new, said = OPTIONS[case]
    message = refusal(PENDULUM.replace('integrator="Euler"/>', new))
    assert said in message
    assert "use engine mujoco" in message


def test_a_shape_that_a_fluid_feels_is_refused_in_a_fluid_alone():
    shaped = PENDULUM.replace('type="capsule"', 'type="capsule" fluidshape="ellipsoid"')
    assert dynamics.compile(spec(shaped), engine="mjx").engine == "mjx"
    assert "fluidshape (geom/rod)" in refusal(shaped.replace("<option", '<option density="9"', 1))


def test_on_an_accelerator_auto_refuses_alike(monkeypatch):
    bent = PENDULUM.replace('damping="0.01"', 'damping="0.01 0.5"')
    assert dynamics.compile(spec(bent)).engine == "mujoco"
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert "polynomial damping (joint/hinge)" in refusal(bent, "auto")


def test_a_dc_motor_is_refused():
    assert "DCMOTOR" in refusal(DCMOTOR)


def test_an_integrator_that_mjx_lacks_is_refused():
    implicit = "<mujoco><option integrator='implicit'/><worldbody/></mujoco>"
    assert refusal(implicit).endswith("; use mujoco")


def test_c_mujoco_refuses_native_delays_and_names_the_effects():
    old, new, _ = IGNORED["delay"]
    world = dynamics.compile(spec(PENDULUM.replace(old, new)), engine="mujoco")
    state = dynamics.initial_state(world, jnp.zeros(1), jnp.zeros(1))
    with pytest.raises(UserError, match="give the effect actuator_delay"):
        dynamics.step(world, state, jnp.zeros(1))
