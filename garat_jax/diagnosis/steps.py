"""The effects added so far: what became superfluous goes, what fits better takes its place.

A law is superfluous, too, where another at its place that refines it can do all that both do.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from garat_jax.diagnosis.contend import (
    FIRM,
    Contender,
    as_refined,
    complete,
    firmness,
    fit_one,
    refines,
    under_another_name,
    with_evidence,
    with_twins,
)
from garat_jax.diagnosis.findings import Candidate
from garat_jax.diagnosis.fit import fit
from garat_jax.diagnosis.judge import Judged, judge, leads, may_be_mended, simplest
from garat_jax.diagnosis.metric import AT_FLOOR, Floor, Metric, is_above, noise_floor
from garat_jax.diagnosis.names import twins
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.screen import EQUIVALENT, Score, cosine, screen
from garat_jax.diagnosis.slots import columns_of
from garat_jax.diagnosis.starts import Fit
from garat_jax.effects import are_exclusive

NEWCOMERS = 2
"""Candidates fitted in an effect's place, of those that screening puts before it by now; and as
many of the others that do the same there with no more parameters."""
EQUALS = 3
"""Largest number of what is not told from the effects that were added that is fitted instead."""


class Step(NamedTuple):
    """One effect that was added.

    Attributes:
        candidate: What was said of it.
        contender: How it was fitted then.
        fit: The fit with it and those before it.
        alike: What did much the same then, whether the recordings told it from this or not, and
            what was tried in its place since.
    """

    candidate: Candidate
    contender: Contender
    fit: Fit
    alike: Sequence[tuple[Candidate, Contender]]

    @property
    def effect(self) -> int:
        """Its index among the simulator's."""
        return self.contender.score.effect


def prune(problem: Problem, steps: list[Step], current: Fit, tried: list[Step], say):
    """Drop those effects that became superfluous: without them the cost stays as it is."""
    kept = steps
    for step in tried:
        others = [s for s in kept if s.effect != step.effect]
        if not others:
            break
        say(f"trying without {step.candidate.named}")
        others, without = _without(problem, current, others, step)
        if not leads(problem, current, without):
            kept, current = others, without
    return (steps if len(kept) == len(steps) else refitted(problem, kept, current)), current


def _without(problem: Problem, current: Fit, others: list[Step], step: Step):
    """Fit again without a step; what its law did, a kept law that refines it does from now on.

    Returns:
        The other steps and the fit with them alone.
    """
    theta, free = _only(problem, current, [other.effect for other in others])
    simulator, heirs = problem.simulator, []
    for other in others:
        score, contender = other.contender.score, other.contender
        if refines(problem, other.effect, step.effect) and (
            refined := as_refined(problem, score, current.theta, [step.effect])
        ):
            whole = tuple(columns_of(simulator.slots, other.effect).values())
            for j, value in refined.start.items():
                theta[j] = value + (theta[j] if simulator.base[j] == 0.0 else 0.0)
            free += [j for j in whole if j not in free]
            contender = dataclasses.replace(
                contender, score=dataclasses.replace(score, columns=whole)
            )
        heirs.append(other._replace(contender=contender))
    rival = current.cost[problem.fitted].sum()
    start, sensitivity = current.start, current.sensitivity
    return heirs, fit(problem, theta, start, free, rival=rival, sensitivity=sensitivity)


def refitted(problem: Problem, steps: list[Step], current: Fit) -> list[Step]:
    """Return steps with the fits that now lead to the current one."""
    effects = [step.effect for step in steps]
    fits = [fit_only(problem, current, effects[:n]) for n in range(1, len(steps))]
    return [step._replace(fit=f) for step, f in zip(steps, (*fits, current), strict=True)]


