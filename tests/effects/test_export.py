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


def test_what_mjcf_cannot_say_is_said():
    line = EncoderOffset("joint/elbow", offset=0.1).export(spec(ARM))
    assert "encoder_offset at joint/elbow" in line
    assert "\n" not in line
