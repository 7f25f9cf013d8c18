"""More of the laws of the best contender and its rivals: one may be the truth without a part."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from garat_jax.diagnosis.contend import (
    Contender,
    acts,
    as_refined,
    best_of,
    fit_further,
    fit_one,
    fit_refinements,
    refines,
    set_aside,
)
from garat_jax.diagnosis.evidence import Evidence
from garat_jax.diagnosis.findings import Candidate
from garat_jax.diagnosis.judge import SIGNIFICANCE, estimates, held_out_gain, is_certain, leads
from garat_jax.diagnosis.metric import AT_FLOOR, Floor, Metric, is_above, make_metric
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.screen import Score, gather
from garat_jax.diagnosis.starts import Fit
from garat_jax.diagnosis.steps import Step

HARDLY_MORE = "refines what was added, which leaves hardly more"
"""Why a law that fits better for certain is not added: a simpler one leaves hardly more."""


def refine(problem, metric: Metric, current: Fit, scores, contenders, floor: Floor, say):
    """Put before the best contender, and those that it does not lead, refinements of their laws.

    A refinement comes before a law where it certainly explains more. Screening prefers the
    simpler law. A refinement's threshold hides it there; one without waits for the next round,
    where other effects rival it, if the simpler law proves itself and has no rival.
    """
    best = best_of(contenders)
    if best is None or not is_above(problem, metric, best.fit, floor, AT_FLOOR):
        return contenders
    rivals = unled(problem, best, contenders)
    proves_itself = is_certain(held_out_gain(problem, metric, current, best.fit))
    for rival in rivals:
        names = [c for c in contenders if c.fit.residual is rival.fit.residual]
        for name in names:
            waits = proves_itself and len(rivals) == 1
            for refined in fit_refinements(problem, current, name, scores, say, waits):
                known = (c.fit for c in contenders if c.score.effect == refined.score.effect)
                if all(leads(problem, refined.fit, fit) for fit in (rival.fit, *known)):
                    others = [c for c in contenders if c.score.effect != refined.score.effect]
                    contenders, rival = [refined, *others], refined
    return contenders


def fill_out(problem, metric: Metric, contenders, floor: Floor, say):
    """Replace the best contender, and those that it does not lead, where more of their laws does.

    Of two that explain the same, one may be the truth without a part that screening left out.
    """
    best = best_of(contenders)
    if best is None or not is_above(problem, metric, best.fit, floor, AT_FLOOR):
        return contenders
    for rival in unled(problem, best, contenders):
        for fuller in fit_further(problem, rival, say):
            if leads(problem, fuller.fit, rival.fit):
                contenders = _replaced(contenders, rival, fuller)
    return contenders


def unled(problem: Problem, best: Contender, contenders: Sequence[Contender]) -> list[Contender]:
    """Return the best contender and those that it does not lead, each fit under one name."""
    fits = {id(c.fit.residual): c for c in [*contenders, best]}  # names share one
    others = (c for c in fits.values() if c is not best)
    return [best, *(c for c in others if not leads(problem, best.fit, c.fit))]


def _replaced(contenders: Sequence[Contender], old: Contender, new: Contender) -> list[Contender]:
    """Put one contender in another's place; the other's names go, as the new one has its own."""
    names = (c.score.effect for c in contenders if c.fit.residual is old.fit.residual)
    replaced = {new.score.effect, *names}
    return [new, *(c for c in contenders if c.score.effect not in replaced)]


def with_refinements(problem: Problem, steps: Sequence[Step], current: Fit, say) -> list[Step]:
    """Name the laws that refine what was added and fit better for certain, if only by a trifle.

    Where a law leaves no more than noise, none that refines it was fitted (`refine`), and what a
    hidden one explains is lost in the error; evidence shows it all the same. The recordings then do
    not tell which of the two it is.

    Args:
        problem: The recordings and the model with every candidate.
        steps: What was added.
        current: The fit with all of them.
        say: Told what is being done.
    """
    hidden = [_hidden(problem, step, current) for step in steps]
    if not any(hidden):
        return list(steps)
    metric, (_, evidence, _) = make_metric(problem), gather(problem, current)
    found = []
    for step, scores in zip(steps, hidden, strict=True):
        without = set_aside(problem, current, [step.effect])
        more = [
            (_as_refinement(problem, metric, step, current, refined, p_value), refined)
            for score in scores
            if (p_value := _p_value(evidence, score, without.theta)) < SIGNIFICANCE
            for refined in [fit_one(problem, without, score, np.inf, say)]
            if leads(problem, refined.fit, current, by=1.0)
        ]
        equals = (*step.candidate.indistinguishable_from, *(c.named for c, _ in more))
        candidate = dataclasses.replace(step.candidate, indistinguishable_from=equals)
        found.append(step._replace(candidate=candidate, alike=[*step.alike, *more]))
    return found


def _hidden(problem: Problem, step: Step, current: Fit) -> list[Score]:
    """Return the hidden laws that refine a step's and were not tried, each as that was fitted."""
    simulator, simple = problem.simulator, step.effect
    if acts(problem, simple, simulator.base):
        return []
    tried = {contender.score.effect for _, contender in step.alike}
    scores = (
        dataclasses.replace(step.contender.score, effect=index)
        for index in range(len(simulator.effects))
        if index not in tried and refines(problem, index, simple) and problem.num_listed(index) > 1
    )
    begun = (as_refined(problem, score, current.theta, [simple]) for score in scores)
    return [score for score in begun if score is not None]


def _p_value(evidence: Evidence, refined: Score, theta: np.ndarray) -> float:
    """Return how likely errors would show a law that begins as a simpler one, which is set aside.

    Args:
        evidence: What the segments say beside all that was added.
        refined: The law, with where it begins.
        theta: The parameters without the simpler one, [num_parameters].
    """
    begun = theta.copy()
    begun[list(refined.start)] = list(refined.start.values())
    return evidence.p_value(refined.effect, evidence.change(begun[None]))


def _as_refinement(
    problem: Problem, metric: Metric, step: Step, current: Fit, refined: Contender, p_value: float
) -> Candidate:
    """Return what is said of a law that refines a step's, beside what is said of that."""
    effect, of = problem.simulator.effects[refined.score.effect], step.candidate
    cost, simpler = (fit.cost[problem.fitted].sum() for fit in (refined.fit, current))
    return dataclasses.replace(
        of,
        effect=effect.kind,
        parameters=estimates(problem, refined.score.effect, refined.fit),
        share=1.0 - (1.0 - of.share) * float(cost / simpler),
        p_value=p_value,
        error_after=metric.error(refined.fit.residual, ~problem.fitted),
        indistinguishable_from=(of.named, *of.indistinguishable_from),
        passes=False,
        why=HARDLY_MORE,
    )
