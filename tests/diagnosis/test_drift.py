"""A gain that falls while it is recorded is named as such; one that stays is not."""

import dataclasses
import importlib
from types import SimpleNamespace

import numpy as np
import pytest

from garat_jax.diagnosis.drift import find_drifts
from garat_jax.diagnosis.fit import fit
from garat_jax.effects import MotorDeadband, MotorGain
from tests.diagnosis.test_fit import make_problem, record

diagnose = importlib.import_module("garat_jax.diagnosis.diagnose")  # the package has the function
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
        recordings.append(dataclasses.replace(made, ctrl=made.ctrl / gain[:, None]))
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
        assert drift.instead is (fits[0] is dead)
        assert ("in place of" in str(drift)) is drift.instead


def test_of_two_fits_whose_drifts_leave_much_the_same_the_first_counts():
    laws = *GAIN, MotorDeadband("actuator/motor")
    problem, recordings = falling(0.3, effects=laws)
    base, start = problem.simulator.base, problem.segments.start
    gain, both = (fit(problem, base, start, free) for free in ((0,), (0, 1)))
    drifts = [
        [(drift.effect, drift.begin) for drift in find_drifts(problem, fits, recordings)]
        for fits in ([gain], [both], [gain, both], [both, gain])
    ]
    assert drifts[0] != drifts[1]
    assert drifts[2:] == drifts[:2]


def test_a_fit_that_leaves_less_without_a_drift_counts_before_another_with_one():
    """Of commands that become smaller, a dead band passes on an ever smaller share."""
    shape = np.sin(9 * TIME) * np.sign(np.sin(2 * TIME))
    told = (1.0 - 0.5 * TIME / TIME[-1]) * shape
    passed_on = np.sign(told) * np.maximum(np.abs(told) - 0.2, 0.0)
    share = np.divide(passed_on, shape, out=np.zeros_like(shape), where=shape != 0)
    recordings = [
        dataclasses.replace(record(TIME, seed=seed, command=share), ctrl=told[:, None])
        for seed in range(2)
    ]
    problem = make_problem(recordings, (MotorDeadband("actuator/motor"), *GAIN))
    start = problem.segments.start
    dead = fit(problem, np.asarray([0.1, 1.0]), start, (0,))
    gain = fit(problem, problem.simulator.base, start, (1,))
    assert find_drifts(problem, [gain], recordings)
    assert find_drifts(problem, [dead, gain], recordings) == ()


@pytest.mark.parametrize(
    ("best", "verdict", "tested"),
    [
        ("found", "unexplained", ("found", "as good")),
        ("found", "missing_effect", ("found",)),
        (None, "unexplained", ()),
    ],
)
def test_what_is_as_good_is_tested_only_where_a_gap_is_unexplained(
    monkeypatch, best, verdict, tested
):
    monkeypatch.setattr(diagnose, "fit_equals", lambda *_: ["as good"])
    monkeypatch.setattr(diagnose, "find_drifts", lambda _, fits, recordings: tuple(fits))
    outcome = SimpleNamespace(best=best, steps=(), after=None)
    assert diagnose._drifts(None, outcome, (), verdict, lambda line: None) == tested
