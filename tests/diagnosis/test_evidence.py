"""A fit is evidence for its effect only beyond chance and beyond what a delay imitates."""

import dataclasses

import numpy as np
import pytest

from garat_jax.diagnosis.contend import Contender, with_evidence
from garat_jax.diagnosis.evidence import Evidence
from garat_jax.diagnosis.fit import fit
from garat_jax.diagnosis.metric import timestep_error
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.robust import wald_test
from garat_jax.diagnosis.screen import Score
from garat_jax.diagnosis.starts import settle
from garat_jax.effects import ActuatorDelay, EncoderOffset, Suggestion, ViscousDamping
from tests.diagnosis.test_fit import make_problem, record

TIME = np.arange(500) * 0.004
NO_NUISANCE = np.zeros((400, 0))
BLOCKS = np.repeat(np.arange(40), 10)


def evidence_for_damping(problem: Problem, num_tests: int = 1) -> float:
    """Fit damping, the first candidate, and return its p-value."""
    before = settle(problem, problem.simulator.base, problem.segments.start)
    after = fit(problem, before.theta, before.start, (0,))
    score = Score(0, (0,), (), {}, 0.0, 1.0, True, np.zeros(0))
    (tested,) = with_evidence(problem, before, [Contender(score, after)], num_tests)
    return tested.score.p_value


@pytest.mark.parametrize("others", [(), (ActuatorDelay("all"),)])
def test_damping_is_significant_where_it_is_there(others):
    problem = make_problem([record(TIME, damping=0.02)], (ViscousDamping("joint/hinge"), *others))
    fitted = np.arange(len(problem.fitted)) != 2
    assert evidence_for_damping(dataclasses.replace(problem, fitted=fitted)) < 1e-4


def test_a_fit_that_its_bound_keeps_from_an_effect_is_no_evidence():
    negative = [record(TIME, damping=-0.006)]
    problem = make_problem(negative, (ViscousDamping("joint/hinge"),))
    assert evidence_for_damping(problem) == 1.0


def test_every_candidate_that_was_tried_makes_a_p_value_larger():
    problem = make_problem([record(TIME, seed=3)], (ViscousDamping("joint/hinge"),))
    one = evidence_for_damping(problem)
    assert evidence_for_damping(problem, num_tests=3) == pytest.approx(min(1.0, 3 * one))


def test_every_size_that_was_looked_at_makes_its_own_p_value_larger():
    problem = make_problem([record(TIME, damping=0.002)], (ViscousDamping("joint/hinge"),))
    searched = dataclasses.replace(problem, suggested={0: Suggestion((), 2)})
    one = evidence_for_damping(problem)
    assert 0 < one < 0.2
    assert evidence_for_damping(searched) == pytest.approx(3 * one)
    assert searched.starts(0) == problem.starts(0)


def test_damping_is_not_significant_where_it_is_not_there():
    damping = (ViscousDamping("joint/hinge"),)
    found = [
        evidence_for_damping(make_problem([record(TIME, seed=seed)], damping)) for seed in range(8)
    ]
    assert np.median(found) > 0.1
    assert min(found) > 0.01


def test_what_a_delay_imitates_is_no_evidence_where_a_delay_is_possible():
    damping, delay = ViscousDamping("joint/hinge"), ActuatorDelay("all")
    problem = make_problem([record(TIME, delay=4)], (damping, delay))
    before = settle(problem, problem.simulator.base, problem.segments.start)
    evidence = Evidence(problem, before, np.arange(len(problem.fitted)))
    delayed = evidence.change(np.array([[0.0, 0.005]]))
    is_damping, is_delay = 0, 1
    assert evidence.p_value(is_delay, delayed) < 1e-6
    assert evidence.p_value(is_damping, delayed) > 0.01


def test_what_an_offset_of_a_sensor_imitates_is_no_evidence_but_of_what_it_is():
    damping, offset = ViscousDamping("joint/hinge"), EncoderOffset("joint/hinge")
    made = record(TIME)
    problem = make_problem([dataclasses.replace(made, qpos=made.qpos + 0.02)], (damping, offset))
    before = settle(problem, problem.simulator.base, problem.segments.start)
    evidence = Evidence(problem, before, np.arange(len(problem.fitted)))
    shifted = evidence.rest(
        problem.whiten_change(np.broadcast_to([0.02, 0.0], (1, *problem.segments.measured.shape)))
    )
    is_damping, is_offset = 0, 1
    assert evidence.p_value(is_offset, shifted) < 1e-6
    assert evidence.p_value(is_damping, shifted) > 0.01


def test_what_the_timestep_does_is_no_evidence():
    problem = make_problem([record(TIME, noise=1e-5, finer=32)], (ViscousDamping("joint/hinge"),))
    before = settle(problem, problem.simulator.base, problem.segments.start)
    evidence = Evidence(problem, before, np.arange(len(problem.fitted)))
    integrator = evidence.rest(timestep_error(problem, before)[None])
    share = (integrator[:, 0] @ evidence.residual) ** 2 / np.sum(integrator**2)
    assert share > 0.9 * np.sum(evidence.residual**2)
    assert evidence.p_value(0, integrator) > 0.01


def test_a_fit_that_changes_nothing_or_the_wrong_way_is_no_evidence():
    rng = np.random.default_rng(0)
    column, noise = rng.normal(size=(2, 400))
    right = wald_test(-column[:, None], column + noise, NO_NUISANCE, BLOCKS, 1)
    assert right < 1e-6
    assert wald_test(column[:, None], column + noise, NO_NUISANCE, BLOCKS, 1) == 1.0
    assert wald_test(np.zeros((400, 1)), column + noise, NO_NUISANCE, BLOCKS) == 1.0


@pytest.mark.parametrize(("num_fitted", "low", "high"), [(None, 0.3, 1.0), (4, 0.0, 0.1)])
def test_a_combination_that_was_fitted_is_tested_as_all_its_parameters(num_fitted, low, high):
    rng = np.random.default_rng(0)
    false = 0
    for _ in range(200):
        columns, residual = rng.normal(size=(400, 4)), rng.normal(size=400)
        best = -columns @ np.linalg.lstsq(columns, residual, rcond=None)[0]
        false += wald_test(best[:, None], residual, NO_NUISANCE, BLOCKS, num_fitted) < 0.05
    assert low < false / 200 < high
