"""A law that refines another is named where it explains more, and not where it does not."""

import dataclasses
import functools

import numpy as np
import pytest

from garat_jax.diagnosis import rivals
from garat_jax.diagnosis.contend import Contender
from garat_jax.diagnosis.diagnose import diagnose
from garat_jax.diagnosis.findings import Candidate, Interval
from garat_jax.diagnosis.fit import fit
from garat_jax.diagnosis.metric import make_metric, noise_floor
from garat_jax.diagnosis.rank import _select
from garat_jax.diagnosis.rivals import unled
from garat_jax.diagnosis.screen import Score
from garat_jax.diagnosis.starts import Fit, settle
from garat_jax.diagnosis.steps import Step
from garat_jax.effects import CATALOGUE, AsymmetricFriction, CoulombFriction, StribeckFriction
from tests import models
from tests.diagnosis.pendulum import MODEL, record
from tests.diagnosis.test_fit import make_problem

KINDS = ("coulomb_friction", "viscous_damping", "stribeck_friction", "asymmetric_friction")
STATIC, COULOMB, SPEED = 0.15, 0.08, 0.4


def weakening(speed: float) -> float:
    """Return what friction loses in motion [N m]; the joint has its static size."""
    return (STATIC - COULOMB) * np.sign(speed) * (1.0 - np.exp(-((speed / SPEED) ** 2)))


def found_with(friction: float, torque):
    model = dataclasses.replace(MODEL, catalogue={kind: CATALOGUE[kind] for kind in KINDS})

    def rub(spec):
        spec.joint("hinge").frictionloss = friction

    return diagnose(model, [record(rub, seed, torque=torque) for seed in range(4)])


@pytest.mark.slow  # nine minutes
def test_a_peak_at_rest_is_stribeck_friction():
    (found,) = found_with(STATIC, weakening).selected
    assert found.effect == "stribeck_friction"
    assert found.parameters["coulomb"].estimate == pytest.approx(COULOMB, rel=0.1)


def test_constant_dry_friction_is_not_refined():
    (found,) = found_with(COULOMB, lambda speed: 0.0).selected
    assert found.effect == "coulomb_friction"
    assert found.parameters["torque"].estimate == pytest.approx(COULOMB, rel=0.05)


def test_a_parameter_that_explains_little_is_fitted_all_the_same():
    drag = 0.0015  # N m s/rad in the direction in which most of the friction is dry

    def law(speed: float) -> float:
        return -0.04 - (drag if speed > 0 else 20 * drag) * speed

    (found,) = found_with(0.08, law).selected
    assert found.effect == "asymmetric_friction"
    estimate = found.parameters["viscous_positive"]
    assert 0.0 < estimate.low <= drag <= estimate.high


def test_damping_with_a_little_dry_friction_is_not_called_asymmetric():
    model = dataclasses.replace(MODEL, catalogue={kind: CATALOGUE[kind] for kind in KINDS})

    def rub(spec):
        spec.joint("hinge").damping[0] += 0.02
        spec.joint("hinge").frictionloss = 0.01

    found = diagnose(model, [record(rub, seed) for seed in range(4)])
    assert found.selected[0].effect == "viscous_damping"
    assert "asymmetric_friction" not in [c.effect for c in found.selected]


def test_two_simple_laws_come_before_one_that_does_less_than_both():
    """Beside the dry friction that the model has, a pull makes friction of one direction."""
    kinds = ("torque_offset", "viscous_damping", "asymmetric_friction")

    def rub(spec, damping: float = 0.0):
        spec.joint("hinge").frictionloss = 0.15
        spec.joint("hinge").damping[0] += damping

    spec = MODEL.spec.copy()
    rub(spec)
    catalogue = {kind: CATALOGUE[kind] for kind in kinds}
    model = dataclasses.replace(MODEL, spec=spec, catalogue=catalogue)
    damped = functools.partial(rub, damping=0.02)
    found = diagnose(model, [record(damped, seed, pull=-0.04) for seed in range(4)])
    sizes = {c.effect: next(iter(c.parameters.values())).estimate for c in found.selected}
    assert sizes == {
        "viscous_damping": pytest.approx(0.02, rel=0.02),
        "torque_offset": pytest.approx(-0.04, rel=0.02),
    }


