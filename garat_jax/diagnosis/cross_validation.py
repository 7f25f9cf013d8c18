"""Where the recordings held out hardly show an effect: hold out each of the others in turn."""

import dataclasses
from collections.abc import Callable

import numpy as np

from garat_jax.diagnosis.contend import Contender
from garat_jax.diagnosis.findings import Candidate, Interval, Named
from garat_jax.diagnosis.fit import fit
from garat_jax.diagnosis.judge import (
    NO_CERTAIN_GAIN,
    STABLE,
    Judged,
    block_costs,
    fall,
)
from garat_jax.diagnosis.metric import SMALLEST_SHARE, Metric
from garat_jax.diagnosis.problem import FEWEST_SEGMENTS, Problem
from garat_jax.diagnosis.starts import Fit


def gains_in_turn(
    problem: Problem,
    metric: Metric,
    current: Fit,
    judged: Judged,
    say: Callable[[str], None],
) -> dict[int, Interval]:
    """Return the falls of the error with each recording held out in turn, by effect.

    A limit that the recordings held out reach once or twice cannot lower their error for certain,
    however clear it is in the others. Where a candidate fails that gate, comes first in most
    resamples and helps in what is held out, each of the other recordings is predicted by a fit to
    the rest of them (cross-validation; Stone 1974). That begins at the fit to all: which size of a
    law is tried was chosen by all. What explains little so is left out, as one that a single
    recording shows.

    Args:
        problem: What is fitted.
        metric: Of the errors.
        current: The fit of the effects selected so far.
        judged: The candidates, best first.
        say: Told what is being done.
    """
    asked = [(c, k) for c, k in judged if k and _is_asked(problem, metric, current, c, k)]
    if not asked or len(np.unique(problem.segments.recording[problem.fitted])) < 2:
        return {}
    before = in_turn(problem, current, current)
    everywhere, fits, gains = np.ones_like(problem.fitted), {}, {}
    for candidate, contender in asked:
        shared = id(contender.fit.residual)  # one fit may serve two names
        if shared not in fits:
            named = Named(candidate.effect, candidate.target)
            say(f"holding out each recording in turn, for {named}")
            fits[shared] = in_turn(problem, contender.fit, before)
        after = fits[shared]
        if 1.0 - after.cost.sum() / before.cost.sum() >= SMALLEST_SHARE:
            fallen = fall(problem, metric, before, after, everywhere)
            gains[contender.score.effect] = fallen
    return gains


def _is_asked(
    problem: Problem, metric: Metric, current: Fit, candidate: Candidate, contender: Contender
) -> bool:
    """Say whether what is held out, and nothing else that is known yet, says too little."""
    if candidate.why != NO_CERTAIN_GAIN or candidate.stability < STABLE:
        return False
    helps = candidate.held_out_gain.estimate > 0
    return helps and acts_in(problem, metric, current, contender.fit) < FEWEST_SEGMENTS


def acts_in(problem: Problem, metric: Metric, before: Fit, after: Fit) -> float:
    """Return in how many blocks of the time held out a fit differs from another.

    A block counts as far as its share of all that differs is like the others' (the participation
    ratio of squares; Bell and Dean 1970).
    """
    change = dataclasses.replace(before, residual=after.residual - before.residual)
    squares = block_costs(problem, metric.weight, [change], ~problem.fitted)[0]
    return float(squares.sum() ** 2 / np.sum(squares**2)) if np.any(squares) else 0.0


def in_turn(problem: Problem, fitted: Fit, otherwise: Fit) -> Fit:
    """Return a fit with the residuals of each fitted recording as a fit to the others has them.

    Where these do not show a parameter that all of them do, they predict nothing: its value would
    be the one that the recording itself told.

    Args:
        problem: What is fitted.
        fitted: The fit to all that are fitted, where the others begin.
        otherwise: Whose residuals count where the others predict nothing.
    """
    residual, recording = fitted.residual.copy(), problem.segments.recording
    for number in np.unique(recording[problem.fitted]) if fitted.free else ():
        own = recording == number
        others = dataclasses.replace(problem, fitted=problem.fitted & ~own)
        where = fitted.theta, fitted.start, fitted.free
        again = fit(others, *where, sensitivity=fitted.sensitivity, searches=False)
        says = {*again.frozen} <= {*fitted.frozen}
        residual[own] = (again if says else otherwise).residual[own]
    return dataclasses.replace(fitted, residual=residual)
