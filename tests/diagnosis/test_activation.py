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
from garat_jax.diagnosis.segments import grid_for
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


def test_spans_begin_where_activations_are_known():
    made, _ = record("filter", 0, 2.0)
    split = dataclasses.replace(made, spans=((0, 100), (100, 200), (250, 500)))
    assert known_spans(split, 0.6) == ((150, 200), (250, 500))
    assert known_spans(split, 0.0) == split.spans


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
