"""Estimates where the timestep's error cannot be extrapolated."""

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest

from garat_jax.diagnosis import timestep
from garat_jax.diagnosis.differences import STEP, clear_differences
from garat_jax.diagnosis.fit import converge, fit
from garat_jax.diagnosis.held_out import (
    errors_of,
    finer_errors,
    measure_held_out,
    warn_of_timestep,
)
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.metric import Floor, make_metric, noise_floor, trusted
from garat_jax.diagnosis.model_card import Model
from garat_jax.diagnosis.segments import choose_grid
from garat_jax.diagnosis.starts import follow, settle, settle_twice
from garat_jax.diagnosis.timestep import count_timestep
from garat_jax.effects import (
    CoggingTorque,
    ContactFriction,
    MotorGain,
    TorqueOffset,
    ViscousDamping,
)
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


SMALL = np.array([STEP])
"""Finite difference of one parameter that makes nothing jump."""


class Shifted:
    """A simulator in which damping acts more, by an error that is as large as the timestep."""

    def __init__(self, simulator, more: float):
        self._simulator, self._more = simulator, more
        self.effects, self.slots, self.base = simulator.effects, simulator.slots, simulator.base
        self.host = simulator.host

    def predict(self, theta, start, segments):
        return self._simulator.predict(theta + self._more, start, segments)

    def refined(self, factor: int):
        return Shifted(self._simulator, self._more / factor)


def test_fits_at_the_whole_and_half_the_timestep_say_how_far_the_whole_is_from_none():
    recordings = [record(UNIFORM, damping=0.02)]
    problem = make_problem(recordings, [ViscousDamping("joint/hinge")])
    problem = dataclasses.replace(problem, simulator=Shifted(problem.simulator, 0.004))
    found = converged(problem, np.array([0.02]))
    assert found.theta[0] == pytest.approx(0.016, rel=0.05)
    assert timestep._shift_by_fits(problem, found, 24)[0] == pytest.approx(0.004, rel=0.05)
    finer = timestep._at_finer_timesteps(problem, found, 24, SMALL)
    assert finer.theta[0] == pytest.approx(0.02 - 0.004 / 16, rel=0.03)
    assert finer.low[0] < 0.02 < finer.high[0]


class Dipped:
    """A simulator whose cost has a dip at every 1e-3 of its parameter, in a signal of its own."""

    def __init__(self, simulator):
        self._simulator = simulator
        self.effects, self.slots, self.base = simulator.effects, simulator.slots, simulator.base
        self.host = simulator.host

    def predict(self, theta, start, segments):
        predicted = self._simulator.predict(theta, start, segments)
        wave = 2e-3 * np.sin(1.7 * np.arange(predicted.shape[2]))
        off = np.sin(np.pi * (theta[..., 0] - 0.02) / 1e-3)
        predicted[..., 0] += off.reshape(len(predicted), -1, 1) * wave
        return predicted

    def refined(self, factor: int):
        return Dipped(self._simulator.refined(factor))


def test_a_fit_does_not_stay_in_a_dip_that_was_none_at_the_timestep_before():
    problem, found = damped(noise=1e-3)
    problem = dataclasses.replace(problem, simulator=Dipped(problem.simulator))
    found = dataclasses.replace(found, theta=np.array([0.024]))
    in_dip = timestep._at_finer_timesteps(problem, found, 24, SMALL)
    assert in_dip.theta[0] == pytest.approx(0.024, abs=1e-4)
    beyond = timestep._at_finer_timesteps(problem, found, 24, np.array([1.0]))
    assert beyond.theta[0] == pytest.approx(0.02, abs=1e-3)
    assert beyond.low[0] < 0.02 < beyond.high[0]


def test_across_contacts_every_finer_fit_is_taken_to_the_middle_of_its_dips(monkeypatch):
    problem, found = damped(noise=1e-3)
    exact, asked = timestep._at_finer_timesteps(problem, found, 24, SMALL), []
    off, rough = 1e-3, 5e-3

    def smoothed(some, near, columns, covariance, sure):
        asked.append(some.simulator)
        return follow(some, near.theta + off, near), np.array([rough])

    monkeypatch.setattr(timestep, "_are_smooth", lambda *_: False)
    monkeypatch.setattr(timestep, "smooth_minimum", smoothed)
    counted = timestep._at_finer_timesteps(problem, found, 24, SMALL)
    assert asked[0] is problem.simulator.refined(timestep.REFINED)
    assert counted.theta[0] == pytest.approx(exact.theta[0] + off, abs=0.3 * off)
    assert exact.high[0] < exact.theta[0] + 0.5 * rough
    assert counted.high[0] > counted.theta[0] + rough
    assert counted.low[0] < counted.theta[0] - rough


