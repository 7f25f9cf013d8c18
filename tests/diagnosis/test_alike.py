"""Candidates that do the same at the size at which one was fitted, and not at those screened."""

import dataclasses

import numpy as np
import pytest

from garat_jax.diagnosis import alike
from garat_jax.diagnosis.alike import alike_as_fitted
from garat_jax.diagnosis.screen import Score
from garat_jax.diagnosis.starts import settle
from garat_jax.effects import GravityScale, JointStiffness, TorqueOffset, ViscousDamping
from tests.diagnosis.test_fit import UNIFORM, make_problem, record

EFFECTS = [
    TorqueOffset("joint/hinge"),
    GravityScale("world"),
    JointStiffness("joint/hinge"),
    ViscousDamping("joint/hinge"),
]
OFFSET, GRAVITY, STIFFNESS, REFERENCE, DAMPING = range(5)
UP, DOWN, SLOWER, NEARER = np.eye(4)


class OfForce:
    """What a force up changes, and one down, which lifts something off the ground; and a spring.

    The spring does what a force up does if its reference is 0.3, and something else if not.
    """

    def change(self, thetas: np.ndarray) -> np.ndarray:
        force = thetas[:, OFFSET] - 2.0 * (thetas[:, GRAVITY] - 1.0)
        is_force = thetas[:, REFERENCE] == 0.3
        force += np.where(is_force, thetas[:, STIFFNESS], 0.0)
        change = np.outer(np.maximum(force, 0.0), UP) + np.outer(np.minimum(force, 0.0), DOWN)
        change += np.outer(np.where(is_force, 0.0, thetas[:, STIFFNESS]), NEARER)
        return (change + np.outer(thetas[:, DAMPING], SLOWER)).T


def scored(effect: int, sizes: dict[int, float], contribution: np.ndarray) -> Score:
    columns, size = tuple(sizes), tuple(sizes.values())
    return Score(effect, columns, size, {}, 0.5, 0.0, True, np.asarray(contribution))


UPWARD = scored(0, {OFFSET: 1.0}, UP)


@pytest.fixture
def found(monkeypatch):
    problem = make_problem([record(UNIFORM)], EFFECTS)
    current = settle(problem, problem.simulator.base, problem.segments.start)
    monkeypatch.setattr(alike, "gather", lambda *_: (None, OfForce(), np.ones(4)))

    def found(offset: float, *others: Score) -> list[int]:
        """Return the columns of what is like an offset that was fitted at a size."""
        theta = current.theta.copy()
        theta[OFFSET] = offset
        fitted = dataclasses.replace(current, theta=theta, free=(OFFSET,))
        return [s.columns[0] for s in alike_as_fitted(problem, current, UPWARD, fitted, others)]

    return found


def test_a_force_that_was_screened_in_the_other_direction_is_alike(found):
    others = [scored(1, {GRAVITY: 1.1}, -0.2 * DOWN), scored(3, {DAMPING: 0.1}, 0.1 * SLOWER)]
    assert found(-5.0, *others) == [GRAVITY]
    assert found(5.0, *others) == []


def test_a_force_that_was_expected_to_do_what_the_other_direction_does_is_alike(found):
    assert found(5.0, scored(1, {GRAVITY: 0.9}, 0.2 * DOWN)) == [GRAVITY]


def test_only_what_switches_a_law_on_is_enlarged(found):
    spring = scored(2, {STIFFNESS: 1.0, REFERENCE: 0.3}, SLOWER)
    assert found(4.0, spring) == [STIFFNESS]


def test_what_is_screened_as_alike_is_alike(found):
    assert found(0.0, scored(1, {GRAVITY: 1.1}, UP + 0.1 * DOWN)) == [GRAVITY]
