"""What a joint's actuators give there, where the model has more of them than act."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from garat_jax import dynamics
from garat_jax.effects import Backlash, JointFlexibility, LoadFriction, MotorDeadband
from garat_jax.effects.at_joint import drivers
from garat_jax.errors import UserError
from tests.models import spec

SERVO = '<position name="servo" joint="hinge" kp="5" kv="1" group="1"/>'
TWO = """
<mujoco>
  <option timestep="0.001" actuatorgroupdisable="1" integrator="implicitfast"/>
  <worldbody><body name="link">
    <joint name="hinge" axis="0 1 0" armature="0.01" damping="0.05"/>
    <geom size="0.1" mass="4"/></body></worldbody>
  <actuator><motor name="motor" joint="hinge"/>%s</actuator>
</mujoco>
"""
EFFECTS = {
    "load friction": LoadFriction("joint/hinge", ratio=0.3),
    "flexibility": JointFlexibility("joint/hinge", stiffness=1e4, damping=2.0),
    "play": Backlash("joint/hinge", gap=1e-3),
}


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True):
        yield


@pytest.mark.parametrize("name", EFFECTS)
def test_an_actuator_of_a_group_that_is_off_gives_nothing(name):
    def after(mjcf: str, ctrl: list[float]) -> np.ndarray:
        world = dynamics.compile(spec(mjcf), effects=(EFFECTS[name],), engine="mujoco")
        state = dynamics.initial_state(world, jnp.zeros(1), jnp.zeros(1))
        return np.asarray(dynamics.step(world, state, jnp.asarray(ctrl), 300).qpos)

    np.testing.assert_allclose(after(TWO % SERVO, [0.3, 1.0]), after(TWO % "", [0.3]), rtol=1e-9)


def test_a_flag_switches_all_actuators_off():
    model = spec(TWO % SERVO).compile()
    assert drivers(model, 0) == [0]
    model.actuator_group[1] = -1
    assert drivers(model, 0) == [0, 1]
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    assert drivers(model, 0) == []


@pytest.mark.parametrize(
    "effect", [MotorDeadband("actuator/motor", width=0.1), LoadFriction("joint/hinge", ratio=0.3)]
)
def test_a_law_does_not_take_a_command_for_that_of_another_actuator(effect):
    before = TWO.replace("<actuator>", '<actuator><pid name="angle" joint="hinge" kp="3"/>') % ""
    assert dynamics.compile(spec(before), engine="mujoco").host.model.nu == 3
    with pytest.raises(UserError, match=r"^actuator/angle does not take one command"):
        dynamics.compile(spec(before), effects=(effect,))
