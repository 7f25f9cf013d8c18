"""What is added where no candidate passes by itself, by what each leads to with another."""

import dataclasses

import numpy as np
import pytest

from garat_jax.diagnosis import ahead
from garat_jax.diagnosis.ahead import choose
from garat_jax.diagnosis.contend import Contender
from garat_jax.diagnosis.findings import Candidate, Interval, Named
from garat_jax.diagnosis.judge import NO_CERTAIN_GAIN, NO_CERTAIN_LEAD
from garat_jax.diagnosis.metric import make_metric
from garat_jax.diagnosis.screen import Score
from garat_jax.diagnosis.starts import settle
from garat_jax.effects import (
    AsymmetricFriction,
    CoulombFriction,
    GravityScale,
    TorqueOffset,
    ViscousDamping,
)
from tests.diagnosis.test_fit import make_problem, record

TIME = np.arange(800) / 200.0
EFFECTS = [
    ViscousDamping("joint/hinge"),
    GravityScale("world"),
    TorqueOffset("joint/hinge"),
    CoulombFriction("joint/hinge"),
    AsymmetricFriction("joint/hinge"),
]
DAMPING, GRAVITY, OFFSET, FRICTION, ASYMMETRIC = range(len(EFFECTS))
PASSES = "passes every gate"


@pytest.fixture(scope="module")
def problem():
    problem = make_problem([record(TIME), record(TIME)], EFFECTS)
    fitted = np.arange(len(problem.fitted)) < len(problem.fitted) // 2
    return dataclasses.replace(problem, fitted=fitted)


def chosen(
    problem,
    second_of_damping: dict[int, float],
    second_of_gravity: dict[int, float],
    why: str = NO_CERTAIN_LEAD,
    num_held: int = 0,
    why_first: str = NO_CERTAIN_GAIN,
    like_gravity: tuple[Named, ...] = (),
    like_second: tuple[Named, ...] = (),
    more: tuple[int, ...] = (),
    why_gravity: str = NO_CERTAIN_LEAD,
    why_beside_gravity: str | None = None,
):
    """Choose where damping, gravity and an offset explain 20, 19 and 18 % each by itself.

    Args:
        problem: What is fitted.
        second_of_damping: What the best effect beside damping leaves of the residual.
        second_of_gravity: And beside gravity. Beside the offset nothing passes.
        why: What is said of these.
        num_held: How many effects are said to be selected.
        why_first: What is said of damping.
        like_gravity: What is not told from gravity.
        like_second: What is not told from the best effect beside gravity.
        why_gravity: What is said of gravity.
        why_beside_gravity: What is said of the best effect beside it, if not `why`.
        more: Parameters that are free beside damping, besides its own and the best effect's.
    """
    current = settle(problem, problem.simulator.base, problem.segments.start)
    residual = np.random.default_rng(0).normal(size=current.residual.shape)
    current = dataclasses.replace(current, residual=residual)

    def pair(effect: int, left: float, why: str) -> tuple[Candidate, Contender]:
        contribution = np.random.default_rng(effect).normal(size=residual.size)
        score = Score(effect, (effect,), (0.1,), {}, 0.9, 1e-9, True, contribution)
        free = (*current.free, effect)
        fit = dataclasses.replace(current, residual=left * residual, free=free)
        passes = why == PASSES
        law, none = EFFECTS[effect], Interval(0.0, 0.0, 0.0)
        candidate = Candidate(law.kind, law.target, {}, 0.1, 0.0, 0.0, none, 0.5, (), passes, why)
        return candidate, Contender(score, fit)

    seconds = {DAMPING: second_of_damping, GRAVITY: second_of_gravity}

    def follow(held, contender: Contender):
        beside = seconds.get(contender.score.effect)
        if beside is None:
            return [pair(DAMPING, 0.8, NO_CERTAIN_GAIN)]
        is_gravity = contender.score.effect == GRAVITY
        said = why_beside_gravity if is_gravity and why_beside_gravity else why
        second = [pair(effect, left, said) for effect, left in beside.items()]
        if contender.score.effect == DAMPING:
            return [(c, _with_more_free(k, more)) for c, k in second]
        alike = [dataclasses.replace(c, indistinguishable_from=like_second) for c, _ in second]
        return [(c, k) for c, (_, k) in zip(alike, second, strict=True)]

    judged = [
        pair(DAMPING, 0.80, why_first),
        pair(GRAVITY, 0.81, why_gravity),
        pair(OFFSET, 0.82, NO_CERTAIN_LEAD),
    ]
    gravity, fitted = judged[GRAVITY]
    gravity = dataclasses.replace(gravity, indistinguishable_from=like_gravity)
    judged[GRAVITY] = gravity, fitted
    metric = make_metric(problem)
    say = [].append
    judged, steps = choose(problem, metric, current, judged, [*range(num_held)], follow, say)
    return judged[0][0], [step.candidate.named for step in steps]


