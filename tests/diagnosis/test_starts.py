"""Initial states that noise or another model's fit has led astray, and fits across contacts."""

import dataclasses
from collections.abc import Mapping

import mujoco
import numpy as np
import pytest

from garat_jax.diagnosis import descend
from garat_jax.diagnosis.contend import Contender, fit_further
from garat_jax.diagnosis.differences import clear_differences, is_erratic, typical_size
from garat_jax.diagnosis.fit import fit
from garat_jax.diagnosis.model_card import Model
from garat_jax.diagnosis.problem import Problem, linearise
from garat_jax.diagnosis.screen import Score
from garat_jax.diagnosis.simulate import Simulator, columns_of
from garat_jax.diagnosis.starts import measured_anew, settle, settle_anew, settle_twice
from garat_jax.effects import AsymmetricFriction, ContactFriction
from tests.diagnosis import pendulum, test_contact
from tests.diagnosis.test_fit import make_problem

FRICTION = 0.35


@pytest.fixture(scope="module")
def puck() -> Problem:
    """Return a problem whose noise is larger than the engine's error at its timestep."""
    recordings = [test_contact.record(FRICTION, 0, noise=10.0)]
    return problem_of(puck_model(), recordings, ContactFriction("geom/puck"), {"sliding": 0.5})


def puck_model() -> Model:
    return Model("puck", __file__, __file__, mujoco.MjSpec.from_string(test_contact.PUCK))


def problem_of(model: Model, recordings, effect, start: Mapping[str, float]) -> Problem:
    return make_problem(recordings, (dataclasses.replace(effect, **start),), model=model)


def root_mean_square(residual: np.ndarray) -> float:
    return float(np.sqrt(np.mean(residual**2)))


def test_a_puck_that_hops_is_put_back_on_the_table(puck):
    theta = np.array([FRICTION])
    settled = settle(puck, theta, puck.segments.start)
    hopping = settled.start.copy()
    hopping[::2] += np.array([0.0, 0.002, 0.0, 0.2])
    lin = linearise(puck, theta, hopping, (), ())
    assert root_mean_square(lin.residual) > 3 * root_mean_square(settled.residual)
    start, anew = settle_anew(puck, theta, hopping, lin)
    assert root_mean_square(anew.residual) < 1.1 * root_mean_square(settled.residual)
    again = linearise(puck, theta, start, (), ())
    np.testing.assert_allclose(again.residual, anew.residual, atol=1e-6)


def test_of_two_places_to_settle_from_the_better_counts_in_each_segment(puck):
    theta = np.array([FRICTION])
    fresh = settle(puck, theta, puck.segments.start)
    moved = settle(puck, np.array([0.5]), fresh.start)  # another model's initial states
    lin = linearise(puck, theta, moved.start, (), ())
    half = np.arange(len(fresh.start)) % 2 == 0
    led_astray = dataclasses.replace(
        fresh,
        start=np.where(half[:, None], moved.start, fresh.start),
        residual=np.where(half[:, None], lin.residual, fresh.residual),
        sensitivity=np.where(half[:, None, None], lin.start, fresh.sensitivity),
    )
    twice = settle_twice(puck, led_astray)
    assert twice.cost.sum() < 0.9 * led_astray.cost.sum()
    assert np.all(twice.cost <= led_astray.cost)
    np.testing.assert_array_equal(twice.start[~half], led_astray.start[~half])
    again = linearise(puck, theta, twice.start, (), ())
    np.testing.assert_allclose(again.residual, twice.residual, atol=1e-6)


def test_segments_near_their_noise_are_left_alone(puck):
    theta = np.array([FRICTION])
    settled = settle(puck, theta, puck.segments.start)
    near = np.mean(settled.residual**2, axis=1) < 1.3
    assert 0 < np.count_nonzero(near) < len(near)
    lin = linearise(puck, theta, settled.start, (), ())
    start, _ = settle_anew(puck, theta, settled.start, lin)
    np.testing.assert_array_equal(start[near], settled.start[near])


@pytest.mark.parametrize("first", [0.25, 0.45])
def test_friction_of_a_contact_is_fitted_from_afar_with_an_interval(puck, first):
    misled = settle(puck, np.array([0.5]), puck.segments.start).start
    found = fit(puck, np.array([first]), misled, (0,))
    assert found.theta[0] == pytest.approx(FRICTION, rel=0.02)
    assert 1e-3 < found.high[0] - found.low[0] < 0.02
    true = settle(puck, np.array([FRICTION]), puck.segments.start)
    assert found.cost.sum() < 1.1 * true.cost.sum()


def test_a_rival_that_fits_better_does_not_stop_a_fit_that_still_falls():
    recordings = [test_contact.record(FRICTION, 3)]
    law = ContactFriction("geom/puck")
    problem = problem_of(puck_model(), recordings, law, {"sliding": 0.5})
    far = settle(problem, np.array([0.8]), problem.segments.start)
    beside = fit(problem, far.theta, far.start, (0,), rival=problem.expected.sum())
    assert beside.theta[0] == pytest.approx(FRICTION, rel=0.01)


