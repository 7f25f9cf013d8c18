"""What was added gives way to what fits better beside the effects found since."""

import dataclasses
import functools

import numpy as np
import pytest

from garat_jax.diagnosis.contend import Contender
from garat_jax.diagnosis.findings import Candidate, Interval, Named
from garat_jax.diagnosis.fit import fit
from garat_jax.diagnosis.horizon import choose_horizon
from garat_jax.diagnosis.judge import BEHIND, NIL
from garat_jax.diagnosis.metric import make_metric, noise_floor
from garat_jax.diagnosis.model_card import Model
from garat_jax.diagnosis.names import renamed
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.rank import (
    AS_GOOD,
    Selection,
    _as_nothing_passed,
    _as_shown,
    _counted,
    _with_nil,
)
from garat_jax.diagnosis.screen import Score
from garat_jax.diagnosis.segments import choose_grid
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.diagnosis.starts import settle
from garat_jax.diagnosis.steps import Step, fit_equals, least_firm, prune, reconsider
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


def damped_and_pulled() -> Problem[Simulator]:
    """Return recordings of a pendulum that is damped and pulled, and the model without that."""
    damped = functools.partial(add_damping, size=DAMPED)
    recordings = [record(damped, seed, pull=0.1) for seed in range(2)]
    grid = choose_grid(recordings, 0.002)
    simulator = Simulator(MODEL, EFFECTS, grid)
    _, segments = choose_horizon(simulator, recordings, grid)
    return Problem(simulator, segments, segments.recording == 0, 0.004)


@pytest.fixture(scope="module")
def problem() -> Problem[Simulator]:
    return damped_and_pulled()


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
    steps = added(problem, first, other, *later, named=named)
    metric, before = make_metric(problem), steps[-1].fit
    return *reconsider(problem, metric, steps, before, lambda line: None), before


def added(problem: Problem, first: int, other: int | None, *later: int, named: bool = True):
    """Return the steps of effects that were added; args are those of `reconsidered`."""
    others = [] if other is None else [other]
    alike = [(candidate(effect), contender(problem, effect)) for effect in others]
    own = contender(problem, first)
    steps, effects = [Step(candidate(first, *others[:named]), own, own.fit, alike)], [first]
    for effect in later:
        effects.append(effect)
        fitted = fit_with(problem, *effects)
        steps.append(Step(candidate(effect), contender(problem, effect), fitted, []))
    return steps


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


@pytest.mark.parametrize(
    ("at_floor", "why", "gives_way"),
    [(True, "", True), (True, BEHIND, True), (False, "", False), (True, "not significant", False)],
)
def test_an_effect_gives_way_to_one_that_leaves_as_little_with_fewer_parameters(
    problem, monkeypatch, at_floor, why, gives_way
):
    """The back EMF does what the damping does; that is given the motor's gain as well here."""
    monkeypatch.setattr("garat_jax.diagnosis.judge.is_above", lambda *of: not at_floor)
    score = Score(DAMPING, (DAMPING, GAIN), (0.0, 1.0), {}, 0.5, 0.0, True, np.zeros(0))
    own = Contender(score, fit_with(problem, DAMPING, GAIN))
    both = fit_with(problem, DAMPING, GAIN, OFFSET)
    other = dataclasses.replace(candidate(EMF), passes=not why, why=why)
    first = Step(candidate(DAMPING), own, own.fit, [(other, contender(problem, EMF))])
    later = Step(candidate(OFFSET), contender(problem, OFFSET), both, [])
    metric = make_metric(problem)
    found, current = reconsider(problem, metric, [first, later], both, lambda line: None)
    assert found[0].effect == (EMF if gives_way else DAMPING)
    assert {*current.free} == ({EMF, OFFSET} if gives_way else {DAMPING, GAIN, OFFSET})
    assert found[0].candidate.why.startswith("fits as well as viscous_damping") == gives_way
    named = Named("viscous_damping", AT) if gives_way else Named("back_emf", MOTOR)
    assert named in found[0].candidate.indistinguishable_from


