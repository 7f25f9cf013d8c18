"""A model whose sensors are off is judged by what they report, from where the machine really is."""

import dataclasses

import numpy as np
import pytest

from garat_jax.diagnosis import Recording, compare, diagnose
from garat_jax.diagnosis.localise import missing_torque
from garat_jax.diagnosis.sensing import as_they_are
from garat_jax.diagnosis.starts import as_measured, settle
from garat_jax.dynamics import native_model
from garat_jax.effects import CATALOGUE, EncoderOffset, EncoderScale, ViscousDamping
from tests.diagnosis.pendulum import MODEL, add_damping, record
from tests.diagnosis.test_fit import make_problem

DAMPING, OFFSET, SCALE = 0.05, 0.5, 1.6
SENSORS = EncoderOffset("joint/hinge", OFFSET), EncoderScale("joint/hinge", SCALE)
DAMPED = ViscousDamping("joint/hinge", DAMPING)


def reported(recording: Recording) -> Recording:
    """What an encoder says of a motion."""
    qpos, qvel = SCALE * recording.qpos + OFFSET, SCALE * recording.qvel
    return dataclasses.replace(recording, qpos=qpos, qvel=qvel)


@pytest.fixture(scope="module")
def true() -> list[Recording]:
    return [record(lambda spec: add_damping(spec, DAMPING), seed) for seed in (1, 2, 3)]


@pytest.fixture(scope="module")
def recordings(true) -> list[Recording]:
    return [reported(recording) for recording in true]


def test_states_are_found_exactly_from_what_is_reported_of_them_linearly():
    true = np.random.default_rng(0).normal(size=(50, 4))
    scale, offset = np.asarray([1.0, 3.0, -2.0, 0.4]), np.asarray([0.0, 0.0, 5.0, -1.0])

    def report(states):
        return scale * states + offset

    found = as_they_are(report(true), report(report(true)), report, np.ones(4))
    np.testing.assert_allclose(found, true, atol=1e-12)
    unmeasured = as_they_are(report(true), report(report(true))[:, :3], report_three, np.ones(4))
    np.testing.assert_allclose(unmeasured[:, :3], true[:, :3], atol=1e-12)
    np.testing.assert_array_equal(unmeasured[:, 3], report(true)[:, 3])


def test_states_that_a_report_says_nothing_of_move_by_what_is_known():
    measured = np.asarray([[1.0, 2.0], [3.0, 4.0]])
    found = as_they_are(measured, measured + 0.5, lambda s: np.full_like(s, np.nan), np.ones(2))
    np.testing.assert_allclose(found, measured - 0.5)
    nothing = as_they_are(measured, np.full_like(measured, np.nan), lambda s: s, np.ones(2))
    assert nothing is measured


def report_three(states):
    """Positions and velocities, the last of which nobody measured."""
    return np.asarray([1.0, 3.0, -2.0]) * states[:, :3] + np.asarray([0.0, 0.0, 5.0])


def test_where_sensors_say_what_is_states_begin_as_measured(recordings):
    problem = make_problem(
        recordings, (ViscousDamping("joint/hinge"), SENSORS[0].replace(offset=0.0))
    )
    start, _ = as_measured(problem, problem.simulator.base)
    assert start is problem.segments.start
    begun, _ = as_measured(problem, np.asarray([DAMPING, OFFSET]))
    np.testing.assert_allclose(begun, start - [OFFSET, 0.0], atol=1e-12)


def test_initial_states_settle_from_where_the_sensors_report_them(true, recordings):
    made = {SENSORS: recordings, (): true}
    there, known = (
        settle(make_problem(data, (), model=MODEL.with_effects([*sensors, DAMPED])), np.zeros(0))
        for sensors, data in made.items()
    )
    np.testing.assert_allclose(there.start, known.start, atol=1e-3)
    assert there.cost.sum() == pytest.approx(known.cost.sum(), rel=1e-2)


def test_a_model_with_its_sensors_is_scored_and_judged_as_the_machine(true, recordings):
    model, machine = MODEL.with_effects([*SENSORS, DAMPED]), MODEL.with_effects([DAMPED])
    assert compare(model, recordings).near_noise
    shifted = [dataclasses.replace(r, qpos=r.qpos + OFFSET) for r in true]
    as_it_is = compare(machine, true).error
    displaced = compare(MODEL.with_effects([SENSORS[0], DAMPED]), shifted).error
    assert displaced.horizon == as_it_is.horizon
    assert displaced.before == pytest.approx(as_it_is.before, rel=1e-3)
    few = {kind: CATALOGUE[kind] for kind in ("coulomb_friction", "viscous_damping", "motor_gain")}
    few |= {effect.kind: type(effect) for effect in SENSORS}
    found = diagnose(dataclasses.replace(model, catalogue=few), recordings[:2], recordings[2:])
    assert (found.verdict, found.selected) == ("adequate", ())


def test_no_torque_is_missing_where_only_the_encoder_is_off(true, recordings):
    machine = MODEL.with_effects([DAMPED]).compile("mujoco")
    model = MODEL.with_effects([*SENSORS, DAMPED]).compile("mujoco")
    host = native_model(machine)
    found, known = missing_torque(host, recordings, model), missing_torque(host, true, machine)
    np.testing.assert_allclose(found.torque, known.torque, atol=1e-3)
    np.testing.assert_allclose(found.position, known.position, atol=1e-6)
