"""Activations follow the recorded commands; what a model is not told of them is said."""

import dataclasses
import re

import mujoco
import numpy as np
import pytest

from garat_jax.diagnosis import compare, load_model
from garat_jax.diagnosis.activation import follow_commands, forgets_in, known_spans
from garat_jax.diagnosis.localise import missing_torque
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.oddities import oddities
from garat_jax.diagnosis.segments import cut, grid_for
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.effects import JointFlexibility
from garat_jax.errors import UserError
from tests import models

STEP = 0.004
ACTUATORS = {
    "filter": '<general dyntype="filter" dynprm="0.4" gainprm="1"',
    "exact": '<general dyntype="filterexact" dynprm="0.4" gainprm="1"',
    "integrator": '<intvelocity kp="5" actrange="-3 3"',
}


def mjcf(actuator: str) -> str:
    return models.PENDULUM.replace("<motor", ACTUATORS[actuator])


def record(actuator: str, seed: int, seconds: float = 6.0):
    """Record a machine that is just as a model, in a finer simulation; with its activations."""
    fine = mujoco.MjModel.from_xml_string(mjcf(actuator))
    fine.opt.timestep = STEP / 32
    data = mujoco.MjData(fine)
    data.qpos[0] = 0.4
    rng = np.random.default_rng(seed)
    num = round(seconds / STEP)
    ctrl = rng.uniform(-1.5, 1.5, num // 50 + 1)[np.arange(num) // 50]
    rows = []
    for command in ctrl:
        rows.append((data.qpos[0], data.qvel[0], data.act[0]))
        data.ctrl[0] = command
        mujoco.mj_step(fine, data, 32)
    qpos, qvel, act = np.asarray(rows).T
    noise = rng.normal(size=(2, num)) * [[1e-4], [1e-3]]
    columns = ((qpos + noise[0])[:, None], (qvel + noise[1])[:, None], ctrl[:, None])
    made = Recording("made", np.arange(num) * STEP, *columns, {}, True, ((0, num),), ())
    return made, act


@pytest.mark.parametrize("actuator", ["filter", "exact"])
def test_activations_are_followed_from_what_is_forgotten(actuator):
    model = mujoco.MjModel.from_xml_string(mjcf(actuator))
    made, act = record(actuator, 0)
    begin = np.concatenate([made.qpos[0], made.qvel[0]])
    found = follow_commands(model, begin, made.ctrl, STEP)[:, 0]
    assert found[0] == made.ctrl[0, 0] != act[0]
    assert forgets_in(model) == pytest.approx(1.2)
    ((first, _),) = known_spans(made, forgets_in(model))
    assert first == 300
    assert np.abs(found - act)[first:].max() < 0.06 * np.abs(found - act)[0]


@pytest.mark.parametrize("actuator", ["filter", "exact"])
def test_a_perfect_model_with_a_slow_actuator_is_near_the_noise(tmp_path, actuator):
    path = tmp_path / "slow.xml"
    path.write_text(mjcf(actuator))
    recordings = [record(actuator, seed)[0] for seed in (1, 2)]
    found = compare(load_model(path), recordings)
    assert found.error.before < 1.5 * found.error.noise_floor
    missing = missing_torque(mujoco.MjModel.from_xml_string(mjcf(actuator)), recordings)
    assert np.sqrt(np.mean(missing.torque**2)) < 0.05 * np.sqrt(np.mean(missing.command**2))


def test_an_integrator_begins_without_a_force_and_says_so():
    model = mujoco.MjModel.from_xml_string(mjcf("integrator"))
    made, _ = record("integrator", 3, 1.0)
    begin = np.concatenate([made.qpos[0], 0.0 * made.qvel[0]])
    assert follow_commands(model, begin, made.ctrl, STEP)[0, 0] == pytest.approx(made.qpos[0, 0])
    assert forgets_in(model) == 0.0
    (line,) = oddities(made, model)
    assert "actuator motor integrates its commands, and where it began is not recorded" in line


def errors_of_a_perfect_model(folder, mjcf, ctrl, *effects):
    """Return the largest error of the last joint in each segment that is whole, of 0.5 s."""
    path = folder / "perfect.xml"
    path.write_text(mjcf)
    model = load_model(path)
    host = model.compile("mujoco").host.model
    data, rows = mujoco.MjData(host), []
    data.act[:] = ctrl[0, -1] if host.actuator_dyntype[-1] != mujoco.mjtDyn.mjDYN_INTEGRATOR else 0
    for command in ctrl:
        rows.append((data.qpos.copy(), data.qvel.copy()))
        data.ctrl[:] = command
        mujoco.mj_step(host, data, 2)
    state = [np.asarray(column) for column in zip(*rows, strict=True)]
    num = len(ctrl)
    time = np.arange(num) * 2 * host.opt.timestep
    made = Recording("made", time, *state, ctrl, {}, True, ((0, num),), ())
    grid = grid_for([made], host)
    segments = cut([made], grid, 0.5)
    simulator = Simulator(dataclasses.replace(model, effects=effects), (), grid)
    predicted = simulator.predict(simulator.base[None], segments.start[None], segments)[0]
    error = np.abs(predicted - segments.measured)[..., host.nq - 1].max(axis=1)
    return error[segments.weight.min(axis=1) > 0]


def test_an_integrator_is_given_no_commands_before_its_recording(tmp_path):
    ctrl = 0.8 * np.cos(3 * np.arange(400) * 2 * 0.002)[:, None]
    mjcf_of_velocity = models.PENDULUM.replace("<motor", '<intvelocity kp="20" actrange="-9 9"')
    assert errors_of_a_perfect_model(tmp_path, mjcf_of_velocity, ctrl).max() < 1e-4


def test_a_filter_beside_a_gear_that_bends_follows_its_commands(tmp_path):
    joints = [f'<joint name="{name}" axis="0 1 0" damping=".3" armature=".02"/>' for name in "ab"]
    geom = '<geom type="capsule" size=".02" fromto="0 0 0 0 0 -.5" mass="1" contype="0"/>'
    bodies = "".join(f"<body>{joint}{geom}</body>" for joint in joints)
    motors = (
        '<motor joint="a" name="a"/>'
        '<general joint="b" name="b" dyntype="filterexact" dynprm=".2" gainprm="1"/>'
    )
    apart = (
        '<mujoco><option timestep="0.005" gravity="0 0 0"/>'
        f"<worldbody>{bodies}</worldbody><actuator>{motors}</actuator></mujoco>"
    )
    time = np.arange(600) * 0.01
    ctrl = np.stack([0.3 * np.sin(3 * time), 0.8 * np.sign(np.sin(2.3 * time + 1))], axis=1)
    stiff = JointFlexibility("joint/a", stiffness=5000.0, damping=1.0)
    assert errors_of_a_perfect_model(tmp_path, apart, ctrl, stiff).max() < 1e-3


def test_spans_begin_where_activations_are_known():
    made, _ = record("filter", 0, 2.0)
    split = dataclasses.replace(made, spans=((0, 100), (100, 200), (250, 500)))
    assert known_spans(split, 0.6) == ((150, 200), (250, 500))
    assert known_spans(split, 0.0) == split.spans


@pytest.mark.parametrize("after", [301, 302])
def test_too_few_samples_before_a_gap_tell_no_torque(after):
    model = mujoco.MjModel.from_xml_string(mjcf("filter"))
    made, _ = record("filter", 0, 4.0)
    split = dataclasses.replace(made, spans=((0, after), (after, len(made.time))))
    assert len(missing_torque(model, [split]).torque) > 600


def test_a_muscle_forgets_as_slowly_as_it_lets_go():
    slow = '<muscle timeconst="0.01 0.4" lengthrange="-1 1" name="motor" joint="hinge"/>'
    mjcf_of_motor = re.sub("<motor.*/>", slow, models.PENDULUM)
    assert forgets_in(mujoco.MjModel.from_xml_string(mjcf_of_motor)) == pytest.approx(1.2)


def test_a_recording_that_ends_before_activations_are_known_is_refused():
    model = mujoco.MjModel.from_xml_string(mjcf("filter"))
    long, brief = (record("filter", 0, seconds)[0] for seconds in (3.0, 1.23))
    assert grid_for([long], model).forgets == pytest.approx(1.2)
    with pytest.raises(UserError, match=r"brief: .* not forgotten before 1.2 s.* leave it out"):
        grid_for([long, dataclasses.replace(brief, name="brief")], model)
