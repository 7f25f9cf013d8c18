"""A delay may make nearly all of the error: what it leaves is judged as if it had been known."""

import dataclasses

import numpy as np
import pytest

from garat_jax.diagnosis.diagnose import verdict_of
from garat_jax.diagnosis.findings import Candidate, Interval, Named
from garat_jax.diagnosis.held_out import HeldOut, measure_held_out
from garat_jax.diagnosis.horizon import choose_horizon
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.metric import make_metric, noise_floor
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.segments import choose_grid
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.diagnosis.starts import settle
from garat_jax.effects import ActuatorDelay, ActuatorLag, MotorGain
from tests.diagnosis.pendulum import MODEL, record

LATE = 0.06
"""Seconds that commands come late."""
DELAY = ActuatorDelay("actuator/motor")
GAIN = MotorGain("actuator/motor")


def found(effect, *alike: str) -> Candidate:
    unknown = Interval(0.0, 0.0, 0.0)
    named = tuple(Named(kind, effect.target) for kind in alike)
    return Candidate(effect.kind, effect.target, {}, 0.9, 0.0, 0.0, unknown, 1.0, named, True, "")


def command(time: np.ndarray | float) -> np.ndarray | float:
    return np.sign(np.sin(8 * time)) + 0.5 * np.sin(9 * time)


def record_late(ripple: float, gain: float) -> list[Recording]:
    """Record a motor that is late and weak, and one torque more that changes with the angle."""

    def weaken(spec):
        spec.actuators[0].gear = np.asarray(spec.actuators[0].gear) * gain

    def applied(time, angle, speed):
        return command(max(time - LATE, 0.0))

    def one_more(angle):
        return ripple * np.sin(5 * angle)

    made = [record(weaken, seed, ripple=one_more, control=applied) for seed in range(4)]
    return [dataclasses.replace(r, ctrl=command(r.time)[:, None]) for r in made]


def measure(ripple: float, gain: float, *selected: Candidate) -> HeldOut:
    recordings = record_late(ripple, gain)
    grid = choose_grid(recordings, 0.002)
    simulator = Simulator(MODEL, (DELAY, GAIN), grid)
    _, segments = choose_horizon(simulator, recordings, grid)
    problem = Problem(simulator, segments, segments.recording < 3, 0.004)
    theta = np.asarray([LATE, gain])
    fits = [settle(problem, t, segments.start) for t in (simulator.base, theta)]
    floor = noise_floor(problem, make_metric(problem), fits[1])
    return measure_held_out(problem, (fits[0], fits[1]), floor, recordings, grid, "", selected)


@pytest.mark.parametrize("gain", [1.0, 0.97], ids=["a delay", "a delay and a gain"])
@pytest.mark.parametrize("ripple", [0.0, 0.03])
def test_what_a_delay_leaves_is_judged_as_if_the_delay_had_been_known(ripple, gain):
    selected = (found(DELAY), found(GAIN)) if gain < 1.0 else (found(DELAY),)
    measured = measure(ripple, gain, *selected)
    error, on_time = measured.finer or measured.error, measured.on_time
    assert measured.error.is_explained and on_time
    assert (on_time.after, on_time.noise_floor) == (error.after, error.noise_floor)
    assert on_time.before < 0.2 * error.before
    assert (on_time.before > on_time.after) is (gain < 1.0)
    assert on_time.is_explained is measured.are_explained is (ripple == 0.0)
    verdict = "missing_effect" if ripple == 0.0 else "unexplained"
    assert verdict_of(False, selected, measured) == verdict


def test_nothing_is_measured_beside_a_delay_that_was_not_found():
    measured = measure(0.0, 0.97, found(GAIN))
    assert measured.on_time is None and measured.are_explained


@pytest.mark.parametrize(
    ("candidate", "is_delay"),
    [
        (found(DELAY), True),
        (found(ActuatorLag("all"), "actuator_delay"), True),
        (found(ActuatorLag("all"), "motor_gain"), False),
        (found(GAIN, "actuator_delay"), False),
    ],
    ids=["a delay", "a lag that may be one", "a lag", "a gain that does the same"],
)
def test_what_may_be_a_delay_counts_as_one_if_it_is_a_matter_of_time(candidate, is_delay):
    assert candidate.is_delay is is_delay
