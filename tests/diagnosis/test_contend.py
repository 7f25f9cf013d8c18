"""One law under two names is fitted once; two laws that look alike are fitted twice."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from garat_jax.diagnosis import contend, rivals
from garat_jax.diagnosis.contend import fit_contenders, with_twins
from garat_jax.diagnosis.model_card import Model
from garat_jax.diagnosis.screen import Score, screen
from garat_jax.diagnosis.starts import settle
from garat_jax.effects import BackEmf, ViscousDamping
from tests import models
from tests.diagnosis.test_fit import UNIFORM, make_problem, record

LAWS = (ViscousDamping("joint/hinge"), BackEmf("actuator/motor"))


def contenders_of(integrator: str):
    spec = models.spec(models.PENDULUM.replace("Euler", integrator))
    model = Model("pendulum", __file__, __file__, spec)
    recordings = [record(UNIFORM, damping=0.02, seed=seed) for seed in range(2)]
    problem = make_problem(recordings, LAWS, model=model)
    starts = problem.segments.start
    problem = dataclasses.replace(problem, fitted=np.arange(len(starts)) % 4 > 0)
    current, said = settle(problem, problem.simulator.base, starts), []
    scores = screen(problem, current)
    first = fit_contenders(problem, current, (), scores, said.append)
    return with_twins(problem, current, scores, first, said.append), said


def test_back_emf_is_damping_under_another_name():
    (one, other), said = contenders_of("implicitfast")
    assert len(said) == 1
    assert {one.score.effect, other.score.effect} == {0, 1}
    assert other.fit.residual is one.fit.residual
    for contender in (one, other):
        (column,) = contender.score.columns
        assert contender.fit.free == (column,)
        assert contender.fit.theta[column] == pytest.approx(0.02, rel=0.05)
        assert contender.fit.theta[1 - column] == 0.0


def test_what_the_integrator_treats_otherwise_has_a_fit_of_its_own():
    (one, other), said = contenders_of("Euler")
    assert len(said) == 2
    assert other.fit.residual is not one.fit.residual


def test_the_names_of_a_fit_go_where_more_of_its_law_explains_more(monkeypatch):
    (one, other), _ = contenders_of("implicitfast")
    fuller = dataclasses.replace(
        one, fit=dataclasses.replace(one.fit, residual=one.fit.residual / 2)
    )
    monkeypatch.setattr(rivals, "is_above", lambda *_: True)
    monkeypatch.setattr(rivals, "fit_further", lambda *_: [fuller])
    monkeypatch.setattr(rivals, "leads", lambda *_: True)
    (kept,) = rivals.fill_out(None, None, [one, other], None, print)
    assert kept is fuller


def with_error(contender, error: float, effect: int | None = None):
    """Return a contender that leaves as much as another's residual times `error`."""
    fit = dataclasses.replace(contender.fit, residual=error * contender.fit.residual)
    effect = contender.score.effect if effect is None else effect
    score = dataclasses.replace(contender.score, effect=effect)
    return dataclasses.replace(contender, fit=fit, score=score)


def test_more_of_a_law_is_tried_of_all_that_fit_as_well(monkeypatch):
    (one, other), _ = contenders_of("Euler")
    best, as_good, worse = with_error(one, 1.0), with_error(other, 1.001), with_error(one, 3.0, 2)
    fuller, tried = with_error(other, 0.5), []

    def fit_further(_, contender, say):
        tried.append(contender)
        return [fuller] if contender is as_good else []

    monkeypatch.setattr(rivals, "is_above", lambda *_: True)
    monkeypatch.setattr(rivals, "fit_further", fit_further)
    monkeypatch.setattr(rivals, "leads", lambda _, a, b: a.cost.sum() < 0.9 * b.cost.sum())
    kept = rivals.fill_out(None, None, [best, as_good, worse], None, print)
    assert [id(c) for c in tried] == [id(best), id(as_good)]
    assert [id(c) for c in kept] == [id(fuller), id(best), id(worse)]


def test_refinements_are_tried_of_all_that_fit_as_well_and_replace_no_better_fit(monkeypatch):
    (one, _), _ = contenders_of("Euler")
    best, as_good = with_error(one, 1.0, 0), with_error(one, 1.001, 1)
    worse, known = with_error(one, 3.0, 2), with_error(one, 0.9999, 3)
    of_as_good, of_known, tried = with_error(one, 0.5, 4), with_error(one, 0.92, 3), []

    def fit_refinements(problem, current, contender, scores, say, hidden_only):
        tried.append((contender, hidden_only))
        return {id(as_good): [of_as_good], id(best): [of_known]}.get(id(contender), [])

    monkeypatch.setattr(rivals, "is_above", lambda *_: True)
    monkeypatch.setattr(rivals, "fit_refinements", fit_refinements)
    monkeypatch.setattr(rivals, "leads", lambda _, a, b: a.cost.sum() < 0.8 * b.cost.sum())
    monkeypatch.setattr(rivals, "held_out_gain", lambda *_: SimpleNamespace(estimate=0.2, low=0.1))
    contenders = [best, as_good, worse, known]
    kept = rivals.refine(None, None, None, (), contenders, None, print)
    assert {id(contender) for contender, _ in tried} == {id(c) for c in (best, as_good, known)}
    assert not any(hidden_only for _, hidden_only in tried)  # none waits for another round
    assert {id(c) for c in kept} == {id(c) for c in (of_as_good, *contenders)}


def test_a_law_without_rivals_that_proves_itself_is_refined_in_the_next_round(monkeypatch):
    (one, _), _ = contenders_of("Euler")
    waits = []

    def fit_refinements(problem, current, contender, scores, say, hidden_only):
        waits.append(hidden_only)
        return []

    monkeypatch.setattr(rivals, "is_above", lambda *_: True)
    monkeypatch.setattr(rivals, "fit_refinements", fit_refinements)
    for low in (0.1, -0.1):
        monkeypatch.setattr(
            rivals, "held_out_gain", lambda *_, low=low: SimpleNamespace(estimate=0.2, low=low)
        )
        rivals.refine(None, None, None, (), [one], None, print)
    assert waits == [True, False]


def test_of_many_that_are_like_the_first_none_takes_the_place_of_another():
    def scored(effect: int, share: float, *contribution: float) -> Score:
        return Score(effect, (effect,), (1.0,), {}, share, 0.0, True, np.asarray(contribution))

    alike = [scored(i, 0.9 - 0.1 * i, 1.0, 0.01 * i, 0.0) for i in range(5)]
    others = [scored(5 + i, 0.3 - 0.01 * i, 0.0, 1.0, float(i)) for i in range(4)]
    likely = [*alike[:3], others[0], *alike[3:], *others[1:]]
    chosen = contend._first_of(likely, contend.CONTENDERS)
    assert [score.effect for score in chosen] == [0, 1, 2, 5, 3, 4, 6, 7]
    assert [score.effect for score in contend._first_of(likely, 2)] == [0, 1, 2, 5, 3, 4]
