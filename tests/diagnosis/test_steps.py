"""What was added gives way to what fits better beside the effects found since."""

import dataclasses
import functools

import numpy as np
import pytest

from garat_jax.diagnosis.contend import Contender
from garat_jax.diagnosis.findings import Candidate, Interval, Named
from garat_jax.diagnosis.fit import fit
from garat_jax.diagnosis.horizon import choose_horizon
from garat_jax.diagnosis.judge import BEHIND
from garat_jax.diagnosis.metric import make_metric
from garat_jax.diagnosis.model_card import Model
from garat_jax.diagnosis.names import renamed
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.rank import AS_GOOD, NIL, _as_nil, _as_shown, _counted
from garat_jax.diagnosis.screen import Score, screen
from garat_jax.diagnosis.segments import choose_grid
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.diagnosis.starts import settle
from garat_jax.diagnosis.steps import Step, is_nil, prune, reconsider
from garat_jax.effects import (
    AsymmetricFriction,
    BackEmf,
    MotorGain,
    QuadraticDrag,
    TorqueOffset,
    ViscousDamping,
)
from tests import models
from tests.diagnosis.pendulum import add_damping, record

SPEC = models.spec(models.PENDULUM.replace("Euler", "implicitfast"))
MODEL = Model("pendulum", __file__, __file__, SPEC)
AT = "joint/hinge"
MOTOR = "actuator/motor"
EFFECTS = (
    QuadraticDrag(AT),
    ViscousDamping(AT),
    TorqueOffset(AT),
    MotorGain(MOTOR),
    BackEmf(MOTOR),
)
DRAG, DAMPING, OFFSET, GAIN, EMF = range(5)
DAMPED = 0.05  # N m s/rad


@pytest.fixture(scope="module")
def problem() -> Problem[Simulator]:
    damped = functools.partial(add_damping, size=DAMPED)
    recordings = [record(damped, seed, pull=0.1) for seed in range(2)]
    grid = choose_grid(recordings, 0.002)
    simulator = Simulator(MODEL, EFFECTS, grid)
    _, segments = choose_horizon(simulator, recordings, grid)
    return Problem(simulator, segments, segments.recording == 0, 0.004)


def fit_with(problem: Problem, *effects: int):
    before = settle(problem, problem.simulator.base, problem.segments.start)
    return fit(problem, problem.simulator.base, before.start, effects)


def candidate(effect: int, *alike: int) -> Candidate:
    nan = float("nan")
    named = tuple(Named(EFFECTS[i].kind, EFFECTS[i].target) for i in alike)
    gain, added = Interval(nan, nan, nan), EFFECTS[effect]
    return Candidate(added.kind, added.target, {}, 0.5, 0.0, nan, gain, 1.0, named, True, "")


def contender(problem: Problem, effect: int) -> Contender:
    score = Score(effect, (effect,), (0.0,), {}, 0.5, 0.0, True, np.zeros(0))
    return Contender(score, fit_with(problem, effect))


def reconsidered(problem: Problem, first: int, other: int | None, *later: int, named: bool = True):
    """Add an effect that did much what another does, then more; return what becomes of them.

    Args:
        problem: What is fitted.
        first: What was added.
        other: What did much the same, if anything did.
        later: What was added since.
        named: Whether the recordings could not tell the two apart then.
    """
    others = [] if other is None else [other]
    alike = [(candidate(effect), contender(problem, effect)) for effect in others]
    own = contender(problem, first)
    steps, added = [Step(candidate(first, *others[:named]), own, own.fit, alike)], [first]
    for effect in later:
        added.append(effect)
        fitted = fit_with(problem, *added)
        steps.append(Step(candidate(effect), contender(problem, effect), fitted, []))
    metric, before = make_metric(problem), steps[-1].fit
    return *reconsider(problem, metric, steps, before, lambda line: None), before


def test_an_effect_gives_way_to_one_that_it_was_like_and_that_fits_better_by_now(problem):
    steps, current, before = reconsidered(problem, DRAG, DAMPING, OFFSET)
    assert [step.effect for step in steps] == [DAMPING, OFFSET]
    assert steps[0].candidate.named == Named("viscous_damping", AT)
    assert steps[0].candidate.passes
    assert steps[0].candidate.indistinguishable_from == ()
    assert current.cost.sum() < 0.9 * before.cost.sum()
    assert current.theta[DAMPING] == pytest.approx(DAMPED, rel=0.05)
    assert current.theta[DRAG] == 0.0
    assert steps[-1].fit is current