def reconsider(problem: Problem, metric: Metric, steps: list[Step], current: Fit, say):
    """Hold effects once more against others, beside all that was found since.

    By itself an effect may lead for what it says of another, which was missing yet; beside that
    one, recordings may tell apart what they could not, and may no longer what they did. It is held
    against what did much the same then, and against what would come first or do the same now; the
    last, too, where one before it was replaced. One that fits better by now, or as well with fewer
    parameters, comes in its place, and what was added since may only have made up for the wrong
    one.

    Returns:
        The steps, each with those that the recordings do not tell from it now, and the fit with
        all of them.
    """
    found, fitted = [*steps], current
    for place, step in enumerate(steps):
        if step is steps[-1] and fitted is current:  # nothing before it gave way
            break
        others = [s.effect for s in found if s.effect != step.effect]
        trials = []
        for candidate, contender in step.alike:
            if not _excludes(problem, contender, others):
                trial = under_another_name(problem, fitted, step.contender, contender)
                if trial is None:
                    say(f"trying {candidate.named} instead of {step.candidate.named}")
                    trial = _fit_instead(problem, fitted, others, contender)
                trials.append((candidate, dataclasses.replace(contender, fit=trial)))
        new = _newcomers(problem, metric, step, fitted, others, say)
        step = step._replace(alike=[*step.alike, *new])
        found[place], fitted = _best_of(problem, metric, step, fitted, [*trials, *new], say)
    if fitted is current:
        return found, current
    kept, fitted = prune(problem, found, fitted, found, say)
    return (refitted(problem, kept, fitted) if len(kept) == len(found) else kept), fitted


def fit_equals(problem: Problem, steps: Sequence[Step], current: Fit, say) -> list[Fit]:
    """Fit again with what the recordings do not tell from an effect in its place, one at a time.

    Of those that shared one fit when they came up, the effect itself or one of the others counts.
    """
    found = []
    for step in steps:
        others = [s.effect for s in steps if s.effect != step.effect]
        known = [step.contender.fit.residual]
        for candidate, contender in step.alike:
            is_told = candidate.named not in step.candidate.indistinguishable_from
            is_known = any(contender.fit.residual is residual for residual in known)
            if is_told or is_known or _excludes(problem, contender, others):
                continue
            known.append(contender.fit.residual)
            if len(found) < EQUALS:
                say(f"trying {candidate.named} instead of {step.candidate.named}")
                found.append(_fit_instead(problem, current, others, contender))
    return found


def _excludes(problem: Problem, contender: Contender, others: Sequence[int]) -> bool:
    """Say whether a contender cannot act beside one of some other effects."""
    laws = problem.simulator.effects
    own = laws[contender.score.effect]
    return any(are_exclusive(own, laws[other]) for other in others)


def _newcomers(problem: Problem, metric: Metric, step: Step, fitted: Fit, others, say) -> Judged:
    """Fit what was not tried in a step's place and screening puts before it now, or like it.

    Returns:
        What was fitted, judged beside the step's own effect.
    """
    say(f"looking for what would explain more than {step.candidate.named}")
    without = fit_only(problem, fitted, others)
    scores = screen(problem, without, others)
    tried = {step.effect, *(contender.score.effect for _, contender in step.alike)}
    known = [score for score in scores if score.effect in tried]
    new = [s for s in scores if s.possible and s.effect not in tried and not twins(s, known)]
    new = [s for s in new if not refines(problem, s.effect, step.effect)]
    new = [s for i, s in enumerate(new) if not twins(s, new[:i])]
    place = {score.effect: i for i, score in enumerate(scores)}
    ahead = [s for s in new if place[s.effect] < place.get(step.effect, len(scores))][:NEWCOMERS]
    rest = [s for s in new if all(s is not other for other in ahead)]
    alike = [s for s in rest if _does_as_much(problem, s, step, fitted, known)][:NEWCOMERS]
    rival = fitted.cost[problem.fitted].sum()
    new = [fit_one(problem, without, score, rival, say) for score in (*ahead, *alike)]
    new = with_twins(problem, without, scores, new, say)
    new += [Contender(score, fitted) for score in scores if new and score.effect == step.effect]
    num_tests = len([score for score in scores if not score.excluded])
    new = with_evidence(problem, without, new, num_tests)
    floor = noise_floor(problem, metric, fitted)
    judged = judge(problem, metric, without, scores, new, floor)
    return [(c, k) for c, k in judged if k and k.score.effect != step.effect]


def _does_as_much(problem: Problem, score: Score, step: Step, fitted: Fit, known) -> bool:
    """Say whether a candidate does what a step does, as screened, with no more parameters."""
    own = {*columns_of(problem.simulator.slots, step.effect).values()} & {*fitted.free}
    like = [other for other in known if other.effect == step.effect and not other.excluded]
    return len(score.columns) <= len(own) and any(cosine(score, s) > EQUIVALENT for s in like)