def test_a_parameter_that_no_difference_moves_is_left_out_of_the_surface(monkeypatch):
    recordings = [record(UNIFORM, damping=0.02, noise=1e-3)]
    laws = [ViscousDamping("joint/hinge"), TorqueOffset("joint/hinge")]
    problem = make_problem(recordings, laws)
    found = fit(problem, np.array([0.02, 0.0]), problem.segments.start, (0, 1))
    differences = clear_differences(problem, found.theta, found.start, found.free)
    differences.linearisation.parameters[..., 1] = 0.0
    monkeypatch.setattr(timestep, "_are_smooth", lambda *_: False)
    near, _, rough = timestep._at_minimum(problem, found, differences)
    assert near.theta[1] == found.theta[1] and rough[1] == 0.0
    assert np.all(np.isfinite(rough)) and abs(near.theta[0] - 0.02) < 2e-3


def test_segments_that_are_fitted_again_are_of_every_recording():
    recordings = [record(np.arange(6000) * 0.004), record(np.arange(400) * 0.004, seed=1)]
    problem = make_problem(recordings, [ViscousDamping("joint/hinge")], horizon=0.2)
    problem = dataclasses.replace(problem, fitted=problem.fitted & (problem.segments.first > 0))
    chosen = timestep._chosen(problem, 24)
    assert timestep.REFITTED <= len(chosen) < 2.5 * timestep.REFITTED
    assert np.all(problem.fitted[chosen])
    assert set(problem.segments.recording[chosen]) == {0, 1}
    (gaps,) = np.unique(np.diff(chosen[problem.segments.recording[chosen] == 0])).reshape(1, -1)
    assert gaps[0] == 1 and len(gaps) == 2  # some in a row, the next ones farther on


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


def test_a_signal_that_was_not_held_out_is_not_warned_of():
    problem = make_problem([record(UNIFORM)], ())
    host = problem.simulator.host
    floor = Floor(0.1, np.ones(2), np.array([1.5, np.nan]))
    assert warn_of_timestep(problem, floor, host) == ()
    (warning,) = warn_of_timestep(problem, floor._replace(rms=np.array([np.hypot(1, 4), 2])), host)
    assert "the engine's own error is 4 times the noise of qpos.hinge" in warning


BALL = """
<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <geom name="ground" type="plane" size="5 5 0.1"/>
    <body name="ball" pos="0 0 0.06">
      <joint name="z" type="slide" axis="0 0 1"/>
      <geom name="ball" type="sphere" size="0.05" mass="1" solref="0.02 0.2"/>
    </body>
  </worldbody>
  <actuator><motor name="lift" joint="z" ctrlrange="-20 20" ctrllimited="true"/></actuator>
</mujoco>
"""


def bounced(seed: int, push: float = 0.0) -> Recording:
    """Lift a ball, pushed to and fro or not, and let it bounce, at a 32nd of its timestep."""
    rng = np.random.default_rng(seed)
    spec = mujoco.MjSpec.from_string(BALL)
    spec.option.timestep /= 32
    model = spec.compile()
    data, states = mujoco.MjData(model), []
    ctrl = np.repeat(rng.uniform(-10, 17, 100), 10)
    for command in ctrl:
        states.append([*data.qpos, *data.qvel])
        data.ctrl[0], data.qfrc_applied[0] = command, push * np.sin(8.0 * data.time)
        mujoco.mj_step(model, data, 32)
    states = np.asarray(states) + rng.normal(size=(1000, 2)) * [1e-4, 2e-3]
    return Recording(
        name=f"bounced {seed}",
        time=np.arange(1000) * 0.004,
        qpos=states[:, :1],
        qvel=states[:, 1:],
        ctrl=ctrl[:, None],
        torque={},
        velocity_measured=True,
        spans=((0, 1000),),
        warnings=(),
    )