def _with_more_free(contender: Contender, more: tuple[int, ...]) -> Contender:
    fit = dataclasses.replace(contender.fit, free=(*contender.fit.free, *more))
    return dataclasses.replace(contender, fit=fit)


def named(effect: int) -> Named:
    return Named(EFFECTS[effect].kind, EFFECTS[effect].target)


def followed(problem, order: tuple[int, ...], why_first: str, paired: int) -> list[int]:
    """Return from which of some candidates is looked ahead, of which one is paired."""
    current = settle(problem, problem.simulator.base, problem.segments.start)

    def pair(effect: int) -> tuple[Candidate, Contender]:
        law, none = EFFECTS[effect], Interval(0.0, 0.0, 0.0)
        why = why_first if effect == order[0] else NO_CERTAIN_LEAD
        what = (law.kind, law.target, {}, 0.1, 0.0, 0.0, none, 0.5, (), why == PASSES, why)
        score = Score(effect, (effect,), (0.1,), {}, 0.9, 1e-9, True, np.zeros(0))
        return Candidate(*what), Contender(score, current, is_paired=effect == paired)

    seen = []

    def follow(held, contender: Contender):
        seen.append(contender.score.effect)
        return []

    judged = [pair(effect) for effect in order]
    choose(problem, make_metric(problem), current, judged, [], follow, [].append)
    return seen


@pytest.mark.parametrize(
    ("why_first", "paired", "expected"),
    [
        (NO_CERTAIN_LEAD, -1, [DAMPING, GRAVITY, OFFSET]),
        (NO_CERTAIN_LEAD, FRICTION, [DAMPING, GRAVITY, OFFSET, FRICTION]),
        (NO_CERTAIN_LEAD, GRAVITY, [DAMPING, GRAVITY, OFFSET]),
        (PASSES, FRICTION, [FRICTION]),
        (PASSES, DAMPING, []),
    ],
)
def test_what_is_paired_is_looked_ahead_from_as_well(problem, why_first, paired, expected):
    order = (DAMPING, GRAVITY, OFFSET, FRICTION)
    assert followed(problem, order, why_first, paired) == expected


@pytest.mark.parametrize("paired", [DAMPING, GRAVITY])
def test_from_a_law_that_the_first_refines_is_looked_ahead_once(problem, paired):
    order = (ASYMMETRIC, DAMPING, GRAVITY)
    assert followed(problem, order, PASSES, paired) == list(dict.fromkeys([DAMPING, paired]))


def test_beside_a_rival_there_may_be_nothing_else(problem):
    assert chosen(problem, {OFFSET: 0.3}, {})[1] == [named(DAMPING)]


def test_a_path_that_leads_the_others_makes_its_first_pass(problem):
    first, added = chosen(problem, {OFFSET: 0.3}, {OFFSET: 0.5})
    assert added == [named(DAMPING)]
    assert first.passes and first.why.endswith("together with torque_offset at joint/hinge")


@pytest.mark.parametrize(
    ("of_damping", "of_gravity"),
    [({OFFSET: 0.30}, {DAMPING: 0.301}), ({OFFSET: 0.301}, {DAMPING: 0.30})],
)
def test_what_all_paths_share_that_none_leads_is_added(problem, of_damping, of_gravity):
    first, added = chosen(problem, of_damping, of_gravity)
    assert added == [named(DAMPING)]
    assert first.passes
    assert "torque_offset" in first.why and "gravity_scale" in first.why


