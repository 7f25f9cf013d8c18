"""Where the recordings held out hardly show an effect: hold out each of the others in turn."""

import dataclasses
from collections.abc import Callable

import numpy as np

from garat_jax.diagnosis.findings import Interval, Named
from garat_jax.diagnosis.fit import fit
from garat_jax.diagnosis.judge import NO_CERTAIN_GAIN, STABLE, Judged, block_costs, fall
from garat_jax.diagnosis.metric import Metric
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
    however clear it is in the others. Where a candidate lacks nothing else, and helps there, each
    recording is predicted by a fit that has not seen it (cross-validation; Stone 1974).

    Args:
        problem: What is fitted.
        metric: Of the errors.
        current: The fit of the effects selected so far.
        judged: The candidates, best first.
        say: Told what is being done.
    """
    gains = {}
    if len(np.unique(problem.segments.recording[problem.fitted])) < 2:
        return gains
    for candidate, contender in judged:
        if not contender or candidate.why != NO_CERTAIN_GAIN or candidate.stability < STABLE:
            continue
        helps = candidate.held_out_gain.estimate > 0
        if not helps or acts_in(problem, metric, current, contender.fit) >= FEWEST_SEGMENTS:
            continue
        say(f"holding out each recording in turn, for {Named(candidate.effect, candidate.target)}")
        before, after = (_in_turn(problem, one) for one in (current, contender.fit))
        everywhere = np.ones_like(problem.fitted)
        gains[contender.score.effect] = fall(problem, metric, before, after, everywhere)
    return gains


def acts_in(problem: Problem, metric: Metric, before: Fit, after: Fit) -> float:
    """Return in how many blocks of the time held out a fit differs from another.

    A block counts as far as its share of all that differs is like the others' (the participation
    ratio of squares; Bell and Dean 1970).
    """
    change = dataclasses.replace(before, residual=after.residual - before.residual)
    squares = block_costs(problem, metric.weight, [change], ~problem.fitted)[0]
    return float(squares.sum() ** 2 / np.sum(squares**2)) if np.any(squares) else 0.0


def _in_turn(problem: Problem, fitted: Fit) -> Fit:
    """Return a fit with the residuals of each recording as fits predict them that do not see it."""
    residual, recording = fitted.residual.copy(), problem.segments.recording
    for number in np.unique(recording[problem.fitted]):
        own = recording == number
        others = dataclasses.replace(problem, fitted=problem.fitted & ~own)
        if fitted.free:
            where = fitted.theta, fitted.start, fitted.free
            again = fit(others, *where, sensitivity=fitted.sensitivity, searches=False)
            residual[own] = again.residual[own]
    return dataclasses.replace(fitted, residual=residual)
