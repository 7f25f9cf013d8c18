"""Several effects are added at once where none passes by itself and all together explain all."""

import dataclasses

import numpy as np
import pytest

from garat_jax.diagnosis.ahead import choose
from garat_jax.diagnosis.contend import Contender
from garat_jax.diagnosis.findings import Candidate, Interval
from garat_jax.diagnosis.fit import fit
from garat_jax.diagnosis.judge import NO_CERTAIN_GAIN
from garat_jax.diagnosis.metric import make_metric
from garat_jax.diagnosis.screen import Score
from garat_jax.diagnosis.starts import settle
from garat_jax.effects import CoulombFriction, GravityScale, TorqueOffset, ViscousDamping
from tests.diagnosis.pendulum import record
from tests.diagnosis.test_fit import make_problem

LAWS = [
    ViscousDamping("joint/hinge"),
    GravityScale("world"),
    CoulombFriction("joint/hinge"),
    TorqueOffset("joint/hinge"),
]
DAMPING, GRAVITY, FRICTION, OFFSET = range(len(LAWS))
PASSES = "passes every gate"


def problem_of(everywhere, in_fitted):
    """Return two recordings' problem, of which the second is held out."""

    def hide(spec):
        everywhere(spec)
        in_fitted(spec)

    problem = make_problem([record(hide, 0), record(everywhere, 1)], LAWS)
    return dataclasses.replace(problem, fitted=problem.segments.recording == 0)


def damp(spec):
    spec.joint("hinge").damping[0] += 0.02


def weigh_down(spec):
    spec.option.gravity[2] *= 1.2


def rub(spec):
    spec.joint("hinge").frictionloss = 0.05


def all_three(spec):
    damp(spec)
    weigh_down(spec)
    rub(spec)


def damped_and_heavy(spec):
    damp(spec)
    weigh_down(spec)


def nothing(spec):
    del spec


def added(problem, order, shares=(0.4, 0.4, 0.9, 0.9), why=NO_CERTAIN_GAIN):
    """Return what is added where effects come first in some order, the last one past every gate."""
    current = settle(problem, problem.simulator.base, problem.segments.start)

    def round_after(held, fitted):
        effects = [*held, order[len(held)]] if len(held) < len(order) else []
        if not effects:
            return []
        law, none = LAWS[effects[-1]], Interval(0.0, 0.0, 0.0)
        reason = PASSES if len(effects) == len(order) else why
        share, passes = shares[len(held)], reason == PASSES
        told = Candidate(law.kind, law.target, {}, share, 0.0, 0.0, none, 1.0, (), passes, reason)
        score = Score(effects[-1], (effects[-1],), (), {}, share, 0.0, True, np.zeros(0))
        fitted = fit(problem, fitted.theta, problem.segments.start, effects)
        return [(told, Contender(score, fitted))]

    def follow(held, contender):
        return round_after([*held, contender.score.effect], contender.fit)

    judged = round_after([], current)
    metric, told = make_metric(problem), [].append
    judged, steps = choose(problem, metric, current, judged, [], follow, told)
    assert judged[0][0].passes == bool(steps)
    return {step.effect: step for step in steps}


@pytest.fixture(scope="module")
def problem():
    return problem_of(all_three, nothing)


def test_three_that_explain_all_and_are_needed_are_added_at_once(problem):
    steps = added(problem, (DAMPING, GRAVITY, FRICTION))
    assert [*steps] == [DAMPING, GRAVITY, FRICTION]
    why = "passes every gate together with gravity_scale at world and coulomb_friction"
    assert steps[DAMPING].candidate.why.startswith(why)
    last = steps[FRICTION].fit
    np.testing.assert_allclose(last.theta[:3], [0.02, 1.2, 0.05], rtol=0.1)


def test_one_that_only_led_to_the_others_goes_again(problem):
    steps = added(problem, (OFFSET, DAMPING, GRAVITY, FRICTION))
    assert [*steps] == [DAMPING, GRAVITY, FRICTION]
    last = steps[FRICTION]
    for found in (last.fit, last.contender.fit):
        assert found.theta[OFFSET] == 0.0
        assert OFFSET not in found.free


def test_one_that_is_left_alone_had_no_rivals_and_is_not_added():
    assert not added(problem_of(rub, nothing), (OFFSET, DAMPING, FRICTION))


def test_what_leaves_more_than_noise_is_not_added(problem):
    assert not added(problem, (DAMPING, OFFSET, GRAVITY))


def test_four_that_leave_more_than_noise_are_not_followed_further(problem, monkeypatch):
    monkeypatch.setattr("garat_jax.diagnosis.ahead.AT_ONCE", 2)
    assert not added(problem, (DAMPING, GRAVITY, FRICTION))


def test_many_that_explain_little_each_are_not_added(problem):
    assert not added(problem, (DAMPING, GRAVITY, FRICTION), shares=(0.4, 0.2, 0.9))


def test_what_has_no_evidence_is_not_followed(problem):
    assert not added(problem, (DAMPING, GRAVITY, FRICTION), why="not significant")


def test_what_is_held_out_has_to_need_each():
    assert not added(problem_of(damped_and_heavy, rub), (DAMPING, GRAVITY, FRICTION))
