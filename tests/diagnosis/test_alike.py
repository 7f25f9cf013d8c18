"""Candidates that do the same at the size at which one was fitted, and not at those screened."""

import dataclasses

import numpy as np
import pytest

from benchmarks.hidden.generate import Surveys, draw, generate, list_cases
from garat_jax.diagnosis import alike, contend, diagnose, load_model
from garat_jax.diagnosis.alike import alike_as_fitted, with_alike
from garat_jax.diagnosis.compare import read_recordings
from garat_jax.diagnosis.contend import Contender, fit_contenders
from garat_jax.diagnosis.screen import Score
from garat_jax.diagnosis.starts import settle
from garat_jax.effects import (
    AsymmetricFriction,
    CoulombFriction,
    GravityScale,
    JointStiffness,
    TorqueOffset,
    ViscousDamping,
)
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
    """What a force up changes, and one down, which lifts something off the ground; and others.

    A spring does what a force up does if its reference is 0.3, and something else if not; so does
    a damping beyond 1.
    """

    def change(self, thetas: np.ndarray) -> np.ndarray:
        force = thetas[:, OFFSET] - 2.0 * (thetas[:, GRAVITY] - 1.0)
        is_force = thetas[:, REFERENCE] == 0.3
        force += np.where(is_force, thetas[:, STIFFNESS], 0.0)
        change = np.outer(np.maximum(force, 0.0), UP) + np.outer(np.minimum(force, 0.0), DOWN)
        change += np.outer(np.where(is_force, 0.0, thetas[:, STIFFNESS]), NEARER)
        damping = thetas[:, DAMPING]
        change += np.outer(np.maximum(damping - 1.0, 0.0), UP)
        return (change + np.outer(np.minimum(damping, 1.0), SLOWER)).T


def scored(effect: int, sizes: dict[int, float], contribution: np.ndarray) -> Score:
    columns, size = tuple(sizes), tuple(sizes.values())
    start = {columns[0]: size[0]}
    return Score(effect, columns, size, start, 0.5, 0.0, True, np.asarray(contribution))


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
        as_screened, as_fitted = alike_as_fitted(problem, current, UPWARD, fitted, others)
        return [s.columns[0] for s in as_screened], [s.start for s in as_fitted]

    return found


def test_a_force_that_was_screened_in_the_other_direction_is_alike(found):
    others = [scored(1, {GRAVITY: 1.1}, -0.2 * DOWN), scored(3, {DAMPING: 0.01}, 0.01 * SLOWER)]
    assert found(-0.5, *others) == ([], [{GRAVITY: pytest.approx(1.25)}])
    assert found(0.5, *others) == ([], [])


def test_a_force_that_was_expected_to_do_what_the_other_direction_does_is_alike(found):
    gravity = scored(1, {GRAVITY: 0.9}, 0.2 * DOWN)
    assert found(0.5, gravity) == ([], [{GRAVITY: pytest.approx(0.75)}])


def test_only_what_switches_a_law_on_is_enlarged(found):
    spring = scored(2, {STIFFNESS: 1.0, REFERENCE: 0.3}, SLOWER)
    assert found(4.0, spring) == ([], [{STIFFNESS: pytest.approx(4.0), REFERENCE: 0.3}])


def test_the_size_at_which_one_changes_as_much_is_sought_twice(found):
    assert found(5.0, scored(3, {DAMPING: 0.1}, SLOWER)) == ([], [{DAMPING: pytest.approx(5.0)}])


def test_what_is_screened_as_alike_is_alike(found):
    assert found(0.0, scored(1, {GRAVITY: 1.1}, UP + 0.1 * DOWN)) == ([GRAVITY], [])


@pytest.fixture
def fits(monkeypatch):
    """Fit candidates by saying what they leave; what each began from is kept."""
    problem = make_problem([record(UNIFORM)], [TorqueOffset("joint/hinge") for _ in range(6)])
    current = settle(problem, problem.simulator.base, problem.segments.start)
    left, began = {0: 0.8, 1: 0.7, 2: 0.5, 3: 0.6, 4: 0.9, 5: 0.5}, {}

    def fit(problem, current, score, rival, say):
        began[score.effect] = current
        residual, theta = left[score.effect] * current.residual, current.theta.copy()
        theta[list(score.columns)] = 1.0
        start, free = current.start + score.effect, (*current.free, *score.columns)
        moved = {"theta": theta, "residual": residual, "start": start, "free": free}
        return Contender(score, dataclasses.replace(current, **moved))

    monkeypatch.setattr(contend, "fit_one", fit)
    monkeypatch.setattr(alike, "fit_one", fit)
    return problem, current, began


AXES = np.eye(6)
JUMP = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 100.0])
"""Few samples make it, as where a foot lifts off."""


def likely(effect: int, share: float, contribution: np.ndarray) -> Score:
    columns, size = (effect,), (1.0,)
    return Score(effect, columns, size, {effect: 1.0}, share, 0.0, True, contribution)


