"""Estimates where the timestep's error cannot be extrapolated."""

import dataclasses

import numpy as np
import pytest

from garat_jax.diagnosis import timestep
from garat_jax.diagnosis.differences import clear_differences
from garat_jax.diagnosis.fit import converge, fit
from garat_jax.diagnosis.metric import trusted
from garat_jax.diagnosis.starts import follow, settle
from garat_jax.diagnosis.timestep import count_timestep
from garat_jax.effects import CoggingTorque, ViscousDamping
from tests.diagnosis import pendulum
from tests.diagnosis.test_fit import UNIFORM, make_problem, record
from tests.diagnosis.test_starts import FRICTION, puck

__all__ = ["puck"]


class Finer:
    """A simulator of half the timestep in which friction rubs more."""

    def __init__(self, simulator, more: float):
        self._simulator, self._more = simulator, more
        self.effects, self.slots, self.base = simulator.effects, simulator.slots, simulator.base
        self.host = simulator.host

    def predict(self, theta, start, segments):
        return self._simulator.predict(theta + self._more, start, segments)


def converged(problem, theta):
    """Fit, to less than noise: what `count_timestep` moves from."""
    free = tuple(range(len(theta)))
    found = fit(problem, theta, problem.segments.start, free)
    return converge(problem, found, clear_differences(problem, found.theta, found.start, free))[0]


def test_across_contacts_an_interval_reaches_as_far_as_fits_at_both_timesteps(puck):
    puck = dataclasses.replace(puck, finer=Finer(puck.simulator, 0.01))
    settled = settle(puck, np.array([0.4]), puck.segments.start)
    puck = trusted(puck, settled)
    found = fit(puck, np.array([0.4]), settled.start, (0,))
    counted = count_timestep(puck, found)
    assert counted.theta[0] == pytest.approx(FRICTION, abs=0.005)
    assert FRICTION - 0.03 < counted.low[0] < FRICTION - 0.01
    assert FRICTION - 0.005 < counted.high[0] < FRICTION + 0.005


@pytest.mark.parametrize(("kept", "stays"), [(0.2, True), (1.8, True), (0.7, False), (1.3, False)])
def test_a_shift_that_does_less_or_more_than_promised_is_not_made(monkeypatch, kept, stays):
    monkeypatch.setattr(timestep, "_kept_promise", lambda *_: kept)
    recordings = [record(UNIFORM, damping=0.02, noise=1e-5, finer=32)]
    problem = make_problem(recordings, [ViscousDamping("joint/hinge")])
    found = converged(problem, problem.simulator.base)
    counted = count_timestep(problem, found)
    assert bool(counted.theta[0] == found.theta[0]) is stays
    assert counted.low[0] < 0.02 < counted.high[0]
    if not stays:
        shift = abs(counted.theta[0] - found.theta[0])
        assert counted.high[0] - counted.low[0] > 2 * abs(1 - kept) * shift


@pytest.mark.parametrize(
    ("name", "value"), [("EXPLAINED", 0.0), ("start_step", lambda *_: 1e3), ("UNFELT", np.inf)]
)
def test_a_shift_that_explains_no_more_is_not_made(monkeypatch, name, value):
    recordings = [record(UNIFORM, damping=0.02, noise=1e-5, finer=32)]
    problem = make_problem(recordings, [ViscousDamping("joint/hinge")])
    found = converged(problem, problem.simulator.base)
    assert count_timestep(problem, found).theta[0] != found.theta[0]
    monkeypatch.setattr(timestep, name, value)
    counted = count_timestep(problem, found)
    assert counted.theta[0] == found.theta[0]
    if name != "UNFELT":
        assert counted.low[0] < 0.02 < counted.high[0]


def test_what_the_timestep_does_to_three_parameters_is_undone():
    true = np.asarray([0.3, 16.0, 0.4])

    def ripple(angle: float) -> float:
        return true[0] * np.sin(true[1] * angle + true[2])

    recordings = [
        pendulum.record(lambda spec: None, seed, ripple=ripple, noise=1e-4) for seed in range(2)
    ]
    problem = make_problem(recordings, [CoggingTorque("joint/hinge")], timestep=0.004)
    found = converged(problem, true)
    counted = count_timestep(problem, found)
    assert np.all(counted.low < true) and np.all(true < counted.high)
    assert np.all(abs(counted.theta - true) < 0.2 * abs(found.theta - true))


def test_what_a_fit_stopped_short_of_is_no_error_of_the_timestep():
    recordings = [record(UNIFORM, damping=0.02, noise=1e-3, finer=32)]
    problem = make_problem(recordings, [ViscousDamping("joint/hinge")])
    found = converged(problem, problem.simulator.base)
    short = follow(problem, found.theta + 2.0 * (found.high - found.low), found)
    expected = count_timestep(problem, found)
    counted = count_timestep(problem, short)
    assert counted.theta[0] == pytest.approx(expected.theta[0], rel=1e-3)
