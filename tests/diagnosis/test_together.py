"""Two effects of which neither comes near what a third explains are looked at together."""

from types import SimpleNamespace

import numpy as np
import pytest

from garat_jax.diagnosis import together
from garat_jax.diagnosis.contend import Contender
from garat_jax.diagnosis.screen import Score
from garat_jax.diagnosis.together import best_pair, with_paired
from garat_jax.effects import (
    AsymmetricFriction,
    EncoderScale,
    GravityScale,
    JointStiffness,
    ViscousDamping,
)

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


def effects(pair: together.Pair | None):
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
        [screened(ENCODER, ONE)],
        [],
    ],
    ids=["alike", "laws of the same", "impossible", "of no use", "one", "none"],
)
def test_there_is_no_pair(scores):
    assert best_pair(PROBLEM, scores) is None


def fitted(effect: int, left: float) -> Contender:
    fit = SimpleNamespace(cost=np.asarray([left, 0.0]))
    return Contender(screened(effect, ONE), fit)


@pytest.mark.parametrize(
    ("best_left", "known", "is_marked", "is_fitted"),
    [(0.3, (), True, True), (0.3, (ENCODER,), True, False), (0.009, (ENCODER,), False, False)],
    ids=["not fitted yet", "fitted", "the best one leaves hardly more"],
)
def test_the_stronger_is_marked_where_both_leave_far_less_than_the_best_one(
    monkeypatch, best_left, known, is_marked, is_fitted
):
    said = []

    def fit_one(problem, current, score, rival, say):
        said.append(score.effect)
        return fitted(score.effect, 0.6)

    monkeypatch.setattr(together, "fit_one", fit_one)
    scores = [third(SPRING), screened(ENCODER, ONE + 0.1 * OTHER), screened(GRAVITY, OTHER)]
    contenders = [fitted(SPRING, best_left), *(fitted(effect, 0.6) for effect in known)]
    current = SimpleNamespace(cost=np.asarray([1.0, 0.0]))
    found = with_paired(PROBLEM, current, scores, contenders, print)
    marked = [c.score.effect for c in found if c.is_paired]
    assert marked == [ENCODER] * is_marked
    assert said == [ENCODER] * is_fitted
    assert len(found) == len(contenders) + is_fitted


def test_nothing_is_marked_where_nothing_was_fitted():
    scores = [screened(ENCODER, ONE), screened(GRAVITY, OTHER)]
    assert with_paired(PROBLEM, SimpleNamespace(), scores, [], print) == []
