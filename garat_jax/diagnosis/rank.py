"""Decide which effects are missing: fit the best candidates and let only those pass every gate.

Forward selection with full refits. The gates are evidence (corrected p-value), a physically
possible sign, the share explained, the fall of the held-out error and its lead over the
runner-up, each with a block-bootstrap interval, and stability over block resamples.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from garat_jax.diagnosis.ahead import LOOK_AHEAD, choose
from garat_jax.diagnosis.contend import Contender, complete, under_another_name
from garat_jax.diagnosis.findings import Candidate, Named, apart
from garat_jax.diagnosis.fit import fit
from garat_jax.diagnosis.guesses import with_guesses
from garat_jax.diagnosis.horizon import cut_ever_longer, cut_longer
from garat_jax.diagnosis.judge import NIL, estimates
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.metric import (
    Floor,
    is_above,
    make_metric,
    noise_floor,
    signals_mostly_above,
    trusted,
)
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.rivals import with_refinements
from garat_jax.diagnosis.rounds import follow_up, run_round
from garat_jax.diagnosis.segments import Grid
from garat_jax.diagnosis.starts import Fit, settle, settle_twice
from garat_jax.diagnosis.steps import Step, fit_only, least_firm, prune, reconsider, refitted
from garat_jax.diagnosis.timestep import count_timestep

ROUNDS = 5
AS_GOOD = "as good as what was added, beside what else was found"
"""Why a candidate that failed a gate by itself is no worse in the end."""


class Outcome(NamedTuple):
    """What forward selection found.

    Attributes:
        problem: The recordings, cut as long as the model with what was found can be followed.
        before: The model as it is, initial states settled.
        after: With all selected effects.
        candidates: Those of the first round in which one passed, or of the first, best first.
        steps: The effects added, in order, each with the fit at the time.
        selected: The effects kept in the end, with their final parameters.
        floor: Noise floor of the metric on the held-out segments.
        adequate: Whether the model as it is comes near its noise floor in every signal, and
            nothing was found.
        best: The fit that says most of what is left: all selected effects, or the best candidate
            that was not; None where nothing is left or nothing was fitted.
    """

    problem: Problem
    before: Fit
    after: Fit
    candidates: tuple[Candidate, ...]
    steps: tuple[Step, ...]
    selected: tuple[Candidate, ...]
    floor: Floor
    adequate: bool
    best: Fit | None


class Selection(NamedTuple):
    """What was added on one cut of the recordings.

    Attributes:
        problem: The recordings, cut.
        steps: The effects added, in order, each with the fit at the time.
        fit: The fit with all of them.
        timeless: The same counted to a timestep of 0, if that is known already.
        floor: Noise floor on the held-out segments.
        candidates: The first round's candidates, best first.
        best: The fit of the last round's first candidate, if that was fitted.
    """

    problem: Problem
    steps: list[Step]
    fit: Fit
    timeless: Fit | None
    floor: Floor
    candidates: tuple[Candidate, ...]
    best: Fit | None


def explain(
    problem: Problem,
    recordings: Sequence[Recording],
    grid: Grid,
    start: np.ndarray,
    say: Callable[[str], None],
) -> Outcome:
    """Add effects as long as one passes every gate.

    A small effect may show only in longer segments, beside a large one or in a model that is
    adequate within shorter ones.

    Args:
        problem: The recordings, cut, and the model with every candidate.
        recordings: What was measured.
        grid: The simulated steps.
        start: Initial states to start from, [S, nq + nv].
        say: Told what is being done.
    """
    before = settle(problem, problem.simulator.base, start)
    floor = noise_floor(problem, make_metric(problem), before)
    adequate = not is_above(problem, make_metric(problem), before, floor)
    found, at_first = _select(problem, before, floor, [], say), (problem, before, floor, adequate)
    candidates = found.candidates
    while found.steps or adequate:
        further = _on_longer(found, recordings, grid, say)
        if further is None:
            break
        candidates = candidates if found.steps else further.candidates
        found, adequate = further, False
        before = settle(found.problem, found.problem.simulator.base, found.fit.start)
    refined = with_refinements(found.problem, found.steps, found.fit, say)
    found = found._replace(steps=refined)
    problem, steps, current, floor, best = _counted(found, say)
    if found.steps and not steps:
        problem, before, floor, adequate = _as_nothing_passed(problem, before, at_first)
        current, best = before, None
    shown = _as_shown(problem, steps, current)
    selected = apart([shown[step.candidate.named] for step in steps])
    shown |= {c.named: c for c in selected}
    candidates = _with_nil(tuple(shown.get(c.named, c) for c in candidates), found.steps, steps)
    is_left = is_above(problem, make_metric(problem), current, floor)
    return Outcome(
        problem,
        before,
        current,
        _without_superfluous(candidates, selected),
        tuple(steps),
        selected,
        floor,
        adequate and not steps,
        best if is_left else None,
    )


def _counted(found: Selection, say: Callable[[str], None]):
    """Count the timestep's share of what was found; drop what is not told from no effect then.

    The integrator's error may look like a small effect that passes every gate. One goes at a time,
    the least firm first.

    Returns:
        The problem, the steps that are left, their fit at a timestep of 0, the noise floor at the
        model's own, and the fit that says most of what is left; if no step is left, the fit and the
        floor are still those with the last that went.
    """
    problem, steps, current, timeless = found.problem, [*found.steps], found.fit, found.timeless
    floor = found.floor
    while steps:
        say("correcting the sizes for the timestep's error")
        counted = settle_twice(problem, timeless or count_timestep(problem, current))
        nil = least_firm(problem, steps, counted)
        if nil is None:
            steps[-1] = steps[-1]._replace(fit=counted)
            return problem, steps, counted, floor, counted
        steps = [step for step in steps if step is not nil]
        say(f"going on without {nil.candidate.named}")
        if steps:
            current, timeless = fit_only(problem, current, [step.effect for step in steps]), None
            steps = refitted(problem, steps, current)
            floor = noise_floor(problem, make_metric(problem), current)
    return problem, steps, current, floor, found.best


def _as_nothing_passed(problem: Problem, before: Fit, at_first):
    """Return the problem, the model as it is, its floor and whether it is adequate.

    All that was found was dropped. One that was adequate `at_first`, in shorter segments, is so,
    unless it errs in most of these.
    """
    metric = make_metric(problem)
    floor = noise_floor(problem, metric, before)
    if at_first[-1] and not np.any(signals_mostly_above(problem, metric, before, floor)):
        return at_first
    return problem, before, floor, False


def _with_nil(
    candidates: Sequence[Candidate], before: Sequence[Step], left: Sequence[Step]
) -> tuple[Candidate, ...]:
    """Say of those that were dropped, and of what these recordings do not tell from them, why.

    Where nothing is left, so of all that passed: they gave way to what was dropped.
    """
    kept = {step.effect for step in left}
    gone = [step.candidate for step in before if step.effect not in kept]
    own = {c.named for c in gone}
    alike = {named for c in gone for named in c.indistinguishable_from}

    def is_nil(c: Candidate) -> bool:
        return c.named in own or (c.passes and (c.named in alike or bool(gone and not left)))

    return tuple(
        dataclasses.replace(c, passes=False, why=NIL) if is_nil(c) else c for c in candidates
    )


def _on_longer(
    found: Selection, recordings: Sequence[Recording], grid: Grid, say: Callable[[str], None]
) -> Selection | None:
    """Go on with longer segments; return None if they show nothing more.

    Where nothing was found yet, because the model is adequate within short segments, it is followed
    for longer whatever its error there, until it errs in most segments: what that is, is to be
    found, or stays unexplained.
    """
    had = {step.effect for step in found.steps}
    for longer, settled in _longer_cuts(found, recordings, grid):
        longer = trusted(longer, settled)
        say(f"following the recordings for {longer.horizon:.2g} s at a time")
        current = fit(longer, found.fit.theta, settled.start, found.fit.free)
        metric = make_metric(longer)
        floor = noise_floor(longer, metric, current)
        if not is_above(longer, metric, current, floor):
            continue
        again = _select(longer, current, floor, found.steps, say)
        if {step.effect for step in again.steps} - had:
            return again._replace(steps=refitted(longer, again.steps, again.fit))
        if not had and np.any(signals_mostly_above(longer, metric, current, floor)):
            return again
    return None


def _longer_cuts(
    found: Selection, recordings: Sequence[Recording], grid: Grid
) -> Iterator[tuple[Problem, Fit]]:
    """Yield longer segments, each with initial states fitted; see `_on_longer`."""
    how = recordings, grid, found.fit.theta
    longer = cut_longer(found.problem, *how)
    if longer:
        yield longer
    if not found.steps:
        yield from cut_ever_longer(longer[0] if longer else found.problem, *how)


def _select(problem: Problem, current: Fit, floor: Floor, steps: Sequence[Step], say) -> Selection:
    """Add effects to those of some steps, which a fit has already, until none passes every gate."""
    metric = make_metric(problem)
    steps, first_round, best, timeless = list(steps), (), None, None
    for number in range(ROUNDS):
        if steps and not is_above(problem, metric, current, floor):
            break
        held = [step.effect for step in steps]
        say(f"scoring the candidates, round {number + 1}{_beside(problem, held)}")
        few = len(held) < LOOK_AHEAD
        judged = run_round(
            problem, metric, current, held, floor, say, refinable=held, looks_ahead=few
        )
        follow = functools.partial(follow_up, problem, metric, say)
        judged, chosen = choose(problem, metric, current, judged, held, follow, say)
        first_round = first_round or tuple(candidate for candidate, _ in judged)
        contender = judged[0][1] if judged else None
        best = contender.fit if contender is not None else best
        if not chosen:
            break
        free = {*chosen[-1].fit.free}  # of a law that was refined, nothing is free any more
        stay = [step for step in steps if free & {*step.contender.score.columns}]
        is_refined, steps = len(stay) < len(steps), [*stay, *chosen]
        added = _completed(problem, [step.contender for step in steps], say)
        current = added.fit
        steps[-1] = steps[-1]._replace(fit=current)
        steps, current = prune(problem, steps, current, steps[:-1], say)
        floor = noise_floor(problem, metric, current)
        if len(steps) > 1:
            steps, current = reconsider(problem, metric, steps, current, say)
            floor = noise_floor(problem, metric, current)
        if is_refined:
            steps = refitted(problem, steps, current)
        timeless = added.timeless if current is added.fit else None
    return Selection(problem, steps, current, timeless, floor, first_round, best)


def _beside(problem: Problem, held: Sequence[int]) -> str:
    """Return a clause with the effects that were added, for those who wait."""
    effects = [problem.simulator.effects[i] for i in held]
    names = [str(Named(effect.kind, effect.target)) for effect in effects]
    return f", beside {' and '.join(names)}" if names else ""


def _completed(problem: Problem, added: Sequence[Contender], say) -> Contender:
    """Return the last contender, with what was left out of the laws of all that were added.

    Of an earlier one it may have been left out for the sake of those that were missing yet.
    """
    last = added[-1]
    for contender in added:
        last = complete(problem, dataclasses.replace(last, score=contender.score), say)
    return last


def _without_superfluous(candidates, selected) -> tuple[Candidate, ...]:
    """Where a later effect replaced the first one, say so and put the effects kept first."""
    kept = {c.named: place for place, c in enumerate(selected)}
    alike = {other for c in selected for other in c.indistinguishable_from}
    corrected = []
    for candidate in candidates:
        if candidate.passes and candidate.named not in {*kept, *alike}:
            why = f"superfluous with {' and '.join(map(str, kept))}"
            candidate = dataclasses.replace(candidate, passes=False, why=why)
        corrected.append(candidate)
    dropped = any("superfluous" in c.why for c in corrected)
    return tuple(sorted(corrected, key=lambda c: kept.get(c.named, len(kept)) if dropped else 0))


def _as_shown(problem: Problem, steps: Sequence[Step], final: Fit) -> dict[Named, Candidate]:
    """Return the selected effects and what is not told from them.

    Sizes are those of the final fit where one fit serves both, else those of the round.
    """
    shown, selected = {}, [step.candidate.named for step in steps]
    final = with_guesses(problem, [step.effect for step in steps], final)
    for step in steps:
        own, equals = step.candidate.named, step.candidate.indistinguishable_from
        for candidate, contender in [(step.candidate, step.contender), *step.alike]:
            fit, named = final, candidate.named
            if contender is not step.contender:
                if named in selected:  # in an earlier one's place, since this was held against it
                    continue
                fit = under_another_name(problem, final, step.contender, contender)
            if fit is None and named not in equals:
                continue
            if fit is not None:
                sizes = estimates(problem, contender.score.effect, fit)
                candidate = dataclasses.replace(candidate, parameters=sizes)
            if named in equals and len(steps) > 1:
                others = (own, *(other for other in equals if other != named))
                why = candidate.why if candidate.passes else AS_GOOD
                candidate = dataclasses.replace(candidate, why=why, indistinguishable_from=others)
            shown[named] = candidate
    return shown
