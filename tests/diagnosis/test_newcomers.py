"""What is tried in the place of effects that were added, beside what was found since."""

import dataclasses

import pytest

from garat_jax.diagnosis.contend import Contender
from garat_jax.diagnosis.findings import Named
from garat_jax.diagnosis.judge import BEHIND
from garat_jax.diagnosis.metric import make_metric
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.screen import screen
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.diagnosis.steps import reconsider
from tests.diagnosis.test_steps import (
    AT,
    DAMPING,
    DRAG,
    GAIN,
    OFFSET,
    added,
    candidate,
    contender,
    damped_and_pulled,
    reconsidered,
)


@pytest.fixture(scope="module")
def problem() -> Problem[Simulator]:
    return damped_and_pulled()


@pytest.mark.parametrize(("first", "is_replaced"), [(DRAG, True), (DAMPING, False)])
def test_the_last_is_held_against_others_once_more_where_one_before_it_gave_way(
    problem, first, is_replaced
):
    steps, said = added(problem, first, None, OFFSET), []
    reconsider(problem, make_metric(problem), steps, steps[-1].fit, said.append)
    again = f"looking for what would explain more than {Named('torque_offset', AT)}"
    assert (again in said) == is_replaced


def test_the_last_gives_way_as_well(problem):
    """The pull comes in the gain's place, and then the damping in that of the drag."""
    steps = added(problem, GAIN, OFFSET, DRAG)
    steps[-1] = steps[-1]._replace(alike=[(candidate(DAMPING), contender(problem, DAMPING))])
    found, current = reconsider(problem, make_metric(problem), steps, steps[-1].fit, [].append)
    assert [step.effect for step in found] == [OFFSET, DAMPING]
    assert {*current.free} == {OFFSET, DAMPING}
    assert found[-1].fit is current


@pytest.mark.parametrize("num_parameters", [1, 2])
def test_what_does_the_same_as_an_earlier_effect_with_no_more_parameters_is_tried(
    problem, monkeypatch, num_parameters
):
    """Drag does what damping does where screened, and comes behind it."""

    def with_drag(*of):
        scores, columns = screen(*of), (DRAG, GAIN)[:num_parameters]
        (does,) = [s.contribution for s in scores if s.effect == DAMPING]
        return [
            dataclasses.replace(s, columns=columns, contribution=does) if s.effect == DRAG else s
            for s in scores
        ]

    monkeypatch.setattr("garat_jax.diagnosis.steps.screen", with_drag)
    monkeypatch.setattr("garat_jax.diagnosis.steps.with_twins", lambda *of: of[3])
    monkeypatch.setattr("garat_jax.diagnosis.steps.NEWCOMERS", 1)
    tried = []

    def fit_one(problem, current, score, rival, say):
        tried.append(score.effect)
        return Contender(score, current)

    monkeypatch.setattr("garat_jax.diagnosis.steps.fit_one", fit_one)
    reconsidered(problem, DAMPING, None, OFFSET)
    assert (DRAG in tried) == (num_parameters == 1)


def test_a_newcomer_is_held_against_what_it_would_replace(problem, monkeypatch):
    def drag_first(*of):
        return sorted(screen(*of), key=lambda score: score.effect != DRAG)

    monkeypatch.setattr("garat_jax.diagnosis.steps.screen", drag_first)
    steps, _, _ = reconsidered(problem, DAMPING, None, OFFSET)
    (newcomer,) = [c for c, k in steps[0].alike if k and k.score.effect == DRAG]
    assert steps[0].effect == DAMPING
    assert newcomer.why == BEHIND
