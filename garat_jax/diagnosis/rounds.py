"""One round of forward selection: screen the candidates, fit the likely ones and judge them all."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from garat_jax.diagnosis.alike import with_alike
from garat_jax.diagnosis.contend import (
    CONTENDERS,
    Contender,
    best_of,
    fit_contenders,
    fit_one,
    with_evidence,
    with_twins,
)
from garat_jax.diagnosis.cross_validation import gains_in_turn
from garat_jax.diagnosis.judge import Judged, judge
from garat_jax.diagnosis.metric import ABOVE_FLOOR, AT_FLOOR, Floor, Metric, is_above, noise_floor
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.rivals import fill_out, refine
from garat_jax.diagnosis.screen import screen
from garat_jax.diagnosis.starts import Fit
from garat_jax.diagnosis.together import far_better_pair

FOLLOWED = 2
"""Candidates that are fitted beside each rival that is followed for one more effect."""


def run_round(
    problem: Problem,
    metric: Metric,
    current: Fit,
    held: Sequence[int],
    floor: Floor,
    say: Callable[[str], None],
    refinable: Sequence[int] = (),
    above: float = ABOVE_FLOOR,
    num: int = CONTENDERS,
    looks_ahead: bool = False,
) -> Judged:
    """Screen the candidates, fit the likely ones and judge them all.

    Args:
        problem: The recordings and the model with every candidate.
        metric: Of the errors.
        current: The fit of the effects selected so far.
        held: Their indices.
        floor: The noise floor.
        say: Told what is being done.
        refinable: Those of them in whose place a refinement may come.
        above: Multiple of the floor above which candidates are fitted.
        num: How many are; see `fit_contenders`.
        looks_ahead: Whether the stronger of two that may explain far more together is fitted, too.
    """
    gap = is_above(problem, metric, current, floor, above)
    scores = screen(problem, current, held)
    contenders = fit_contenders(problem, current, refinable, scores, say, num) if gap else []
    contenders = with_alike(problem, current, scores, contenders, say)
    pair = far_better_pair(problem, current, scores, contenders) if looks_ahead else None
    stronger = pair.stronger if pair else None
    if stronger and all(c.score.effect != stronger.effect for c in contenders):
        contenders = [*contenders, fit_one(problem, current, stronger, np.inf, say)]
    contenders = with_twins(problem, current, scores, contenders, say)  # each name may be refined
    best = best_of(contenders)
    contenders = refine(problem, metric, current, scores, contenders, floor, say)
    contenders = fill_out(problem, metric, contenders, floor, say)
    if (filled := best_of(contenders)) is not best:
        contenders = with_alike(problem, current, scores, contenders, say, in_contact=True)
        if best_of(contenders) is not filled:
            contenders = fill_out(problem, metric, contenders, floor, say)
    contenders = with_twins(problem, current, scores, contenders, say)
    num_tests = len([score for score in scores if not score.excluded])
    contenders = with_evidence(problem, current, contenders, num_tests)
    paired = stronger.effect if stronger else None
    contenders = [dataclasses.replace(c, is_paired=c.score.effect == paired) for c in contenders]
    judged = judge(problem, metric, current, scores, contenders, floor)
    gains = gains_in_turn(problem, metric, current, judged, say)
    return judge(problem, metric, current, scores, contenders, floor, gains) if gains else judged


def follow_up(
    problem: Problem,
    metric: Metric,
    say: Callable[[str], None],
    held: Sequence[int],
    contender: Contender,
) -> Judged:
    """Return the round that would follow if a contender were added to the effects held.

    Two that do not lead each other may both make the model adequate: what is still missing beside
    them tells which it is.
    """
    effects = [*held, contender.score.effect]
    floor = noise_floor(problem, metric, contender.fit)
    fitted, above = contender.fit, AT_FLOOR
    return run_round(problem, metric, fitted, effects, floor, say, above=above, num=FOLLOWED)
