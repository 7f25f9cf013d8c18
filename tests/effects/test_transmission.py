"""A motor apart from its joint, against a MuJoCo model that has it as a second body."""

import jax
import mujoco
import numpy as np
import pytest

from garat_jax import dynamics
from garat_jax.effects import BackEmf, Backlash, JointFlexibility, MotorGain
from garat_jax.errors import UserError
from tests.effects.truth import RIG, SERVO, Truth, commands, predict, record, recover
from tests.models import PENDULUM, spec

TWO_BODIES = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002"/>
  <worldbody><body name="rotor" pos="0 0 1">
    <joint name="rotor" axis="0 1 0" armature="0.01"/>
    <inertial pos="0 0 0" mass="1e-6" diaginertia="1e-9 1e-9 1e-9"/>
    <body name="pole">
      <joint name="gear" axis="0 1 0" {gear}/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.6"
            contype="0" conaffinity="0"/>
    </body></body></worldbody>
  <actuator>{actuator}</actuator>
</mujoco>
"""
MOTOR = '<motor joint="rotor" gear="2" ctrlrange="-3 3"/>'
POSITION = '<position joint="rotor" kp="20" kv="1" ctrlrange="-3 3"/>'
UNDAMPED = {
    "motor": RIG.replace(' damping="0.01"', ""),
    "servo": SERVO.replace(' damping="0.01"', ""),
}

HOST = spec(UNDAMPED["servo"]).compile()


GEAR = 'stiffness="{}" damping="{}"'


def play(gap: float) -> str:
    """Return the attributes of a joint that turns freely within a gap [rad] only."""
    return f'limited="true" range="{-gap / 2} {gap / 2}" solreflimit="0.0005 1"'


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True):
        yield


def compare(effect, gear: str, drive: str, mjcf: str | None = None) -> tuple[float, float]:
    """Return the angle's error [rad] with the effect, and without it."""
    actuator = {"motor": MOTOR, "servo": POSITION}[drive]
    ctrl = commands(0.5)
    true = record(TWO_BODIES.format(gear=gear, actuator=actuator), Truth(), ctrl)
    mjcf = mjcf or UNDAMPED[drive]
    return tuple(
        float(np.sqrt(np.mean((predict(mjcf, effects, ctrl) - true)[:, 0] ** 2)))
        for effects in ((effect,), ())
    )


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
@pytest.mark.parametrize(("drive", "stiffness"), [("motor", 2.0), ("servo", 10.0), ("servo", 50.0)])
def test_a_flexible_joint_is_two_bodies_with_a_spring(drive, stiffness, integrator):
    effect = JointFlexibility("joint/hinge", stiffness=stiffness, damping=0.02)
    mjcf = UNDAMPED[drive].replace("/>", f' integrator="{integrator}"/>', 1)
    gear = f'stiffness="{stiffness}" damping="0.02"'
    error, without = compare(effect, gear, drive, mjcf)
    assert error < 3.5e-3
    assert without > 6 * error


@pytest.mark.parametrize(("drive", "gap"), [("motor", 0.1), ("servo", 0.02), ("servo", 0.1)])
def test_backlash_is_two_bodies_with_play(drive, gap):
    error, without = compare(Backlash("joint/hinge", gap=gap), play(gap), drive)
    assert error < 3.5e-3
    assert without > 4 * error


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
@pytest.mark.parametrize("limit", ["forcerange", "actuatorfrcrange"])
@pytest.mark.parametrize(
    ("effect", "gear"),
    [
        (JointFlexibility("joint/hinge", stiffness=50.0, damping=0.02), GEAR.format(50.0, 0.02)),
        (Backlash("joint/hinge", gap=0.02), play(0.02)),
    ],
)
def test_a_servo_at_the_limit_of_its_force_pulls_back_no_more(effect, gear, limit, integrator):
    """It once took its damping along, which made the motor as heavy as with it: 0.1 rad off."""
    servo = 'kp="20" kv="5" ctrlrange="-3 3"'
    at_joint = 'actuatorfrcrange="-0.8 0.8"' * (limit == "actuatorfrcrange")
    servo += ' forcerange="-0.8 0.8"' * (limit == "forcerange")
    mjcf = UNDAMPED["servo"].replace('kp="20" kv="1" ctrlrange="-3 3"', servo)
    mjcf = mjcf.replace('name="hinge"', f'name="hinge" {at_joint}')
    mjcf = mjcf.replace("/>", f' integrator="{integrator}"/>', 1)
    two = TWO_BODIES.format(gear=gear, actuator=f'<position joint="rotor" {servo}/>')
    two = two.replace('name="rotor" axis', f'name="rotor" {at_joint} axis')
    ctrl = commands(1.0)
    error = (predict(mjcf, (effect,), ctrl) - record(two, Truth(), ctrl))[:, 0]
    assert np.sqrt(np.mean(error**2)) < 5e-3