def test_an_effect_gives_way_to_what_comes_first_only_beside_what_was_found_since(problem):
    steps, current, _ = reconsidered(problem, DRAG, None, OFFSET)
    first, alike = steps[0].effect, steps[0].candidate.indistinguishable_from
    assert steps[1].effect == OFFSET
    assert {steps[0].candidate.named, *alike} == {
        Named("viscous_damping", AT), Named("back_emf", MOTOR)
    }  # fmt: skip
    assert steps[0].candidate.passes
    assert {*alike} <= {other.named for other, _ in steps[0].alike}
    assert current.theta[first] == pytest.approx(DAMPED, rel=0.05)
    assert current.theta[DRAG] == 0.0


def test_what_only_made_up_for_the_wrong_effect_goes_with_it(problem):
    steps, current, before = reconsidered(problem, DRAG, DAMPING, OFFSET, GAIN)
    assert [step.effect for step in steps] == [DAMPING, OFFSET]
    assert current.cost.sum() < 0.9 * before.cost.sum()
    assert current.theta[GAIN] == 1.0
    assert [float(step.fit.theta[DRAG]) for step in steps] == [0.0, 0.0]


def test_the_true_effect_stays_and_what_it_leads_by_now_is_named_no_more(problem):
    steps, current, before = reconsidered(problem, DAMPING, DRAG, OFFSET)
    assert [step.effect for step in steps] == [DAMPING, OFFSET]
    assert steps[0].candidate.indistinguishable_from == ()
    assert current is before


def test_what_cannot_be_told_from_it_beside_the_others_is_named(problem):
    """The back EMF of the only motor is the damping of its joint."""
    steps, current, before = reconsidered(problem, DAMPING, EMF, OFFSET, named=False)
    assert [step.effect for step in steps] == [DAMPING, OFFSET]
    assert steps[0].candidate.indistinguishable_from == (Named("back_emf", MOTOR),)
    assert current is before


def test_what_was_behind_alone_and_is_as_good_in_the_end_is_said_to_be(problem):
    steps, current, _ = reconsidered(problem, DAMPING, EMF, OFFSET, named=False)
    ((behind, fitted),) = steps[0].alike
    behind = dataclasses.replace(behind, passes=False, why=BEHIND)
    steps[0] = steps[0]._replace(alike=[(behind, fitted)])
    shown = _as_shown(problem, steps, current)[behind.named]
    assert shown.why == AS_GOOD
    assert shown.indistinguishable_from == (Named("viscous_damping", AT),)


def test_what_came_in_an_earlier_ones_place_is_shown_as_what_was_added(problem):
    steps, current, _ = reconsidered(problem, DAMPING, None, OFFSET)
    equal = dataclasses.replace(candidate(DAMPING), passes=False, why=BEHIND)
    later = dataclasses.replace(steps[1].candidate, indistinguishable_from=(equal.named,))
    steps[1] = steps[1]._replace(candidate=later, alike=[(equal, contender(problem, DAMPING))])
    shown = _as_shown(problem, steps, current)[equal.named]
    assert shown.passes
    assert shown.parameters["coefficient"].estimate == pytest.approx(current.theta[DAMPING])


def test_a_newcomer_is_held_against_what_it_would_replace(problem, monkeypatch):
    def drag_first(*of):
        return sorted(screen(*of), key=lambda score: score.effect != DRAG)

    monkeypatch.setattr("garat_jax.diagnosis.steps.screen", drag_first)
    steps, _, _ = reconsidered(problem, DAMPING, None, OFFSET)
    (newcomer,) = [c for c, k in steps[0].alike if k and k.score.effect == DRAG]
    assert steps[0].effect == DAMPING
    assert newcomer.why == BEHIND


def test_another_name_of_what_was_added_needs_no_fit_of_its_own(problem):
    own, other, said = contender(problem, DAMPING), contender(problem, EMF), []
    same = renamed(own.fit, (DAMPING,), (EMF,), without=problem.simulator.base)
    alike = [(candidate(EMF), dataclasses.replace(other, fit=same))]
    both = fit_with(problem, DAMPING, OFFSET)
    later = Step(candidate(OFFSET), contender(problem, OFFSET), both, [])
    steps = [Step(candidate(DAMPING), own, own.fit, alike), later]
    found, current = reconsider(problem, make_metric(problem), steps, both, said.append)
    assert said == [f"looking for what would explain more than {Named('viscous_damping', AT)}"]
    assert found[0].candidate.indistinguishable_from == (Named("back_emf", MOTOR),)
    assert current is both


