"""Where the recordings held out hardly show an effect, each recording is held out in turn."""

import dataclasses

import numpy as np
import pytest

from garat_jax.diagnosis.contend import Contender
from garat_jax.diagnosis.cross_validation import acts_in, gains_in_turn
from garat_jax.diagnosis.findings import Candidate, Interval
from garat_jax.diagnosis.fit import fit
from garat_jax.diagnosis.judge import NO_CERTAIN_GAIN, NO_CERTAIN_LEAD, PASSING_IN_TURN, is_certain
from garat_jax.diagnosis.metric import make_metric, noise_floor
from garat_jax.diagnosis.rounds import run_round
from garat_jax.diagnosis.screen import Score
from garat_jax.diagnosis.starts import settle
from garat_jax.effects import TorqueOffset
from tests.diagnosis.pendulum import record
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
    """Return what the falls are, and that of the error of those that were fitted."""
    current, fitted = fits(problem)
    contender = Contender(Score(0, (0,), (), {}, 0.9, 0.0, True, np.zeros(0)), fitted)
    said: list[str] = []
    found = gains_in_turn(
        problem, make_metric(problem), current, [(candidate, contender)], said.append
    )
    assert len(said) == len(found)
    return found


@pytest.fixture(scope="module")
def hidden():
    """Three recordings that show an effect, and one that does not."""
    return problem_of(0.05, 0.05, 0.05, 0.0)


def test_what_each_recording_predicts_of_the_others_lowers_the_error(hidden, monkeypatch):
    monkeypatch.setattr("garat_jax.diagnosis.cross_validation.FEWEST_SEGMENTS", 1000)
    assert is_certain(gains(hidden)[0])


def test_what_helps_where_it_was_fitted_only_does_not(monkeypatch):
    monkeypatch.setattr("garat_jax.diagnosis.cross_validation.FEWEST_SEGMENTS", 1000)
    one_only = problem_of(0.12, -0.02, -0.02, 0.0)
    current, fitted = fits(one_only)
    assert fitted.cost[one_only.fitted].sum() < 0.95 * current.cost[one_only.fitted].sum()
    assert not is_certain(gains(one_only)[0])


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
    assert found.passes and found.why == PASSING_IN_TURN
    assert found.held_out_gain == uncertain
    assert said[-1] == "holding out each recording in turn, for torque_offset at joint/hinge"
