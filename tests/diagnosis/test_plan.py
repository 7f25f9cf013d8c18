"""`garat plan`: within the limits, and better at telling effects apart than a plain sine."""

import dataclasses

import mujoco
import numpy as np
import pandas as pd
import pytest

from garat_jax import cli
from garat_jax.diagnosis import load_model
from garat_jax.diagnosis.plan import Place, _Judge, parse_place, plan
from garat_jax.effects import Backlash
from garat_jax.errors import UserError
from tests import models


@pytest.fixture
def pendulum(tmp_path):
    path = tmp_path / "pendulum.xml"
    path.write_text(models.PENDULUM)
    return path


def test_a_plan_separates_dry_from_viscous_friction(pendulum, capsys):
    out = pendulum.parent / "plan.csv"
    arguments = ["viscous_damping", "coulomb_friction@joint/hinge", "--seconds", "4"]
    status = cli.main(["plan", str(pendulum), "--separate", *arguments, "--out", str(out)])
    assert status == 0
    printed = capsys.readouterr().out
    before, after = (float(printed.split(word)[1].split()[0]) for word in ("cosine", "sine, "))
    assert after < before - 0.05
    frame = pd.read_csv(out)
    assert list(frame.columns) == ["time", "ctrl.motor"]
    assert frame.time.iloc[-1] == pytest.approx(3.99)
    assert frame["ctrl.motor"].abs().max() <= 3.0
    assert frame["ctrl.motor"].std() > 0.01


def test_the_same_seed_plans_the_same(pendulum):
    model = load_model(pendulum)
    places = Place("viscous_damping", "joint/hinge"), Place("rotor_inertia", "joint/hinge")
    first, second = (plan(model, *places, seconds=2.0, seed=3) for _ in range(2))
    np.testing.assert_array_equal(first.ctrl, second.ctrl)
    assert first.after <= first.before