def test_steps_end_where_jumps_keep_nothing_of_what_they_promise(monkeypatch):
    law = ContactFriction("geom/puck")
    recordings = [test_contact.record(FRICTION, 1)]
    problem = problem_of(puck_model(), recordings, law, {"sliding": 0.5})
    near = settle(problem, np.array([0.36]), problem.segments.start)
    differences = clear_differences(problem, near.theta, near.start, (0,))
    calls, predict = [], Simulator.predict

    def counted(self, *arguments):
        calls.append(1)
        return predict(self, *arguments)

    def descended():
        calls.clear()
        how = problem, (0,), np.inf, near.theta, near.start, differences, False
        return descend.descend(*how)[0], len(calls)

    monkeypatch.setattr(Simulator, "predict", counted)
    theta, few = descended()
    monkeypatch.setattr(descend, "STALLED", descend.STEPS)
    patient, many = descended()
    assert few < 0.5 * many
    assert theta[0] == pytest.approx(patient[0], rel=1e-3)


def test_old_derivatives_by_initial_states_lead_to_the_same_fit(puck):
    misled = settle(puck, np.array([0.5]), puck.segments.start)
    fresh = fit(puck, np.array([0.25]), misled.start, (0,))
    old = fit(puck, np.array([0.25]), misled.start, (0,), sensitivity=misled.sensitivity)
    assert old.theta[0] == pytest.approx(fresh.theta[0], rel=0.02)
    assert old.cost.sum() == pytest.approx(fresh.cost.sum(), rel=0.1)


def test_derivatives_are_measured_anew_where_the_residual_is(puck, monkeypatch):
    """A segment that is held out has moved with the parameters, even if its start stayed."""
    seen = []

    def checked(problem, theta, start, lin, chosen):
        some, near = problem.take(chosen), lin.start[chosen]
        here = linearise(some, theta, start[chosen], (), (), near)
        np.testing.assert_allclose(lin.residual[chosen], here.residual, atol=1e-6)
        seen.append(chosen)
        return measured_anew(problem, theta, start, lin, chosen)

    monkeypatch.setattr("garat_jax.diagnosis.descend.measured_anew", checked)
    half = dataclasses.replace(puck, fitted=np.arange(len(puck.fitted)) % 2 == 0)
    misled = settle(half, np.array([0.5]), half.segments.start)
    fit(half, np.array([0.25]), misled.start, (0,), sensitivity=misled.sensitivity)
    assert seen


def test_a_change_of_few_samples_is_erratic():
    smooth = np.sin(np.arange(1000.0))
    jumps = np.full(1000, 1e-3)
    jumps[::100] = 10.0
    assert is_erratic(jumps, num_signals=1)
    assert not is_erratic(smooth, num_signals=1)
    assert not is_erratic(np.zeros(10), num_signals=1)


def test_a_change_of_one_signal_of_many_is_not_erratic():
    """What one joint of a rig does hardly moves the others, by its coupling or by rounding."""
    rng = np.random.default_rng(0)
    change = rng.normal(size=(1000, 16)) * np.array([1.0, 0.3, *[1e-3] * 6, *[1e-13] * 8])
    assert not is_erratic(change.ravel(), num_signals=16)
    typical = typical_size(change.ravel(), change.ravel(), 16)
    assert typical == pytest.approx(0.67 * np.linalg.norm(change), rel=0.1)


def test_a_perturbation_after_which_few_samples_diverge_is_erratic():
    change = np.full((1000, 2), 0.05)
    change[::200] = 1e8
    assert is_erratic(change.ravel(), num_signals=2)


def test_parameters_that_screening_left_out_are_fitted_with_the_best_contender():
    damping = {"viscous_positive": 0.02, "viscous_negative": 0.005}

    def rub(speed: float) -> float:
        return -speed * damping["viscous_positive" if speed > 0 else "viscous_negative"]

    recordings = [pendulum.record(lambda spec: None, seed, torque=rub) for seed in range(2)]
    effect = AsymmetricFriction("joint/hinge")
    problem = problem_of(pendulum.MODEL, recordings, effect, {})
    columns = columns_of(problem.simulator.slots, 0)
    chosen = (columns["viscous_positive"],)
    score = Score(0, chosen, (), {}, 1.0, 0.0, True, np.zeros(0))
    first = fit(problem, problem.simulator.base, problem.segments.start, chosen)
    (whole,) = fit_further(problem, Contender(score, first), lambda message: None)
    assert whole.fit.cost.sum() < 0.9 * first.cost.sum()
    for name, value in damping.items():
        assert whole.fit.theta[columns[name]] == pytest.approx(value, abs=1e-3)
    assert fit_further(problem, whole, lambda message: None) == []