def test_an_effect_does_not_give_way_to_what_another_excludes(problem, monkeypatch):
    monkeypatch.setattr(
        ViscousDamping, "excludes", lambda self, other: other.kind == "torque_offset"
    )
    steps, *_ = reconsidered(problem, DRAG, DAMPING, OFFSET)
    assert steps[0].effect != DAMPING and steps[1].effect == OFFSET


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


def test_what_is_not_told_from_an_effect_is_fitted_in_its_place(problem):
    steps = added(problem, DRAG, DAMPING, OFFSET)
    (found,) = fit_equals(problem, steps, steps[-1].fit, lambda line: None)
    assert {*found.free} == {DAMPING, OFFSET}
    assert found.theta[DRAG] == 0.0
    assert found.theta[DAMPING] == pytest.approx(DAMPED, rel=0.05)


def test_what_is_told_from_an_effect_is_not_fitted_in_its_place(problem):
    steps = added(problem, DRAG, DAMPING, OFFSET, named=False)
    assert fit_equals(problem, steps, steps[-1].fit, lambda line: None) == []


def test_what_another_excludes_is_not_fitted_beside_it(problem, monkeypatch):
    monkeypatch.setattr(
        ViscousDamping, "excludes", lambda self, other: other.kind == "torque_offset"
    )
    steps = added(problem, DRAG, DAMPING, OFFSET)
    assert fit_equals(problem, steps, steps[-1].fit, lambda line: None) == []


@pytest.mark.parametrize(("first", "num_fitted"), [(DAMPING, 0), (DRAG, 1)])
def test_an_effect_is_not_fitted_again_under_another_name(problem, first, num_fitted):
    """Damping is another name of the back EMF: it needs no fit beside that."""
    damping = contender(problem, DAMPING)
    same = renamed(damping.fit, (DAMPING,), (EMF,), without=problem.simulator.base)
    emf = dataclasses.replace(contender(problem, EMF), fit=same)
    own = damping if first == DAMPING else contender(problem, first)
    alike = [(candidate(DAMPING), damping)] * (first != DAMPING) + [(candidate(EMF), emf)]
    steps = [Step(candidate(first, DAMPING, EMF), own, own.fit, alike)]
    assert len(fit_equals(problem, steps, own.fit, lambda line: None)) == num_fitted


def test_what_was_behind_alone_and_is_as_good_in_the_end_is_said_to_be(problem):
    steps, current, _ = reconsidered(problem, DAMPING, EMF, OFFSET, named=False)
    ((behind, fitted),) = [pair for pair in steps[0].alike if pair[0].effect == "back_emf"]
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


def test_another_name_of_what_was_added_needs_no_fit_of_its_own(problem):
    own, other, said = contender(problem, DAMPING), contender(problem, EMF), []
    same = renamed(own.fit, (DAMPING,), (EMF,), without=problem.simulator.base)
    alike = [(candidate(EMF), dataclasses.replace(other, fit=same))]
    both = fit_with(problem, DAMPING, OFFSET)
    later = Step(candidate(OFFSET), contender(problem, OFFSET), both, [])
    steps = [Step(candidate(DAMPING), own, own.fit, alike), later]
    found, current = reconsider(problem, make_metric(problem), steps, both, said.append)
    assert said and not any("back_emf" in line for line in said)
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


def selection(problem: Problem, *effects: int) -> Selection:
    """Return a selection of effects that were added one after the other and fitted together."""
    together = fit_with(problem, *effects)
    steps = [
        Step(candidate(effect), contender(problem, effect), together, []) for effect in effects
    ]
    floor = noise_floor(problem, make_metric(problem), together)
    return Selection(problem, steps, together, None, floor, (), None)


