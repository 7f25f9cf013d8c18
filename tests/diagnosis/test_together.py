"""Two effects of which neither comes near what a third explains are looked at together."""

from types import SimpleNamespace

import numpy as np
import pytest

from garat_jax.diagnosis.contend import Contender
from garat_jax.diagnosis.metric import make_metric, noise_floor
from garat_jax.diagnosis.rounds import run_round
from garat_jax.diagnosis.screen import Score
from garat_jax.diagnosis.starts import settle
from garat_jax.diagnosis.together import Pair, best_pair, far_better_pair
from garat_jax.effects import (
    AsymmetricFriction,
    EncoderScale,
    GravityScale,
    JointStiffness,
    ViscousDamping,
)
from tests.diagnosis.test_steps import DRAG, GAIN, damped_and_pulled

AT = "joint/hinge"
EFFECTS = (
    JointStiffness(AT),
    EncoderScale(AT),
    GravityScale("world"),
    ViscousDamping(AT),
    AsymmetricFriction(AT),
)
SPRING, ENCODER, GRAVITY, DAMPING, ASYMMETRIC = range(len(EFFECTS))
PROBLEM = SimpleNamespace(
    simulator=SimpleNamespace(effects=EFFECTS), fitted=np.asarray([True, False])
)
RNG = np.random.default_rng(0)
ONE, OTHER, NOISE, LEFT = np.linalg.qr(RNG.normal(size=(200, 4)))[0].T
RESIDUAL = -(ONE + OTHER + 0.1 * LEFT)


def screened(effect: int, *columns: np.ndarray, residual=RESIDUAL, possible: bool = True) -> Score:
    changes = np.stack(columns, axis=1)
    contribution = changes @ np.linalg.lstsq(changes, -residual)[0]
    share = 1.0 - np.sum((residual + contribution) ** 2) / np.sum(residual**2)
    what = (effect, (effect,), (0.0,), {effect: 1.0}, float(share), 0.0, possible, contribution)
    return Score(*what, changes=changes)


def third(effect: int) -> Score:
    """What does some of what both others do, and explains more than either."""
    return screened(effect, ONE + OTHER + 0.6 * NOISE)


def effects(pair: Pair | None):
    return pair and (pair.stronger.effect, pair.weaker.effect)


def test_two_that_explain_all_come_before_one_that_explains_more_than_either():
    scores = [third(SPRING), screened(ENCODER, 2.0 * ONE), screened(GRAVITY, ONE - 3.0 * OTHER)]
    assert scores[0].share > max(scores[1].share, scores[2].share)
    pair = best_pair(PROBLEM, scores)
    assert effects(pair) == (ENCODER, GRAVITY)
    assert pair.share == pytest.approx(2.0 / 2.01)


def test_their_share_is_that_of_least_squares_on_what_both_change():
    first, second = RNG.normal(size=(50, 2)), RNG.normal(size=(50, 3))
    residual = RNG.normal(size=50) + first.sum(axis=1) + second.sum(axis=1)
    both = np.concatenate([first, second], axis=1)
    rest = residual - both @ np.linalg.lstsq(both, residual)[0]
    scores = [
        screened(SPRING, *first.T, residual=residual),
        screened(ENCODER, *second.T, residual=residual),
    ]
    expected = 1.0 - np.sum(rest**2) / np.sum(residual**2)
    assert best_pair(PROBLEM, scores).share == pytest.approx(expected)


@pytest.mark.parametrize(
    "scores",
    [
        [screened(ENCODER, ONE), screened(GRAVITY, ONE + 0.1 * NOISE)],
        [screened(DAMPING, ONE), screened(ASYMMETRIC, OTHER)],
        [screened(ENCODER, ONE), screened(GRAVITY, OTHER, possible=False)],
        [screened(ENCODER, ONE), screened(GRAVITY, NOISE)],
        [screened(ENCODER, ONE + NOISE), screened(GRAVITY, ONE + 3.0 * NOISE)],
        [screened(ENCODER, ONE)],
        [],
    ],
    ids=["alike", "laws of the same", "impossible", "of no use", "turned round", "one", "none"],
)
def test_there_is_no_pair(scores):
    assert best_pair(PROBLEM, scores) is None


@pytest.mark.parametrize(("left", "is_better"), [([], False), ([0.3], True), ([0.3, 0.009], False)])
def test_two_are_far_better_than_what_the_best_one_left(left, is_better):
    scores = [third(SPRING), screened(ENCODER, ONE), screened(GRAVITY, OTHER)]
    contenders = [
        Contender(scores[0], SimpleNamespace(cost=np.asarray([cost, 0.0]))) for cost in left
    ]
    current = SimpleNamespace(cost=np.asarray([1.0, 0.0]))
    assert bool(far_better_pair(PROBLEM, current, scores, contenders)) == is_better


@pytest.mark.parametrize(("looks_ahead", "marked"), [(True, ["motor_gain"]), (False, [])])
def test_a_round_that_looks_ahead_fits_the_stronger_and_marks_it(monkeypatch, looks_ahead, marked):
    problem, said = damped_and_pulled(), []

    def gain_and_drag(problem, current, scores, contenders):
        scores = {score.effect: score for score in scores}
        return Pair(scores[GAIN], scores[DRAG], 1.0)

    monkeypatch.setattr("garat_jax.diagnosis.rounds.far_better_pair", gain_and_drag)
    metric = make_metric(problem)
    before = settle(problem, problem.simulator.base, problem.segments.start)
    floor = noise_floor(problem, metric, before)
    what = (problem, metric, before, [], floor, said.append)
    judged = run_round(*what, num=1, looks_ahead=looks_ahead)
    assert [candidate.effect for candidate, c in judged if c and c.is_paired] == marked
    assert ("fitting motor_gain at actuator/motor" in said) == looks_ahead
