"""How much wider intervals are for parameters of a law that were left at a guess."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from garat_jax.diagnosis.differences import clear_differences, projected
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.slots import columns_of
from garat_jax.diagnosis.starts import Fit


def with_guesses(problem: Problem, effects: Sequence[int], fitted: Fit) -> Fit:
    """Widen intervals by what those parameters may be that no fit needed and nothing else tells.

    A payload's place is a guess, its body's centre of mass, until a fit needs another. Its mass is
    then as uncertain as that place. (A parameter that acts alone, as an offset, has a value that
    says "no effect", and is no guess.) To first order: what the recordings leave open of the
    guesses, within their bounds, times how the fitted parameters make up for them; and intervals
    reach as far as a step to the best guess would move these.

    Args:
        problem: What was fitted.
        effects: Indices of the effects that act.
        fitted: The fit with all of them.
    """
    free = [j for j in fitted.free if j not in fitted.frozen]
    guesses = [j for i in effects for j in _guesses(problem, i, fitted)]
    if not free or not guesses:
        return fitted
    at = [fitted.free.index(j) for j in free]
    half = (fitted.high - fitted.low)[at] / 2.0
    differences = clear_differences(problem, fitted.theta, fitted.start, (*free, *guesses))
    sensitivity, residual = projected(problem, differences.linearisation)
    known, guessed = np.split(sensitivity, [len(free)], axis=1)
    inverse = np.linalg.pinv(known)
    answer = -inverse @ guessed  # by how much the fitted ones make up for each guess
    told = guessed + known @ answer
    alone = np.linalg.norm(inverse, axis=1)  # standard deviations, were errors white
    is_known = np.isfinite(half) & (alone > 0)
    times = np.max(half[is_known] / alone[is_known], initial=1.0)
    parameters = [problem.simulator.slots[j].parameter for j in guesses]
    reach = np.asarray([(p.high - p.low) / 2.0 for p in parameters])
    told, answer = told * reach / times, answer * reach
    information = told.T @ told + np.eye(len(guesses))
    shift = answer @ np.linalg.solve(information, -told.T @ residual / times)
    spread = np.einsum("ki,ij,kj->k", answer, np.linalg.inv(information), answer)
    wider = np.hypot(half, np.sqrt(spread)) - half
    low, high = fitted.low.copy(), fitted.high.copy()
    low[at] += np.minimum(shift, 0.0) - wider
    high[at] += np.maximum(shift, 0.0) + wider
    return dataclasses.replace(fitted, low=low, high=high)


def _guesses(problem: Problem, effect: int, fitted: Fit) -> list[int]:
    """Return the parameters that an effect's first one switches on and that were not fitted."""
    if problem.simulator.effects[effect].independent:
        return []
    columns = columns_of(problem.simulator.slots, effect)
    return [j for j in columns.values() if j not in fitted.free]