def test_an_effect_whose_size_may_be_none_at_a_timestep_of_0_is_dropped(problem):
    found = selection(problem, DAMPING, OFFSET, GAIN)  # the gain is that of the model
    _, steps, fitted, floor, best = _counted(found, lambda line: None)
    assert [step.effect for step in steps] == [DAMPING, OFFSET]
    assert steps[-1].fit is fitted is best
    assert fitted.free == (DAMPING, OFFSET)
    assert fitted.theta[DAMPING] == pytest.approx(DAMPED, rel=0.05)
    assert fitted.theta[GAIN] == 1.0
    assert floor is not found.floor
    assert len(found.steps) == 3


def test_where_all_is_dropped_a_model_that_was_adequate_stays_so_unless_it_errs_in_most(problem):
    recordings = [record(lambda spec: None, seed) for seed in range(2)]
    grid = choose_grid(recordings, 0.002)
    simulator = Simulator(MODEL, EFFECTS, grid)
    _, segments = choose_horizon(simulator, recordings, grid)
    clean = Problem(simulator, segments, segments.recording == 0, 0.004)
    found = selection(clean, OFFSET)
    assert _counted(found, lambda line: None)[1] == []
    for judged, was_adequate, is_adequate in (
        (clean, True, True),
        (clean, False, False),
        (problem, True, False),
    ):
        before = settle(judged, judged.simulator.base, judged.segments.start)
        at_first = ("shorter segments", None, None, was_adequate)
        said = _as_nothing_passed(judged, before, at_first)
        assert said[-1] is is_adequate
        assert (said is at_first) is is_adequate


def test_the_least_firm_effect_is_that_nearest_to_none_and_no_other(problem):
    found = selection(problem, DAMPING, OFFSET)
    size = np.abs(found.fit.theta[[DAMPING, OFFSET]])

    def least(*halves):
        half = np.array(halves) * size
        fitted = dataclasses.replace(found.fit, low=size - half, high=size + half)
        step = least_firm(problem, found.steps, fitted)
        return None if step is None else step.effect

    assert least(0.4, 0.4) is None
    assert least(0.6, 0.4) == DAMPING
    assert least(0.6, 0.9) == OFFSET
    assert least(0.6, np.inf) == DAMPING  # of the other the recordings do not say


def test_an_effect_of_several_parameters_is_not_asked_one_by_one(problem):
    grid = choose_grid([record(lambda spec: None, 0)], 0.002)
    rubbing = dataclasses.replace(
        problem, simulator=Simulator(MODEL, (AsymmetricFriction(AT),), grid)
    )
    found = fit_with(problem, DAMPING)
    score = Score(0, (0, 1), (0.0, 0.0), {}, 0.5, 0.0, True, np.zeros(0))
    step = Step(candidate(DAMPING), Contender(score, found), found, [])
    theta, ends = np.full(4, 0.1), np.ones(2)
    two = dataclasses.replace(found, theta=theta, free=(0, 1), frozen=(), low=-ends, high=ends)
    assert least_firm(rubbing, [step], two) is None
    assert least_firm(rubbing, [step], dataclasses.replace(two, frozen=(1,))) is step
    assert least_firm(rubbing, [step], dataclasses.replace(two, frozen=(0, 1))) is None


def test_what_was_dropped_does_not_pass_and_neither_does_what_is_not_told_from_it(problem):
    found = selection(problem, DAMPING, OFFSET)
    dropped = candidate(OFFSET, GAIN)
    steps = [found.steps[0], found.steps[1]._replace(candidate=dropped)]
    every = (candidate(DAMPING), dropped, candidate(GAIN), candidate(EMF))
    said = _with_nil(every, steps, steps[:1])
    assert [c.why == NIL for c in said] == [False, True, True, False]
    assert [c.passes for c in said] == [True, False, False, True]
    nothing = _with_nil(every, steps, [])
    assert not any(c.passes for c in nothing)
    assert nothing[-1].why == NIL  # it gave way to what was dropped