def test_what_all_paths_have_second_is_added_with_a_first_that_is_not_told_from_the_others(problem):
    first, added = chosen(problem, {FRICTION: 0.3}, {FRICTION: 0.301}, PASSES)
    assert added == [named(DAMPING), named(FRICTION)]
    assert first.passes and first.indistinguishable_from == (named(GRAVITY),)
    assert first.why == "passes every gate together with coulomb_friction at joint/hinge"


def test_what_is_not_told_from_another_first_is_not_told_from_the_best_either(problem):
    like = (named(OFFSET),)
    first, added = chosen(problem, {FRICTION: 0.3}, {FRICTION: 0.301}, PASSES, like_gravity=like)
    assert added == [named(DAMPING), named(FRICTION)]
    assert first.indistinguishable_from == (named(GRAVITY), named(OFFSET))


def test_what_all_paths_have_second_is_not_added_where_it_does_not_pass(problem):
    first, added = chosen(problem, {FRICTION: 0.3}, {FRICTION: 0.301}, NO_CERTAIN_LEAD)
    assert added == []
    assert not first.passes


@pytest.mark.parametrize(
    "less_sure",
    [
        {"why_gravity": "not significant (corrected p = 1)"},
        {"why_beside_gravity": NO_CERTAIN_LEAD},
    ],
)
def test_a_path_that_is_less_sure_is_not_taken_for_its_few_parameters(
    problem, monkeypatch, less_sure
):
    monkeypatch.setattr("garat_jax.diagnosis.judge.is_above", lambda *of: False)
    like = {"like_gravity": (named(OFFSET),), "like_second": (named(DAMPING),)}
    seconds = {OFFSET: 0.3}, {FRICTION: 0.301}
    _, added = chosen(problem, *seconds, PASSES, more=(FRICTION,), **less_sure, **like)
    assert added == [named(DAMPING)]


@pytest.mark.parametrize("leaves_noise", [True, False])
def test_of_paths_that_leave_no_more_than_noise_the_one_with_the_fewest_parameters_counts(
    problem, monkeypatch, leaves_noise
):
    """Gravity and friction do what damping and an offset do, with a parameter less."""
    monkeypatch.setattr("garat_jax.diagnosis.judge.is_above", lambda *of: not leaves_noise)
    like = {"like_gravity": (named(OFFSET),), "like_second": (named(DAMPING),)}
    _, added = chosen(problem, {OFFSET: 0.3}, {FRICTION: 0.301}, PASSES, more=(FRICTION,), **like)
    assert added == ([named(GRAVITY), named(FRICTION)] if leaves_noise else [named(DAMPING)])


def test_nothing_is_added_where_no_path_leads_and_they_share_nothing(problem):
    first, added = chosen(problem, {OFFSET: 0.3}, {FRICTION: 0.301})
    assert added == []
    assert not first.passes


def test_of_rivals_that_are_alike_one_is_followed():
    def candidate(effect: int, *equals: int) -> Candidate:
        law, none = EFFECTS[effect], Interval(0.0, 0.0, 0.0)
        alike = tuple(named(other) for other in equals)
        return Candidate(law.kind, law.target, {}, 0.1, 0.0, 0.0, none, 0.5, alike, False, "")

    rivals = [candidate(DAMPING, GRAVITY), candidate(OFFSET, FRICTION)]
    like_them = [candidate(FRICTION, OFFSET), candidate(GRAVITY, DAMPING)]
    kept = ahead._one_of_each([(c, None) for c in (*rivals, *like_them)])
    assert [c for c, _ in kept] == rivals


@pytest.mark.parametrize(("num_held", "is_looking"), [(0, True), (1, True), (2, False)])
def test_beside_two_effects_rivals_are_not_followed(problem, num_held, is_looking):
    first, added = chosen(problem, {OFFSET: 0.3}, {OFFSET: 0.5}, num_held=num_held)
    assert first.passes == bool(added) == is_looking


def test_beside_two_effects_a_law_that_the_first_refines_is_still_followed(problem, monkeypatch):
    monkeypatch.setattr(ahead, "refines", lambda problem, one, other: other == GRAVITY != one)
    monkeypatch.setattr(ahead, "is_above", lambda *of: True)
    _, added = chosen(problem, {}, {OFFSET: 0.3}, num_held=2, why_first=PASSES)
    assert added[0] == named(GRAVITY)
