"""What is exported to MJCF moves in plain MuJoCo as the effect does here."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from garat_jax import dynamics
from garat_jax.effects import (
    ComOffset,
    ContactCompliance,
    ContactFriction,
    EncoderOffset,
    EncoderScale,
    GravityScale,
    GravityTilt,
    JointStiffness,
    PayloadMass,
)
from tests.models import ARM, SLIDER, spec

PAYLOAD = PayloadMass("body/forearm", mass=0.5, x=0.2, z=-0.05)
OFFSET = ComOffset("body/upper", x=0.03, z=0.05)
FRICTION = ContactFriction("geom/ball", sliding=0.2)
GEOMS = ARM.replace("<option", '<compiler inertiafromgeom="true"/><option')
TURNED = '<inertial pos="0 0 0" euler="90 0 0" mass="1" diaginertia="0.02 0.02 0.02"/>'
CORD = """<tendon><fixed name="cord" stiffness="3"><joint joint="elbow" coef="1"/>
  <joint joint="shoulder" coef="-0.5"/></fixed></tendon><actuator>"""
CASES = {
    "payload": (ARM, (PAYLOAD,)),
    "offset": (ARM, (OFFSET,)),
    "offset and payload, inertia from geoms": (GEOMS, (OFFSET, PAYLOAD)),
    "offset, inertia from geoms beside one that is turned": (
        GEOMS.replace('<joint name="sh', TURNED + '<joint name="sh'), (OFFSET,),
    ),
    "spring beside a tendon's": (
        ARM.replace("<actuator>", CORD), (JointStiffness("joint/elbow", 1.5, 0.6),),
    ),
    "gravity": (ARM, (GravityScale("world", scale=0.4), GravityTilt("world", 0.3, -0.2))),
    "friction": (SLIDER, (FRICTION,)),
    "contact": (
        SLIDER,
        (FRICTION, ContactCompliance("geom/floor", time_constant=0.06, damping_ratio=0.3)),
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_the_exported_model_is_the_effect(case):
    mjcf, effects = CASES[case]
    exported = spec(mjcf)
    assert [effect.export(exported) for effect in effects] == [""] * len(effects)
    exported.compile()
    model = mujoco.MjModel.from_xml_string(exported.to_xml())
    with jax.enable_x64(True):
        world = dynamics.compile(spec(mjcf), effects=effects, engine="mujoco")
        host = world.host.model
        state = dynamics.initial_state(
            world, jnp.asarray(host.qpos0) + 0.29, jnp.linspace(-0.5, 0.5, host.nv)
        )
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = state.qpos, state.qvel, 0.3
        mujoco.mj_step(model, data, 100)
        state = dynamics.step(world, state, jnp.full(host.nu, 0.3), 100)
    np.testing.assert_allclose(state.qpos, data.qpos, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(state.qvel, data.qvel, rtol=1e-4, atol=1e-5)


SERVOS = """<actuator>
  <intvelocity name="shoulder" joint="shoulder" kp="60" kv="2" inheritrange="1"/>
  <general name="elbow" joint="elbow" gear="2" gaintype="affine" gainprm="1 0.4 0"
           biastype="affine" biasprm="0 -3 -0.1"/></actuator>
<keyframe><key name="home" qpos="0.3 -0.4"/><key name="rest"/></keyframe>"""


@pytest.mark.parametrize("angle", ["degree", "radian"])
def test_an_encoder_counts_from_elsewhere_and_the_machine_moves_as_before(angle):
    """It runs into its limit and its spring on the way, and both its servos pull."""
    mjcf = GEOMS.partition("<actuator>")[0] + SERVOS + "</mujoco>"
    mjcf = mjcf.replace('name="elbow"', 'name="elbow" springref="20" stiffness="2"', 1)
    mjcf = mjcf.replace('range="-170 170"', 'range="-50 50" ref="10"')
    source = spec(mjcf)
    if angle == "radian":
        source = spec(source.to_xml())
    assert source.compiler.degree == (angle == "degree")
    model, offset = source.compile(), np.asarray([0.2, -0.3])
    exported = source.copy()
    for name, by in zip(("shoulder", "elbow"), offset, strict=True):
        assert EncoderOffset(f"joint/{name}", offset=by).export(exported) == ""
    exported.compile()
    counted = mujoco.MjModel.from_xml_string(exported.to_xml())
    paths = []
    for machine in (model, counted):
        data = mujoco.MjData(machine)
        mujoco.mj_resetDataKeyframe(machine, data, 0)
        data.ctrl[:] = 4.0, 0.5
        path = []
        for _ in range(200):
            mujoco.mj_step(machine, data)
            path.append(data.qpos.copy())
        paths.append(np.asarray(path))
    true, read = paths
    assert true[:, 0].max() > np.deg2rad(50)
    np.testing.assert_allclose(read, true + offset, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(counted.actuator_actrange, model.actuator_actrange, atol=1e-6)
    np.testing.assert_allclose(counted.key_qpos, model.key_qpos + offset, atol=1e-6)


def test_what_mjcf_cannot_say_is_said():
    corded = spec(ARM.replace("<actuator>", CORD))
    for effect in (EncoderScale("joint/elbow", 1.1), EncoderOffset("joint/elbow", 0.1)):
        line = effect.export(corded)
        assert f"MJCF has no words for {effect.kind} at joint/elbow" in line
        assert "\n" not in line
    assert line.endswith("a tendon measures it")
    assert corded.joint("elbow").ref == 0.0
    muscle = '<muscle joint="elbow" lengthrange="0.1 1"/>'
    strong = spec(ARM.replace('<motor name="elbow" joint="elbow" gear="2"/>', muscle))
    assert EncoderOffset("joint/elbow", 0.1).export(strong).endswith("nor affine measures it")