def test_what_is_like_the_one_that_fits_best_is_fitted_wherever_it_was_placed(fits, monkeypatch):
    problem, current, began = fits
    scores = [likely(i, 0.9 - 0.1 * i, AXES[i]) for i in range(4)]
    scores += [likely(4, 0.1, AXES[4]), likely(5, 0.3, AXES[2] + 0.01 * AXES[4])]
    first = fit_contenders(problem, current, (), scores, print)
    assert [contender.score.effect for contender in first] == [0, 1, 2, 3]
    asked = []

    def as_screened(problem, current, score, fitted, others):
        asked.extend(other.effect for other in others)
        return scores[5:], []

    monkeypatch.setattr(alike, "alike_as_fitted", as_screened)
    every = with_alike(problem, current, scores, first, print)
    assert [contender.score.effect for contender in every] == [0, 1, 2, 3, 5]
    assert asked == [5]
    assert began[5] is current
    assert with_alike(problem, current, scores, [], print) == []


@pytest.mark.parametrize("again", [0.4, 0.9])
def test_what_does_the_same_in_contact_begins_where_the_best_one_ended(fits, monkeypatch, again):
    problem, current, began = fits
    scores = [likely(0, 0.9, AXES[0]), likely(1, 0.8, JUMP), likely(2, 0.7, AXES[2])]
    scores.append(likely(3, 0.01, JUMP[[0, 1, 2, 3, 5, 4]]))
    first = fit_contenders(problem, current, (), scores, print)
    best = first[2]
    monkeypatch.setattr(alike, "alike_as_fitted", lambda *given: ([], given[-1]))

    def refit(problem, near, score, rival, say):
        began[score.effect] = near
        moved = {"residual": again * current.residual, "free": (9,)}
        return Contender(score, dataclasses.replace(near, **moved))

    monkeypatch.setattr(alike, "fit_one", refit)
    every = with_alike(problem, current, scores, first, print)
    assert sorted(c.score.effect for c in every) == [0, 1, 2, 3]
    refitted = {c.score.effect for c in every if c.fit.free == (9,)}
    assert refitted == ({1, 3} if again < 0.7 else {3})
    for effect in (1, 3):
        assert np.array_equal(began[effect].start, best.fit.start)
        assert began[effect].theta[2] == 0.0
        assert began[effect].free == ()


def test_a_law_that_refines_one_that_was_added_is_not_fitted_beside_it(monkeypatch):
    laws = [CoulombFriction("joint/hinge"), AsymmetricFriction("joint/hinge")]
    problem = make_problem([record(UNIFORM)], [*laws, GravityScale("world")])
    current = settle(problem, problem.simulator.base, problem.segments.start)
    current = dataclasses.replace(current, free=(0,))
    scores = [likely(2, 0.9, AXES[0]), dataclasses.replace(likely(1, 0.01, JUMP), columns=(1,))]
    best, asked = Contender(scores[0], current), []
    monkeypatch.setattr(alike, "set_aside", lambda *given: current)
    monkeypatch.setattr(alike, "alike_as_fitted", lambda *g: (asked.extend(g[-1]) or [], []))
    for free, num in (((0,), 0), ((), 1)):
        asked.clear()
        near = dataclasses.replace(current, free=free)
        with_alike(problem, near, scores, [best], print)
        assert len(asked) == num


def test_the_other_names_of_a_fit_that_was_bettered_go_with_it(fits, monkeypatch):
    problem, current, _ = fits
    scores = [likely(0, 0.9, AXES[0]), likely(1, 0.8, JUMP), likely(2, 0.7, AXES[2])]
    best, old = (contend.fit_one(problem, current, scores[i], np.inf, print) for i in (2, 1))
    name = dataclasses.replace(old, score=dataclasses.replace(old.score, effect=4))
    better = dataclasses.replace(old.fit, residual=0.1 * current.residual)
    monkeypatch.setattr(alike, "alike_as_fitted", lambda *given: ([], given[-1]))
    monkeypatch.setattr(alike, "fit_one", lambda *given: Contender(given[2], better))
    every = with_alike(problem, current, scores, [best, old, name], print, in_contact=True)
    assert [(c.score.effect, c.fit is better) for c in every] == [(2, False), (1, True)]


@pytest.mark.slow
def test_gravity_is_not_taken_for_a_force_along_the_rail_of_a_leg_that_hops(tmp_path):
    name = "gravity_scale-medium"
    scenes = Surveys()
    truth = draw(next(case for case in list_cases(15) if case.name == name), scenes)
    *paths, last = generate(truth, scenes[truth.robot], tmp_path)
    model = load_model(tmp_path / f"{truth.robot}.xml")
    found = diagnose(model, read_recordings(model, paths), read_recordings(model, [last]))
    (gravity,) = found.selected
    assert gravity.effect == "gravity_scale"
    scale = gravity.parameters["scale"]
    assert scale.low < truth.secrets[0]["scale"] < scale.high