def _best_of(problem: Problem, metric: Metric, step: Step, fitted: Fit, trials, say):
    """Return a step, or what comes in its place, with its equals, and the fit.

    That is what certainly fits better, or what does as well with fewer parameters.
    """
    better = [pair for pair in trials if _is_better(problem, pair[1].fit, fitted)]
    simpler = [pair for pair in trials if _may_do_as_well(pair, fitted)]
    best = min((k.fit for _, k in better), key=lambda fit: fit.cost.sum(), default=fitted)
    best = simplest(problem, metric, best, [k.fit for _, k in (*better, *simpler)])
    pair = next((pair for pair in (*better, *simpler) if pair[1].fit is best), None)
    if pair is not None:
        fits_better = any(pair is other for other in better)
        instead = complete(problem, pair[1], say) if fits_better else pair[1]
        trials = [other for other in trials if other is not pair]
        trials.append((step.candidate, dataclasses.replace(step.contender, fit=fitted)))
        alike = [(step.candidate, step.contender)]
        alike += [other for other in step.alike if other[0] is not pair[0]]
        how = "fits better than {}" if fits_better else "fits as well as {} with fewer parameters,"
        why = f"{how.format(step.candidate.named)} beside what was found since"
        candidate = dataclasses.replace(pair[0], passes=True, why=why)
        step, fitted = Step(candidate, instead, instead.fit, alike), instead.fit
    floor = noise_floor(problem, metric, fitted)
    equals = [
        candidate.named
        for candidate, contender in trials
        if _is_equal(problem, metric, floor, fitted, contender.fit)
    ]
    candidate = dataclasses.replace(step.candidate, indistinguishable_from=tuple(equals))
    return step._replace(candidate=candidate), fitted


def _may_do_as_well(pair: tuple[Candidate, Contender], fitted: Fit) -> bool:
    """Say whether a trial has fewer parameters, and failed no gate but one that another may mend.

    That is what was said of it when it came up.
    """
    candidate, contender = pair
    return may_be_mended(candidate) and len(contender.fit.free) < len(fitted.free)


def _is_equal(problem: Problem, metric: Metric, floor: Floor, fitted: Fit, other: Fit) -> bool:
    """Say whether a fit does not lead another, or both leave no more than noise."""
    both = (fitted, other)
    at_floor = not any(is_above(problem, metric, one, floor, AT_FLOOR) for one in both)
    return at_floor or not leads(problem, fitted, other)


def _is_better(problem: Problem, new: Fit, old: Fit) -> bool:
    """Say whether a fit is certainly better than another, and no worse on what is held out."""
    held_out = ~problem.fitted
    return leads(problem, new, old) and new.cost[held_out].sum() <= old.cost[held_out].sum()


def _fit_instead(problem: Problem, current: Fit, others: Sequence[int], instead: Contender) -> Fit:
    """Fit again with the effects `others` and with what was fitted `instead` of the rest."""
    columns, rival = list(instead.score.columns), current.cost[problem.fitted].sum()
    theta, free = _only(problem, current, others)
    theta[columns] = instead.fit.theta[columns]
    free += columns
    return fit(problem, theta, current.start, free, rival=rival, sensitivity=current.sensitivity)


def fit_only(problem: Problem, current: Fit, effects: Sequence[int]) -> Fit:
    """Fit again with some of the selected effects, the others back at no effect."""
    theta, free = _only(problem, current, effects)
    return fit(problem, theta, current.start, free, sensitivity=current.sensitivity)


def least_firm(problem: Problem, steps: Sequence[Step], fitted: Fit) -> Step | None:
    """Return the step whose effect differs least from none, of those that do not firmly.

    Those with one fitted parameter are asked: several may be certain together though none is by
    itself. Where an interval has no end the recordings do not say.
    """
    simulator, unfirm = problem.simulator, []
    width = dict(zip(fitted.free, fitted.high - fitted.low, strict=True))
    for step in steps:
        columns = columns_of(simulator.slots, step.effect).values()
        own = [j for j in columns if j in width and j not in fitted.frozen]
        if len(own) == 1 and np.isfinite(width[own[0]]):
            unfirm.append((firmness(problem, fitted, own[0]), step))
    firm, step = min(unfirm, key=lambda pair: pair[0], default=(np.inf, None))
    return step if firm <= FIRM else None


def _only(problem: Problem, current: Fit, effects: Sequence[int]) -> tuple[np.ndarray, list[int]]:
    """Return parameters at which only some effects act, and which of theirs are fitted."""
    present = np.asarray([slot.effect in effects for slot in problem.simulator.slots])
    theta = np.where(present, current.theta, problem.simulator.base)
    return theta, [j for j in current.free if present[j]]
