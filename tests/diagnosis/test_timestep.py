"""Estimates where the timestep's error cannot be extrapolated."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from garat_jax.diagnosis import timestep
from garat_jax.diagnosis.differences import clear_differences
from garat_jax.diagnosis.fit import converge, fit
from garat_jax.diagnosis.model_card import Model
from garat_jax.diagnosis.starts import follow, settle
from garat_jax.diagnosis.timestep import count_timestep
from garat_jax.effects import CoggingTorque, ContactFriction, ViscousDamping
from tests.diagnosis import pendulum, test_contact
from tests.diagnosis.test_fit import UNIFORM, make_problem, record
from tests.diagnosis.test_starts import FRICTION, problem_of


def converged(problem, theta):
    """Fit, to less than noise: what `count_timestep` moves from."""
    free = tuple(range(len(theta)))
    found = fit(problem, theta, problem.segments.start, free)
    return converge(problem, found, clear_differences(problem, found.theta, found.start, free))[0]


@pytest.mark.parametrize("seed", [0, 2])
def test_where_contacts_make_the_timestep_err_an_estimate_is_that_of_a_fine_one(seed):
    model = Model(
        "puck", Path(__file__), Path(__file__), mujoco.MjSpec.from_string(test_contact.PUCK)
    )
    recordings = [test_contact.record(FRICTION, seed)]
    problem = problem_of(model, recordings, ContactFriction("geom/puck"), {"sliding": 0.5})
    settled = settle(problem, np.array([0.4]), problem.segments.start)
    found = fit(problem, np.array([0.4]), settled.start, (0,))
    assert abs(found.theta[0] - FRICTION) > 0.05 * FRICTION
    counted = count_timestep(problem, found)
    assert counted.theta[0] == pytest.approx(FRICTION, rel=0.03)


@pytest.mark.parametrize(("kept", "made"), [(0.2, False), (1.8, False), (0.7, True), (1.3, True)])
def test_a_shift_that_does_less_or_more_than_promised_is_not_made(monkeypatch, kept, made):
    problem, found = damped(noise=1e-5)
    exact = count_timestep(problem, found)
    monkeypatch.setattr(timestep, "_kept_promise", lambda *_: kept)
    counted = count_timestep(problem, found)
    assert bool(counted.theta[0] == exact.theta[0]) is made
    assert abs(counted.theta[0] - 0.02) < 0.3 * abs(found.theta[0] - 0.02)
    assert counted.low[0] < 0.02 < counted.high[0]
    if made:
        shift = abs(counted.theta[0] - found.theta[0])
        assert counted.high[0] - counted.low[0] > 2 * abs(1 - kept) * shift


def test_where_noise_is_above_the_timesteps_error_an_interval_reaches_as_far(monkeypatch):
    problem, found = damped(noise=1e-3)
    monkeypatch.setattr(timestep, "_kept_promise", lambda *_: 0.2)
    monkeypatch.setattr(timestep, "_is_coarse", lambda *_: False)
    monkeypatch.setattr(timestep, "_shift_by_fits", lambda *_: np.array([0.01]))
    counted = count_timestep(problem, found)
    assert counted.theta[0] == pytest.approx(found.theta[0], rel=1e-3)
    half = 0.5 * (found.high[0] - found.low[0])
    assert counted.high[0] == pytest.approx(found.theta[0] + half + 0.01, abs=0.1 * half)
    assert counted.low[0] == pytest.approx(found.theta[0] - half, abs=0.1 * half)


def damped(noise: float):
    """Return a pendulum that lacks damping, recorded at a fine timestep, and its fit."""
    recordings = [record(UNIFORM, damping=0.02, noise=noise, finer=32)]
    problem = make_problem(recordings, [ViscousDamping("joint/hinge")])
    return problem, converged(problem, problem.simulator.base)


@pytest.mark.parametrize(
    ("name", "value"), [("EXPLAINED", 0.0), ("start_step", lambda *_: 1e3), ("UNFELT", np.inf)]
)
def test_a_shift_that_explains_no_more_is_not_made(monkeypatch, name, value):
    problem, found = damped(noise=1e-5)
    exact = count_timestep(problem, found)
    assert exact.theta[0] != found.theta[0]
    monkeypatch.setattr(timestep, name, value)
    counted = count_timestep(problem, found)
    assert counted.theta[0] != exact.theta[0]
    if name == "UNFELT":
        assert counted.theta[0] == found.theta[0]
    else:
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
    problem, found = damped(noise=1e-3)
    short = follow(problem, found.theta + 2.0 * (found.high - found.low), found)
    expected = count_timestep(problem, found)
    counted = count_timestep(problem, short)
    assert counted.theta[0] == pytest.approx(expected.theta[0], rel=1e-3)
