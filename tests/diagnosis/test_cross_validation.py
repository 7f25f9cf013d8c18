"""Where the recordings held out hardly show an effect, each recording is held out in turn."""

import dataclasses

import numpy as np
import pytest

from garat_jax.diagnosis.contend import Contender
from garat_jax.diagnosis.cross_validation import acts_in, gains_in_turn, in_turn
from garat_jax.diagnosis.findings import Candidate, Interval
from garat_jax.diagnosis.fit import fit
from garat_jax.diagnosis.judge import NO_CERTAIN_GAIN, NO_CERTAIN_LEAD, fall, is_certain
from garat_jax.diagnosis.metric import make_metric, noise_floor
from garat_jax.diagnosis.rounds import run_round
from garat_jax.diagnosis.screen import Score
from garat_jax.diagnosis.starts import settle
from garat_jax.effects import TorqueOffset, TorqueSaturation, ViscousDamping
from tests.diagnosis.pendulum import add_damping, record
from tests.diagnosis.test_fit import make_problem

LIKELY = Candidate(
    effect="torque_offset",
    target="joint/hinge",
    parameters={},
    share=0.9,
    p_value=0.0,
    error_after=0.0,
    held_out_gain=Interval(0.01, -0.1, 0.1),
    stability=1.0,
    indistinguishable_from=(),
    passes=False,
    why=NO_CERTAIN_GAIN,
)


def alike(spec):
    del spec


def problem_of(*pulls: float):
    """Return recordings' problem at which cables pull [N m]; the last is held out."""
    recordings = [record(alike, seed, pull) for seed, pull in enumerate(pulls)]
    problem = make_problem(recordings, [TorqueOffset("joint/hinge")])
    return dataclasses.replace(problem, fitted=problem.segments.recording < len(pulls) - 1)


def fits(problem):
    current = settle(problem, problem.simulator.base, problem.segments.start)
    return current, fit(problem, current.theta, current.start, [0])


def gains(problem, candidate=LIKELY):
    """Return the falls with each recording held out in turn, where they are asked for."""
    current, fitted = fits(problem)
    contender = Contender(Score(0, (0,), (), {}, 0.9, 0.0, True, np.zeros(0)), fitted)
    asked = [(candidate, contender)]
    return gains_in_turn(problem, make_metric(problem), current, asked, lambda _: None)


@pytest.fixture(scope="module")
def hidden():
    """Three recordings that show an effect, and one that does not."""
    return problem_of(0.05, 0.05, 0.05, 0.0)


def test_what_each_recording_predicts_of_the_others_lowers_the_error(hidden, monkeypatch):
    monkeypatch.setattr("garat_jax.diagnosis.cross_validation.FEWEST_SEGMENTS", 1000)
    assert is_certain(gains(hidden)[0])


def test_what_helps_where_it_was_fitted_only_does_not(monkeypatch):
    monkeypatch.setattr("garat_jax.diagnosis.cross_validation.FEWEST_SEGMENTS", 1000)
    one_only = problem_of(0.12, 0.0, 0.0)
    current, fitted = fits(one_only)
    assert is_certain(fall(one_only, make_metric(one_only), current, fitted, one_only.fitted))
    assert not gains(one_only)


def fitted_to(problem, numbers, theta, columns):
    """Fit to some of the recordings."""
    some = dataclasses.replace(problem, fitted=np.isin(problem.segments.recording, numbers))
    start = problem.segments.start
    return fit(some, theta, start, columns)


def test_each_recording_is_predicted_by_a_fit_to_the_other_fitted_ones():
    pulled = problem_of(0.12, 0.02, -0.05, 0.3)
    current, together = fits(pulled)
    predicted = in_turn(pulled, together, current)
    recording = pulled.segments.recording
    for number in range(3):
        others = [other for other in range(3) if other != number]
        alone = fitted_to(pulled, others, current.theta, [0])
        assert abs(alone.theta[0] - together.theta[0]) > 0.005
        own = recording == number
        size = np.linalg.norm(alone.residual[own])
        assert np.linalg.norm((predicted.residual - alone.residual)[own]) < 0.02 * size
        assert np.linalg.norm((predicted.residual - together.residual)[own]) > 0.1 * size
    own = recording == 3
    np.testing.assert_array_equal(predicted.residual[own], together.residual[own])


def test_what_was_fitted_before_is_fitted_to_the_others_too(monkeypatch):
    monkeypatch.setattr("garat_jax.diagnosis.cross_validation.FEWEST_SEGMENTS", 1000)
    recordings = [record(add_damping, seed, 0.05) for seed in range(4)]
    problem = make_problem(recordings, [TorqueOffset("joint/hinge"), ViscousDamping("joint/hinge")])
    problem = dataclasses.replace(problem, fitted=problem.segments.recording < 3)
    current = fitted_to(problem, [0, 1, 2], problem.simulator.base, [0])
    both = fit(problem, current.theta, current.start, [0, 1])
    contender = Contender(Score(1, (1,), (), {}, 0.9, 0.0, True, np.zeros(0)), both)
    metric, asked = make_metric(problem), [(LIKELY, contender)]
    found = gains_in_turn(problem, metric, current, asked, lambda _: None)[1]
    before, after = (in_turn(problem, one, current) for one in (current, both))
    assert np.any(before.residual != current.residual)
    assert found == fall(problem, metric, before, after, np.ones_like(problem.fitted))