def test_damping_is_refined_whatever_name_it_was_fitted_under():
    kinds = ("back_emf", "viscous_damping", "asymmetric_friction")
    spec = models.spec(models.PENDULUM.replace("Euler", "implicitfast"))
    catalogue = {kind: CATALOGUE[kind] for kind in kinds}
    model = dataclasses.replace(MODEL, spec=spec, catalogue=catalogue)

    def rub(speed: float) -> float:
        return -(0.004 if speed > 0 else 0.04) * speed

    found = diagnose(model, [record(lambda spec: None, seed, torque=rub) for seed in range(4)])
    assert [c.effect for c in found.selected] == ["asymmetric_friction"]


def test_a_law_found_before_gives_way_to_its_refinement():
    laws = (CoulombFriction("joint/hinge"), AsymmetricFriction("joint/hinge"))
    coulomb, positive, negative = 0, 1, 2

    def rub(spec):
        spec.joint("hinge").frictionloss = 0.08

    def more(speed: float) -> float:  # where speed is negative; the other sign needs no exchange
        return 0.04 * (speed < 0)

    problem = make_problem([record(rub, seed, torque=more) for seed in range(2)], laws)
    starts = problem.segments.start
    problem = dataclasses.replace(problem, fitted=np.arange(len(starts)) % 4 > 0)
    found = fit(problem, problem.simulator.base, starts, (coulomb,))
    step = step_of(laws[0], found)
    floor = noise_floor(problem, make_metric(problem), found)
    selected = _select(problem, found, floor, [step], lambda line: None)
    assert [step.candidate.effect for step in selected.steps] == ["asymmetric_friction"]
    assert selected.fit.theta[coulomb] == 0.0
    assert coulomb not in selected.fit.free
    assert selected.fit.theta[positive] == pytest.approx(0.08, rel=0.1)
    assert selected.fit.theta[negative] == pytest.approx(0.12, rel=0.1)


@pytest.mark.parametrize(("peak", "named"), [(0.0, []), (0.02, ["stribeck_friction"])])
def test_a_peak_at_rest_that_explains_hardly_more_is_named_as_equal(peak, named):
    laws = (CoulombFriction("joint/hinge"), StribeckFriction("joint/hinge"))

    def rub(spec):
        spec.joint("hinge").frictionloss = 0.08 + peak

    def less(speed: float) -> float:
        return peak * np.sign(speed) * (1.0 - np.exp(-((speed / 0.3) ** 2)))

    problem = make_problem([record(rub, seed, torque=less) for seed in range(2)], laws)
    starts = problem.segments.start
    problem = dataclasses.replace(problem, fitted=np.arange(len(starts)) % 4 > 0)
    found = fit(problem, problem.simulator.base, starts, (0,))
    step = step_of(laws[0], found)
    (step,) = rivals.with_refinements(problem, [step], found, lambda line: None)
    assert [n.effect for n in step.candidate.indistinguishable_from] == named
    assert [candidate.effect for candidate, _ in step.alike] == named
    for candidate, contender in step.alike:
        static = candidate.parameters["static"]
        assert static.low < 0.08 + peak < static.high
        assert contender.fit.cost.sum() < found.cost.sum()
        assert candidate.share > step.candidate.share


def step_of(law, found: Fit) -> Step:
    """Return the step that added a law whose parameter is the first."""
    nan = float("nan")
    score = Score(0, (0,), (0.1,), {}, 0.5, 0.0, True, np.zeros(0))
    gain = Interval(nan, nan, nan)
    named = Candidate(law.kind, law.target, {}, 0.5, 0.0, nan, gain, 1.0, (), True, "")
    return Step(named, Contender(score, found), found, [])


def test_rivals_are_the_best_and_those_that_it_does_not_lead_once_each():
    problem = make_problem([record(lambda spec: None, seed) for seed in range(2)], [])
    settled = settle(problem, problem.simulator.base, problem.segments.start)
    score = Score(0, (), (), {}, 0.5, 0.0, True, np.zeros(0))

    def leaves(times: float) -> Contender:
        return Contender(score, dataclasses.replace(settled, residual=times * settled.residual))

    best, near, far = leaves(1.0), leaves(1.01), leaves(2.0)
    twin = dataclasses.replace(near, score=dataclasses.replace(score, effect=1))
    rivals = unled(problem, best, [far, near, twin, best])
    assert len(rivals) == 2
    assert rivals[0] is best
    assert rivals[1].fit is near.fit