def test_a_law_goes_where_one_that_refines_it_can_do_what_both_do():
    """Damping and dry friction in one direction are together less than asymmetric friction."""
    damped = functools.partial(add_damping, size=DAMPED)
    recordings = [
        record(damped, seed, torque=lambda speed: -0.08 if speed > 0 else 0.0) for seed in range(2)
    ]
    effects = (ViscousDamping(AT), AsymmetricFriction(AT))
    grid = choose_grid(recordings, 0.002)
    simulator = Simulator(MODEL, effects, grid)
    _, segments = choose_horizon(simulator, recordings, grid)
    problem = Problem(simulator, segments, np.ones(len(segments.start), bool), 0.004)
    steps, free = [], []
    names = [slot.parameter.name for slot in simulator.slots]
    for effect, name in enumerate(("coefficient", "coulomb_positive")):
        free.append(names.index(name))
        score = Score(effect, (free[-1],), (0.0,), {}, 0.5, 0.0, True, np.zeros(0))
        fitted = fit_with(problem, *free)
        added = Candidate(effects[effect].kind, AT, {}, 0.5, 0.0, 0.0, None, 1.0, (), True, "")
        steps.append(Step(added, Contender(score, fitted), fitted, []))
    (kept,), current = prune(problem, steps, steps[-1].fit, steps[:1], lambda line: None)
    assert kept.effect == 1
    assert kept.fit is current
    assert {*kept.contender.score.columns} == {*current.free} == {1, 2, 3, 4}
    found = dict(zip(names, current.theta, strict=True))
    assert found["coefficient"] == 0.0
    assert found["coulomb_positive"] == pytest.approx(0.08, rel=0.1)
    assert found["coulomb_negative"] == pytest.approx(0.0, abs=0.008)
    assert found["viscous_positive"] == pytest.approx(DAMPED, rel=0.1)
    assert found["viscous_negative"] == pytest.approx(DAMPED, rel=0.1)


def quiet(line: str) -> None:
    pass


def test_an_effect_whose_size_may_be_none_at_a_timestep_of_0_is_dropped(problem):
    every = (DAMPING, OFFSET, GAIN)  # the gain is that of the model
    added = fit_with(problem, *every)
    steps = [Step(candidate(effect), contender(problem, effect), added, []) for effect in every]
    left, counted = _counted(problem, steps, added, None, quiet)
    assert [step.effect for step in left] == [DAMPING, OFFSET]
    assert left[-1].fit is counted
    assert counted.free == (DAMPING, OFFSET)
    assert counted.theta[DAMPING] == pytest.approx(DAMPED, rel=0.05)
    assert counted.theta[GAIN] == 1.0


def test_where_nothing_is_left_the_model_stays_as_it_is():
    recordings = [record(lambda spec: None, seed) for seed in range(2)]
    grid = choose_grid(recordings, 0.002)
    simulator = Simulator(MODEL, EFFECTS, grid)
    _, segments = choose_horizon(simulator, recordings, grid)
    clean = Problem(simulator, segments, segments.recording == 0, 0.004)
    step = Step(candidate(OFFSET), contender(clean, OFFSET), fit_with(clean, OFFSET), [])
    left, counted = _counted(clean, [step], step.fit, None, quiet)
    assert left == []
    np.testing.assert_array_equal(counted.theta, simulator.base)


def test_an_interval_without_an_end_says_nothing_of_no_effect(problem):
    found = fit_with(problem, OFFSET)
    size = np.abs(found.theta[[OFFSET]])

    def within(half):
        return dataclasses.replace(found, low=size - half * size, high=size + half * size)

    assert is_nil(problem, OFFSET, within(0.6))
    assert not is_nil(problem, OFFSET, within(0.4))
    assert not is_nil(problem, OFFSET, within(np.inf))


def test_what_is_dropped_does_not_pass_and_neither_does_what_did_the_same(problem):
    own, other = candidate(OFFSET), candidate(GAIN)
    step = Step(own, contender(problem, OFFSET), fit_with(problem, OFFSET), [(other, None)])
    shown = _as_nil([step])
    assert {*shown} == {own.named, other.named}
    assert all(not c.passes and c.why == NIL for c in shown.values())
