"""A gain that falls while it is recorded is named as such; one that stays is not."""

import dataclasses

import numpy as np
import pytest

from garat_jax.diagnosis.drift import find_drifts
from garat_jax.diagnosis.fit import fit
from garat_jax.effects import MotorDeadband, MotorGain
from tests.diagnosis.test_fit import make_problem, record

TIME = np.arange(0, 8, 0.004)
GAIN = (MotorGain("actuator/motor"),)


def falling(fall: float, part: float = 1.0, effects=GAIN):
    """Record a motor whose gain falls evenly from 1, by telling the model more than it gets.

    Only a part of each recording, from its start, is fitted.
    """
    gain = 1.0 - fall * TIME / TIME[-1]
    recordings = []
    for seed in range(2):
        made = record(TIME, seed=seed, command=gain)
        recordings.append(made.__class__(**{**vars(made), "ctrl": made.ctrl / gain[:, None]}))
    problem = make_problem(recordings, effects)
    seconds = TIME[problem.segments.first]
    return dataclasses.replace(problem, fitted=seconds < part * TIME[-1]), recordings


def drifts(fall: float, part: float = 1.0):
    problem, recordings = falling(fall, part)
    fitted = fit(problem, problem.simulator.base, problem.segments.start, (0,))
    return fitted, find_drifts(problem, [fitted], recordings)


def test_a_gain_that_falls_is_named_with_its_ends():
    fitted, (drift,) = drifts(0.3)
    assert (drift.effect, drift.target, drift.parameter) == (
        "motor_gain",
        "actuator/motor",
        "scale",
    )
    assert (drift.begin, drift.end) == pytest.approx((1.0, 0.7), abs=0.02)
    assert drift.change.low < -0.3 < drift.change.high
    assert fitted.theta[0] == pytest.approx(0.85, abs=0.03)
    assert str(drift).startswith("scale of motor_gain at actuator/motor falls from 1")


def test_the_ends_are_those_of_the_recording_where_only_its_beginning_is_fitted():
    fitted, (drift,) = drifts(0.3, part=0.6)
    assert fitted.theta[0] == pytest.approx(0.91, abs=0.02)
    assert (drift.begin, drift.end) == pytest.approx((1.0, 0.7), abs=0.03)


def test_a_gain_that_stays_is_not():
    _, found = drifts(0.0)
    assert found == ()


def test_of_two_fits_the_drift_counts_that_leaves_much_less():
    laws = MotorGain("actuator/motor"), MotorDeadband("actuator/motor")
    problem, recordings = falling(0.3, effects=laws)
    base, start = problem.simulator.base, problem.segments.start
    gain, dead = (fit(problem, base, start, (j,)) for j in range(2))
    (of_dead,) = find_drifts(problem, [dead], recordings)
    assert of_dead.effect == "motor_deadband"
    for fits in ((gain, dead), (dead, gain)):
        (drift,) = find_drifts(problem, fits, recordings)
        assert drift.effect == "motor_gain"


def test_of_two_fits_whose_drifts_leave_the_same_the_first_counts():
    problem, recordings = falling(0.3, effects=GAIN * 2)
    base, start = problem.simulator.base, problem.segments.start
    one, other = (fit(problem, base, start, (j,)) for j in range(2))
    first = find_drifts(problem, [one], recordings)
    assert find_drifts(problem, [one, other], recordings) == first