APART = {
    "bends": JointFlexibility("joint/hinge", stiffness=50.0, damping=0.02),
    "has play": Backlash("joint/hinge", gap=0.02),
}
ALTERED = {
    "back-EMF": (BackEmf("actuator/motor", coefficient=2.0), 'kp="20" kv="3"'),
    "gain": (MotorGain("actuator/motor", scale=2.5), 'kp="50" kv="2.5"'),
}


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
@pytest.mark.parametrize("what", APART)
@pytest.mark.parametrize("altered", ALTERED)
def test_a_motor_apart_is_the_one_that_other_effects_leave(altered, what, integrator):
    effect, servo = ALTERED[altered]
    mjcf = UNDAMPED["servo"].replace("/>", f' integrator="{integrator}"/>', 1)
    found = predict(mjcf, (APART[what], effect), commands(0.5))
    mjcf = mjcf.replace('kp="20" kv="1"', servo)
    np.testing.assert_allclose(found, predict(mjcf, (APART[what],), commands(0.5)), atol=1e-9)


@pytest.mark.parametrize(
    ("what", "gear", "error"),
    [("bends", GEAR.format(50.0, 0.02), 5e-3), ("has play", play(0.02), 0.05)],
)
def test_a_light_motor_with_back_emf_moves_as_at_a_fine_timestep(what, gear, error):
    """The contact of so light a motor yields by 32 mrad under 1 N m."""
    ctrl = commands(1.0)
    light = 'armature="0.0005"'
    two = TWO_BODIES.replace('armature="0.01"', light)
    braked = '<general joint="rotor" gear="2" biastype="affine" biasprm="0 0 -0.25"/>'
    true = record(two.format(gear=gear, actuator=braked), Truth(), ctrl)
    mjcf = UNDAMPED["motor"].replace('armature="0.01"', light)
    found = predict(mjcf, (BackEmf("actuator/motor", coefficient=1.0), APART[what]), ctrl)
    assert np.sqrt(np.mean((found - true)[:, 0] ** 2)) < error


@pytest.mark.parametrize("start", [start["gap"] for start in Backlash.starts(HOST, "joint/hinge")])
def test_play_is_recovered_from_every_size_at_which_it_is_tried(start):
    """10 %: at 2 ms the contact yields by some 2 mrad on each side, which the fit takes off."""
    truth = TWO_BODIES.format(gear=play(0.1), actuator=POSITION)
    ctrl = commands(0.5)
    runs = [(ctrl, record(truth, Truth(), ctrl))]
    effect = Backlash("joint/hinge", gap=start)
    found = recover(UNDAMPED["servo"], effect, {"gap": start}, runs)
    assert found["gap"] == pytest.approx(0.1, rel=0.1)


@pytest.mark.parametrize(("drive", "tried"), [("motor", 0), ("servo", 1)])
def test_a_gear_that_bends_is_recovered_from_the_next_size_that_is_tried(drive, tried):
    start = JointFlexibility.starts(HOST, "joint/hinge")[tried]["stiffness"]
    gear, actuator = 'stiffness="10" damping="0.05"', {"motor": MOTOR, "servo": POSITION}[drive]
    ctrl = commands(0.5)
    runs = [(ctrl, record(TWO_BODIES.format(gear=gear, actuator=actuator), Truth(), ctrl))]
    sizes = {"stiffness": start, "damping": 0.01}
    found = recover(UNDAMPED[drive], JointFlexibility("joint/hinge", **sizes), sizes, runs)
    assert found["stiffness"] == pytest.approx(10.0, rel=0.03)
    assert found["damping"] == pytest.approx(0.05, rel=0.15)


EXPORTED = {
    "bends": JointFlexibility("joint/hinge", stiffness=10.0, damping=0.05),
    "has play": Backlash("joint/hinge", gap=0.06),
}


@pytest.mark.parametrize("what", EXPORTED)
@pytest.mark.parametrize("drive", ["motor", "servo"])
def test_an_exported_gear_moves_as_the_effect_does(drive, what):
    """5 mrad: each takes a servo on a light motor in its own way, and errs by 3 mrad at 2 ms."""
    mjcf = {"motor": RIG, "servo": SERVO}[drive].replace("<worldbody>", CROWDED)
    effect, ctrl = EXPORTED[what], commands(0.5)
    exported = spec(mjcf)
    said = effect.export(exported)
    assert f"{effect.kind} at joint/hinge" in said
    assert "hinge_motor" in said
    assert "timestep" not in said
    exported.compile()
    model = mujoco.MjModel.from_xml_string(exported.to_xml())
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    path = []
    for command in ctrl:
        data.ctrl[:] = command
        mujoco.mj_step(model, data, 2)
        path.append(data.joint("hinge").qpos[0])
    angles = [predict(mjcf, effects, ctrl)[:, 0] for effects in ((effect,), ())]
    error, without = (float(np.sqrt(np.mean((angle - path) ** 2))) for angle in angles)
    assert error < 5e-3
    assert without > 4 * error


CROWDED = """
<default><joint damping="0.01" stiffness="0" armature="0.01"/><tendon stiffness="9"/></default>
<keyframe><key qpos="0.4"/></keyframe>
<worldbody>
"""