def test_a_limit_that_one_recording_reaches_is_told_by_no_other(monkeypatch):
    monkeypatch.setattr("garat_jax.diagnosis.cross_validation.FEWEST_SEGMENTS", 1000)

    def limit(spec):
        spec.actuator("motor").forcelimited = True
        spec.actuator("motor").forcerange = [-0.6, 0.6]

    def driven(size: float, seed: int):
        control = lambda time, angle, speed: size * np.sin(9 * time + seed)  # noqa: E731
        return record(limit, seed, control=control)

    def in_turn_of(*sizes):
        recordings = [driven(size, seed) for seed, size in enumerate(sizes)]
        problem = make_problem(recordings, [TorqueSaturation("actuator/motor")])
        problem = dataclasses.replace(problem, fitted=problem.segments.recording < 3)
        current = settle(problem, problem.simulator.base, problem.segments.start)
        theta = np.full_like(current.theta, 0.8)
        fitted = fit(problem, theta, current.start, [0])
        assert fitted.theta[0] == pytest.approx(0.6, rel=0.01)
        contender = Contender(Score(0, (0,), (), {}, 0.9, 0.0, True, np.zeros(0)), fitted)
        asked = [(LIKELY, contender)]
        return gains_in_turn(problem, make_metric(problem), current, asked, lambda _: None)

    assert not in_turn_of(1.0, 0.4, 0.4, 0.5)
    assert is_certain(in_turn_of(1.0, 0.9, 0.4, 0.5)[0])


def test_one_fit_of_two_names_is_made_once(hidden, monkeypatch):
    monkeypatch.setattr("garat_jax.diagnosis.cross_validation.FEWEST_SEGMENTS", 1000)
    current, fitted = fits(hidden)
    two = [Contender(Score(i, (0,), (), {}, 0.9, 0.0, True, np.zeros(0)), fitted) for i in (0, 1)]
    said: list[str] = []
    asked = [(LIKELY, contender) for contender in two]
    found = gains_in_turn(hidden, make_metric(hidden), current, asked, said.append)
    assert found[0] == found[1] and len(said) == 1


def test_none_is_asked_of_where_it_is_held_out_often(hidden):
    assert not gains(hidden)


@pytest.mark.parametrize(
    "other",
    [
        {"why": NO_CERTAIN_LEAD},
        {"stability": 0.5},
        {"held_out_gain": Interval(0.0, 0.0, 0.0)},
    ],
)
def test_nor_of_what_lacks_more_than_certainty(hidden, monkeypatch, other):
    monkeypatch.setattr("garat_jax.diagnosis.cross_validation.FEWEST_SEGMENTS", 1000)
    assert not gains(hidden, dataclasses.replace(LIKELY, **other))


def test_a_single_recording_has_no_other_to_predict_it(monkeypatch):
    monkeypatch.setattr("garat_jax.diagnosis.cross_validation.FEWEST_SEGMENTS", 1000)
    assert not gains(problem_of(0.05, 0.0))


def test_blocks_count_by_their_part_of_what_changes(hidden):
    metric, current = make_metric(hidden), fits(hidden)[0]
    segments = np.flatnonzero(~hidden.fitted)
    assert hidden.blocks().max() == 0  # one in each segment
    assert acts_in(hidden, metric, current, current) == 0.0

    def changed(sizes):
        residual = current.residual.copy()
        residual[segments[: len(sizes)]] += np.asarray(sizes)[:, None]
        return acts_in(hidden, metric, current, dataclasses.replace(current, residual=residual))

    assert changed([1.0]) == pytest.approx(1.0)
    assert changed([1.0, 1.0, 1.0]) == pytest.approx(3.0, rel=0.1)
    assert 1.0 < changed([1.0, 0.3]) < 1.3
    residual, num_signals = current.residual.copy(), hidden.num_signals
    for segment, signal in zip(segments, range(num_signals), strict=False):
        residual[segment, signal::num_signals] += metric.weight[signal] ** -0.5
    elsewhere = dataclasses.replace(current, residual=residual)
    assert acts_in(hidden, metric, current, elsewhere) == pytest.approx(num_signals)


def test_in_what_is_fitted_it_may_act_as_often_as_it_likes(hidden):
    current = fits(hidden)[0]
    residual = current.residual.copy()
    residual[hidden.fitted] += 1.0
    elsewhere = dataclasses.replace(current, residual=residual)
    assert acts_in(hidden, make_metric(hidden), current, elsewhere) == 0.0


def test_a_round_holds_out_each_in_turn_where_those_held_out_say_too_little(hidden, monkeypatch):
    said: list[str] = []
    current, metric = fits(hidden)[0], make_metric(hidden)

    def first():
        floor = noise_floor(hidden, metric, current)
        return run_round(hidden, metric, current, [], floor, said.append, above=0.0)[0][0]

    uncertain = LIKELY.held_out_gain
    monkeypatch.setattr("garat_jax.diagnosis.judge.held_out_gain", lambda *_: uncertain)
    assert first().why == NO_CERTAIN_GAIN
    monkeypatch.setattr("garat_jax.diagnosis.cross_validation.FEWEST_SEGMENTS", 1000)
    found = first()
    assert found.passes
    assert found.why.startswith("passes every gate with each recording held out in turn")
    assert found.held_out_gain == uncertain
    assert said[-1] == "holding out each recording in turn, for torque_offset at joint/hinge"