@pytest.mark.parametrize("seconds", [np.nan, 0.0, 601.0])
def test_a_length_out_of_range_is_refused_in_python_too(pendulum, seconds):
    with pytest.raises(UserError, match="expected 2 to 600"):
        plan(load_model(pendulum), "viscous_damping", "coulomb_friction", seconds)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--separate", "viscos_damping", "coulomb_friction"], "did you mean viscous_damping"),
        (["--separate", "viscous_damping@joint/hing", "motor_gain"], "did you mean joint/hinge"),
        (["--separate", "viscous_damping", "viscous_damping"], "are the same; name two effects"),
        (["--separate", "actuator_delay", "motor_gain"], "write actuator_delay@TARGET"),
        (["--separate", "viscous_damping", "motor_gain", "--seconds", "0"], "expected 2 to 600"),
        (["--separate", "viscous_damping", "motor_gain", "--seed", "-1"], "-1: expected 0 or more"),
        (["--separate", "viscous_damping"], "--separate"),
    ],
)
def test_refusals(pendulum, capsys, arguments, said):
    out = pendulum.parent / "plan.csv"
    assert cli.main(["plan", str(pendulum), *arguments, "--out", str(out)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert not out.exists()


def test_a_gain_is_told_from_a_payload_at_the_centre_of_mass(pendulum):
    model = load_model(pendulum)
    places = Place("motor_gain", "actuator/motor"), Place("payload_mass", "body/pole")
    planned = plan(model, *places, seconds=4.0)
    assert planned.after < 0.9
    assert planned.after <= planned.before


@pytest.mark.parametrize("kind", ["motor", "position"])
def test_joints_stay_within_their_ranges(tmp_path, kind):
    mjcf = models.PENDULUM.replace('damping="0.01"', 'damping="0.01" range="-20 35"')
    if kind == "position":
        mjcf = mjcf.replace("<motor", '<position kp="20" kv="2"')
    path = tmp_path / "limited.xml"
    path.write_text(mjcf)
    model = load_model(path)
    places = Place("viscous_damping", "joint/hinge"), Place("coulomb_friction", "joint/hinge")
    planned = plan(model, *places, seconds=3.0)
    host = model.spec.copy().compile()
    data = mujoco.MjData(host)
    angles = []
    for ctrl in planned.ctrl:
        data.ctrl[:] = ctrl
        mujoco.mj_step(host, data, 5)
        angles.append(data.qpos[0])
    low, high = np.deg2rad([-20.1, 35.1])
    assert low < min(angles) < -0.05 < 0.05 < max(angles) < high
    assert planned.after < 0.99


def test_a_kind_without_a_place_is_refused(tmp_path):
    path = tmp_path / "nameless.xml"
    path.write_text(models.PENDULUM.replace('body name="pole"', "body"))
    with pytest.raises(UserError, match=r"payload_mass can act nowhere in .*: it needs"):
        plan(load_model(path), "payload_mass", "viscous_damping")


def test_balls_stay_within_their_cones(tmp_path):
    path = tmp_path / "ball.xml"
    joint = 'type="ball" limited="true" range="0 20"'
    path.write_text(
        models.PENDULUM.replace('axis="0 1 0" damping', f"{joint} damping")
        .replace("<motor", '<motor gear="0 1 0"')
        .replace('<sensor><jointpos name="angle" joint="hinge"/></sensor>', "")
    )
    model = load_model(path)
    places = Place("gravity_scale", "world"), Place("motor_gain", "actuator/motor")
    limits = model.spec.copy().compile().actuator_ctrlrange
    judge = _Judge(model, places, np.arange(10) * 0.01, limits)
    turned = np.deg2rad([[0.0], [15.0]]), np.deg2rad([[0.0], [29.0]])
    for angle, beyond in zip(turned, (set(), {"hinge"}), strict=True):
        qpos = np.concatenate([np.cos(angle / 2), 0 * angle, np.sin(angle / 2), 0 * angle], axis=1)
        assert judge._beyond(np.concatenate([qpos, np.zeros((2, 3))], axis=1)) == beyond


def test_an_actuator_without_limits_is_refused(tmp_path, capsys):
    path = tmp_path / "arm.xml"
    path.write_text(models.ARM)
    separate = ["--separate", "viscous_damping@joint/elbow", "rotor_inertia@joint/elbow"]
    assert cli.main(["plan", str(path), *separate, "--out", str(tmp_path / "x.csv")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "no ctrlrange at shoulder, elbow, so nothing says how large" in line


def test_a_model_without_actuators_is_refused(tmp_path, capsys):
    spec = models.spec(models.PENDULUM)
    spec.delete(spec.actuators[0])
    spec.compile()
    path = tmp_path / "free.xml"
    path.write_text(spec.to_xml())
    separate = ["--separate", "viscous_damping", "coulomb_friction"]
    assert cli.main(["plan", str(path), *separate, "--out", str(tmp_path / "x.csv")]) == 2
    assert "has no actuators, so nothing can be commanded" in capsys.readouterr().err


FALLING = """
<mujoco>
  <worldbody>
    <body>
      <joint name="lift" type="slide" axis="0 0 1" limited="true" range="-0.1 0.1" armature="1"/>
      <geom type="sphere" size="0.05" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor name="hoist" joint="lift" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


def test_what_keeps_a_plan_from_being_made_is_said(tmp_path):
    """Nothing holds the lift: its stop, which is soft, is all that it shows."""
    (tmp_path / "lift.xml").write_text(FALLING)
    model = load_model(tmp_path / "lift.xml")
    with pytest.raises(UserError, match=r"ranges: lift leaves its range even under small commands"):
        plan(model, "coulomb_friction", "viscous_damping", seconds=4.0)


def test_slow_actuators_are_followed_from_rest_under_the_commands_that_are_played(tmp_path):
    path = tmp_path / "slow.xml"
    slow = '<general dyntype="filter" dynprm="0.4" gainprm="1"'
    path.write_text(models.PENDULUM.replace("<motor", slow))
    model, time = load_model(path), np.arange(300) / 100
    places = Place("viscous_damping", "joint/hinge"), Place("coulomb_friction", "joint/hinge")
    ctrl = np.where(time < 1.0, 0.0, 2.0)[:, None]
    followed = _Judge(model, places, time, np.asarray([[-3.0, 3.0]]))._path(ctrl)
    assert followed.shape == (300, 2)
    np.testing.assert_allclose(followed[:100], 0.0, atol=1e-9)
    assert followed[110, 0] > 1e-3


def test_places_that_an_effect_of_the_card_excludes_are_refused(tmp_path):
    (tmp_path / "arm.xml").write_text(models.ARM)
    model = load_model(tmp_path / "arm.xml")
    model = dataclasses.replace(model, effects=(Backlash("joint/elbow", gap=0.01),))
    assert parse_place("backlash@joint/elbow", model).kind == "backlash"
    with pytest.raises(UserError, match="which excludes joint_flexibility@joint/elbow; plan"):
        parse_place("joint_flexibility@joint/elbow", model)


def test_a_body_that_an_effect_of_the_card_adds_is_no_place(pendulum):
    card = pendulum.with_suffix(".toml")
    payload = 'kind = "payload_mass"\ntarget = "body/pole"\nparameters = { mass = 0.2 }\n'
    card.write_text(f'format = "garat-model/1"\nmjcf = "{pendulum.name}"\n[[effect]]\n{payload}')
    model = load_model(card)
    assert parse_place("com_offset", model) == Place("com_offset", "body/pole")
    with pytest.raises(UserError, match="unknown target of com_offset"):
        parse_place("com_offset@body/payload of pole", model)


def test_what_one_of_several_parameters_does_is_not_told_apart_by_the_others(pendulum):
    """A pitch of gravity is an encoder's offset to a pendulum, which hardly feels a roll."""
    model = load_model(pendulum)
    same = plan(model, "encoder_offset", "gravity_tilt", seconds=3.0)
    assert min(same.before, same.after) > 0.95
    other = plan(model, "torque_offset", "gravity_tilt", seconds=3.0)
    assert other.after < 0.9


def test_a_law_that_contains_the_other_is_told_apart_by_what_else_it_has(pendulum):
    nested = plan(load_model(pendulum), "coulomb_friction", "asymmetric_friction", seconds=3.0)
    assert nested.after < min(nested.before, 0.9)