def test_an_export_needs_a_fine_timestep_where_the_gear_is_stiff():
    exported = spec(SERVO)
    said = JointFlexibility("joint/hinge", stiffness=1e5).export(exported)
    longest = float(said.partition("needs a timestep below ")[2].split()[0])
    assert 1e-5 < longest < 1e-3
    model = exported.compile()
    for factor, is_stable in ((1.0, True), (2.2, False)):
        model.opt.timestep = factor * longest
        data = mujoco.MjData(model)
        data.qpos[0] = 0.01
        farthest = 0.0
        for _ in range(300):
            mujoco.mj_step(model, data)
            farthest = max(farthest, np.abs(data.qpos).max())
        assert (farthest < 0.05) == is_stable


@pytest.mark.parametrize("effect", EXPORTED.values(), ids=EXPORTED)
def test_an_exported_servo_keeps_the_range_that_it_inherits(effect):
    ranged = SERVO.replace('name="hinge"', 'name="hinge" range="-90 45"')
    exported = spec(ranged.replace('ctrlrange="-3 3"', 'inheritrange="0.8"'))
    expected = exported.copy().compile().actuator("motor").ctrlrange
    effect.export(exported)
    exported.compile()
    model = mujoco.MjModel.from_xml_string(exported.to_xml())
    assert model.actuator("motor").ctrllimited[0]
    np.testing.assert_allclose(model.actuator("motor").ctrlrange, expected, rtol=1e-5)
    np.testing.assert_allclose(expected, np.radians([-76.5, 31.5]))


def test_a_rigid_motor_is_not_exported():
    for rigid in (JointFlexibility("joint/hinge"), Backlash("joint/hinge")):
        exported = spec(RIG)
        before = exported.to_xml()
        assert rigid.export(exported) == ""
        assert exported.to_xml() == before


@pytest.mark.parametrize("stiffness", [1e3, 1e5, 1e8])
@pytest.mark.parametrize("drive", UNDAMPED)
def test_a_stiff_gear_is_a_rigid_one_at_any_timestep(drive, stiffness):
    mjcf = UNDAMPED[drive].replace("0.002", "0.005")
    effect = JointFlexibility("joint/hinge", stiffness=stiffness)
    rigid, stiff = (predict(mjcf, effects, commands(0.5)) for effects in ((), (effect,)))
    np.testing.assert_allclose(stiff[:, 0], rigid[:, 0], atol=0.02)


@pytest.mark.parametrize("armature", [1e-5, 1e-3, 1.0])
@pytest.mark.parametrize("drive", UNDAMPED)
def test_motors_of_any_size_stay_finite(drive, armature):
    mjcf = UNDAMPED[drive].replace('armature="0.01"', f'armature="{armature}"')
    for effect in (
        Backlash("joint/hinge", gap=0.02),
        JointFlexibility("joint/hinge", stiffness=20.0),
    ):
        path = predict(mjcf, (effect,), commands(0.5))
        assert np.abs(path[:, 1]).max() < 50.0


def test_the_motor_goes_where_its_joint_is_put():
    effect = JointFlexibility("joint/hinge", stiffness=20.0)
    world = dynamics.compile(spec(UNDAMPED["motor"]), effects=(effect,), engine="mujoco")
    state = dynamics.initial_state(world, np.array([0.0]), np.array([8.0]))
    state = dynamics.step(world, state, np.zeros(1), 5)
    state = state._replace(qpos=np.array([0.5]), qvel=np.array([0.0]))
    after = dynamics.step(world, state, np.zeros(1), 1)
    assert np.abs(after.qvel - 0.0).max() < 0.2


IMPOSSIBLE = {
    "no rotor": PENDULUM,
    "RK4": RIG.replace("/>", ' integrator="RK4"/>', 1),
    "armature of an actuator": RIG.replace('gear="2"', 'gear="2" armature="0.1"'),
    "damping of an actuator": RIG.replace('gear="2"', 'gear="2" damping="0.1"'),
    "no dampers": RIG.replace("/>", '><flag damper="disable"/></option>', 1),
}


@pytest.mark.parametrize("mjcf", IMPOSSIBLE.values(), ids=IMPOSSIBLE)
def test_a_joint_without_a_motor_that_can_turn_is_refused(mjcf):
    with pytest.raises(UserError, match=r"armature above 0.*other than RK4"):
        dynamics.compile(spec(mjcf), effects=(Backlash("joint/hinge", gap=0.1),))
    assert Backlash.targets(spec(mjcf).compile()) == []


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
def test_a_gear_that_bends_needs_damping_that_is_implicit(integrator):
    option = f' integrator="{integrator}"><flag eulerdamp="disable"/></option>'
    model = spec(RIG.replace("/>", option, 1))
    is_euler = integrator == "Euler"
    host = model.compile()
    assert JointFlexibility.targets(host) == ([] if is_euler else ["joint/hinge"])
    assert Backlash.targets(host) == ["joint/hinge"]
    if is_euler:
        with pytest.raises(UserError, match="disables damper, nor under Euler eulerdamp"):
            JointFlexibility("joint/hinge").check(host)
