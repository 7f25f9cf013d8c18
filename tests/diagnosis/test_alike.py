"""Candidates that do the same at the size at which one was fitted, and not at those screened."""

import dataclasses

import numpy as np
import pytest

from garat_jax.diagnosis import alike
from garat_jax.diagnosis.alike import alike_as_fitted
from garat_jax.diagnosis.screen import Score
from garat_jax.diagnosis.starts import settle
from garat_jax.effects import GravityScale, TorqueOffset, ViscousDamping
from tests.diagnosis.test_fit import UNIFORM, make_problem, record

EFFECTS = [TorqueOffset("joint/hinge"), GravityScale("world"), ViscousDamping("joint/hinge")]
OFFSET, GRAVITY, DAMPING = range(len(EFFECTS))
UP, DOWN, SLOWER = np.eye(3)


class OfForce:
    """What a force up changes, and one down, which lifts something off the ground."""

    def __init__(self, problem, fit, chosen):
        self.residual = np.zeros(3 * len(chosen))
        self._copies = len(chosen)

    def change(self, thetas: np.ndarray) -> np.ndarray:
        force = thetas[:, OFFSET] - 2.0 * (thetas[:, GRAVITY] - 1.0)
        change = np.outer(np.maximum(force, 0.0), UP) + np.outer(np.minimum(force, 0.0), DOWN)
        change += np.outer(thetas[:, DAMPING], SLOWER)
        return np.tile(change, self._copies).T


@pytest.mark.parametrize(("offset", "found"), [(-5.0, [GRAVITY]), (5.0, [])])
def test_a_force_that_was_screened_in_the_other_direction_is_alike(monkeypatch, offset, found):
    problem = make_problem([record(UNIFORM)], EFFECTS)
    current = settle(problem, problem.simulator.base, problem.segments.start)
    num_chosen = len(alike.screened(problem, current)[0])
    monkeypatch.setattr(alike, "Evidence", OfForce)

    def scored(effect: int, size: float, change: np.ndarray) -> Score:
        contribution = np.tile(change, num_chosen)
        return Score(effect, (effect,), (size,), {}, 0.5, 0.0, True, contribution)

    up = scored(OFFSET, 1.0, UP)
    others = [scored(GRAVITY, 1.1, -0.2 * DOWN), scored(DAMPING, 0.1, 0.1 * SLOWER)]
    theta = current.theta.copy()
    theta[OFFSET] = offset
    fitted = dataclasses.replace(current, theta=theta)
    same = alike_as_fitted(problem, current, up, fitted, others)
    assert [score.effect for score in same] == found


def test_what_is_screened_as_alike_is_alike():
    problem = make_problem([record(UNIFORM)], EFFECTS)
    current = settle(problem, problem.simulator.base, problem.segments.start)
    one, other = (
        Score(effect, (effect,), (1.0,), {}, 0.5, 0.0, True, np.asarray([1.0, small]))
        for effect, small in ((OFFSET, 0.0), (GRAVITY, 0.1))
    )
    assert alike_as_fitted(problem, current, one, current, [other]) == [other]