def settled_ball(seed: int, push: float = 0.0, candidates=()):
    """Return a ball's problem, half of it held out, and its model with initial states settled."""
    model = Model("ball", Path(__file__), Path(__file__), mujoco.MjSpec.from_string(BALL))
    problem = make_problem(
        [bounced(seed, push)], candidates, horizon=0.2, model=model, timestep=0.004
    )
    problem = dataclasses.replace(problem, fitted=np.arange(len(problem.fitted)) % 2 > 0)
    theta = problem.simulator.base
    problem = trusted(problem, settle(problem, theta, problem.segments.start))
    return problem, settle_twice(problem, settle(problem, theta, problem.segments.start))


@pytest.mark.parametrize("seed", [0, 1])
def test_where_a_ball_bounces_the_noise_floor_is_near_what_the_true_model_leaves(seed):
    problem, settled = settled_ball(seed)
    metric, held_out = make_metric(problem), ~problem.fitted
    left = metric.error(settled.residual, held_out)
    assert left > 4 * metric.of_noise(held_out)
    assert noise_floor(problem, metric, settled).error == pytest.approx(left, rel=0.25)


@pytest.mark.parametrize("seed", [0, 1])
def test_what_impacts_hide_at_the_models_timestep_shows_at_a_finer_one(seed):
    """The push is not in the model; beside the integrator's error at impacts it makes no error."""
    for push, is_seen in ((0.0, False), (0.4, True)):
        problem, settled = settled_ball(seed, push)
        floor = noise_floor(problem, make_metric(problem), settled)
        error = errors_of(problem, (settled, settled), floor, "held out")
        finer, _ = finer_errors(problem, settled, "held out")
        assert error.integrator_exceeds_noise and error.is_near_floor
        assert finer and not finer.integrator_exceeds_noise
        assert finer.is_near_floor is not is_seen
        assert finer.timestep == 0.004 / 16


@pytest.mark.parametrize(("push", "explained"), [(0.0, True), (0.4, False)])
def test_what_was_found_is_measured_at_a_finer_timestep_too(monkeypatch, push, explained):
    monkeypatch.setattr("garat_jax.diagnosis.held_out.longest_errors", lambda *_: None)
    weak = mujoco.MjSpec.from_string(BALL.replace('joint="z"', 'joint="z" gear="0.5"'))
    model = Model("ball", Path(__file__), Path(__file__), weak)
    recordings = [bounced(seed, push) for seed in (0, 1)]
    candidates = [MotorGain("actuator/lift")]
    problem = make_problem(recordings, candidates, horizon=0.2, model=model, timestep=0.004)
    problem = dataclasses.replace(problem, fitted=problem.segments.recording < 1)
    problem = trusted(problem, settle(problem, np.array([2.0]), problem.segments.start))
    before, after = (settle(problem, np.array([x]), problem.segments.start) for x in (1.0, 2.0))
    floor = noise_floor(problem, make_metric(problem), after)
    grid = choose_grid(recordings, 0.004)
    found = measure_held_out(problem, (before, after), floor, recordings, grid, "held out")
    assert found.error.is_explained
    assert found.finer and found.finer.is_explained is explained
    assert found.are_explained is explained


def test_a_finer_timestep_tells_nothing_of_a_model_as_it_is_or_where_noise_hides_more(monkeypatch):
    monkeypatch.setattr("garat_jax.diagnosis.held_out.longest_errors", lambda *_: None)
    monkeypatch.setattr("garat_jax.diagnosis.held_out.finer_errors", lambda *_: ("measured", None))
    problem, settled = settled_ball(0, candidates=[MotorGain("actuator/lift")])
    floor = noise_floor(problem, make_metric(problem), settled)

    def measured(fit, floor):
        fits = settled, fit
        return measure_held_out(problem, fits, floor, [], choose_grid([bounced(0)], 0.004), "")

    found = dataclasses.replace(settled, theta=np.array([1.001]))
    as_it_is = measured(settled, floor)
    assert as_it_is.are_explained and as_it_is.error.integrator_exceeds_noise
    assert as_it_is.finer is None
    assert measured(found, floor).finer == "measured"
    noise = make_metric(problem).of_noise(~problem.fitted)
    loud = dataclasses.replace(found, residual=0.0 * found.residual)
    assert measured(loud, floor._replace(error=1.2 * noise)).finer is None


def test_an_engine_that_errs_as_much_at_a_finer_timestep_tells_nothing_there(monkeypatch):
    problem, settled = settled_ball(0)
    monkeypatch.setattr("garat_jax.diagnosis.metric.TOO_COARSE", 1e-6)
    assert finer_errors(problem, settled, "held out") == (None, None)
