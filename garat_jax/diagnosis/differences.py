"""Derivatives by parameters from finite differences that stand out from the jumps of contacts."""

from typing import NamedTuple

import numpy as np

from garat_jax.diagnosis.problem import Linearisation, Problem, StartSpace, linearise, tall

STEP = 1e-2
"""Finite difference where predictions are smooth, relative to a parameter's `scale` or size."""
WIDER = 10.0**0.5
"""Factor from one step to the next that is tried where they jump."""
WIDEST = 0.3
"""Largest step, relative to the width of a parameter's bounds."""
ALIKE = 0.8
"""Cosine of a step's change and what the next one adds to it below which contacts make them, not
the law."""
ERRATIC = 5.0
"""Norm of a change, relative to its typical size, above which few samples make it."""


class Differences(NamedTuple):
    """Finite differences of some parameters, and what they show.

    Attributes:
        relative: Steps, relative to each parameter's `scale` or size, [k].
        is_clear: Whether a parameter's law makes its change, not the jumps of contacts, [k].
        linearisation: With these steps.
    """

    relative: np.ndarray
    is_clear: np.ndarray
    linearisation: Linearisation


def clear_differences(
    problem: Problem,
    theta,
    start,
    free,
    sensitivity: np.ndarray | None = None,
    least: np.ndarray | float = STEP,
) -> Differences:
    """Linearise with steps as wide as it takes.

    Contacts that open or close a step of the engine earlier change what follows by an amount that
    does not shrink with the perturbation. Steps are widened where a change is erratic until the
    next wider one adds more of the same, initial states projected out; if none does, those count
    that come nearest to it. (Friction changes few samples, too, but the same ones.)

    Args:
        problem: What is fitted.
        theta: All parameters, [num_parameters].
        start: Initial states, [S, nq + nv].
        free: Indices of the parameters.
        sensitivity: As for `linearise`.
        least: Steps to begin with, relative to each parameter's `scale` or size, a number or [k].
    """
    free = np.asarray(free, int)
    relative, alike = np.full(len(free), least), np.ones(len(free))
    steps = difference_steps(problem, theta, free, relative)
    lin = linearise(problem, theta, start, free, steps, sensitivity)
    last, _ = projected(problem, lin)
    tried = np.flatnonzero([is_erratic(column, problem.num_signals) for column in last.T])
    alike[tried] = 0.0
    wider, is_first = relative.copy(), True
    last = last * steps
    while len(tried):
        wider *= WIDER
        steps = difference_steps(problem, theta, free[tried], wider[tried])
        far = linearise(problem, theta, start, free[tried], steps, lin.start, lin.residual)
        changes = projected(problem, far)[0] * steps
        cosine = cosines(changes - last[:, tried], last[:, tried])
        last[:, tried] = changes
        better = cosine > alike[tried]
        alike[tried] = np.maximum(alike[tried], cosine)
        better &= ~(is_first & (cosine >= ALIKE))  # the smallest step will do
        is_first = False
        relative[tried[better]] = wider[tried[better]]
        lin.parameters[..., tried[better]] = far.parameters[..., better]
        has_room = WIDER * np.abs(steps) < WIDEST * _widths(problem, free[tried])
        tried = tried[(cosine < ALIKE) & has_room]
    return Differences(relative, alike >= ALIKE, lin)


def difference_steps(problem: Problem, theta: np.ndarray, columns, relative) -> np.ndarray:
    """Return finite differences for some parameters that stay within their bounds.

    Args:
        problem: What is fitted.
        theta: All parameters, [num_parameters].
        columns: Indices of those to perturb, k of them.
        relative: Steps, relative to each parameter's `scale` or size, a number or [k].
    """
    steps = []
    for j, size in zip(columns, np.broadcast_to(relative, len(columns)), strict=True):
        p = problem.simulator.slots[j].parameter
        step = size * max(p.scale, 0.1 * min(abs(theta[j] - p.nominal), abs(theta[j])))
        step = min(step, WIDEST * (p.high - p.low))
        steps.append(step if theta[j] + step <= p.high else -step)
    return np.asarray(steps)


def is_erratic(change: np.ndarray, num_signals: int, limit: float = ERRATIC) -> bool:
    """Say whether few samples make a perturbation's change [M]; a flat array of [.., num_signals].

    Each signal is held against its own median: a joint that moves alone is not erratic. `limit` is
    the norm of the change, relative to its typical size, from which it is.
    """
    return bool(limit * typical_size(change, change, num_signals) < np.linalg.norm(change))


def typical_size(values: np.ndarray, change: np.ndarray, num_signals: int) -> float:
    """Return the norm of values [M], each at its signal's median, where a change [M] is not 0."""
    size, acts = (x.reshape(-1, num_signals).T for x in (np.abs(values), change != 0))
    squares = [
        at.sum() * np.median(s[at]) ** 2 for s, at in zip(size, acts, strict=True) if at.any()
    ]
    return float(np.sqrt(sum(squares)))


def projected(problem: Problem, lin: Linearisation) -> tuple[np.ndarray, np.ndarray]:
    """Return the fitted segments' sensitivities [M, k] and residual [M], initial states removed."""
    both = np.concatenate([lin.parameters, lin.residual[..., None]], axis=2)[problem.fitted]
    rest = tall(StartSpace(lin.start[problem.fitted]).remove(both))
    return rest[:, :-1], rest[:, -1]


def cosines(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cosine of the angle between each column of two matrices, [k]."""
    size = np.linalg.norm(a, axis=0) * np.linalg.norm(b, axis=0)
    return np.sum(a * b, axis=0) / np.maximum(size, 1e-300)


def _widths(problem: Problem, columns) -> np.ndarray:
    """Return the width of some parameters' bounds, [k]."""
    slots = [problem.simulator.slots[j].parameter for j in columns]
    return np.asarray([p.high - p.low for p in slots])
