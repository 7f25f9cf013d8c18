"""Which effects recordings cannot show, because nothing in them would make such an effect act."""

from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np

from garat_jax.diagnosis.evidence import Evidence
from garat_jax.diagnosis.findings import Named, Unseen
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.screen import SCREENED
from garat_jax.diagnosis.segments import QUIET, Segments
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.diagnosis.starts import Fit
from garat_jax.diagnosis.trials import Row, Trial, firsts
from garat_jax.effects import Effect
from garat_jax.effects.units import unit_at

SEEN = 5.0
"""Standard deviations of noise that all an effect changes, at a size that is small but visible
where it acts, must exceed: a test of dozens of candidates needs about four."""
DOUBLINGS = 5
"""How often a size that is extrapolated is doubled at most: much damping stops what it acts on."""
STILL = (
    f"the recordings excite nothing: no signal moves by more than {QUIET:g} times its noise, so "
    "that a model may agree with them whatever it lacks"
)
"""What is said of recordings in which nothing moves."""
HELD = (
    f"no signal moves by more than {QUIET:g} times its noise: what holds the machine where it is, "
    "as a stop or friction at rest, can hardly be told from what would; record motion"
)
"""And where the model would move."""


def is_still(segments: Segments) -> bool:
    """Say whether no signal moves by more than noise could hide."""
    return not np.any(segments.spread > QUIET * segments.noise)


def unseen(
    problem: Problem[Simulator], current: Fit, seen: Collection[Named] = ()
) -> tuple[Unseen, ...]:
    """List the candidates that would change the signals by less than noise hides.

    Those that act already are none.

    Each is tried at its usual sizes (`Effect.starts`), and with each of its parameters if they act
    alone: the one that shows most counts. Initial states are projected out, as where candidates are
    scored. The size from which one would show is extrapolated from there, and doubled until it
    does.

    Args:
        problem: The recordings and the model with every candidate.
        current: A fit.
        seen: Those of which the recordings show a larger size; laws that refine one of them at its
            place are left out, too.
    """
    simulator, theta = problem.simulator, current.theta
    fitted = np.flatnonzero(problem.fitted)
    chosen = fitted[:: max(1, len(fitted) // SCREENED)]
    rows, trials = firsts(problem, theta, simulator.acting)
    evidence = Evidence(problem, current, chosen)

    def size_of(rows: Sequence[Row]) -> np.ndarray:
        thetas = np.tile(theta, (len(rows), 1))
        for moved, row in zip(thetas, rows, strict=True):
            moved[list(row.values)] = list(row.values.values())
        change = evidence.change(thetas)
        return np.linalg.norm(change, axis=0) * np.sqrt(len(fitted) / len(chosen))

    size = size_of(rows)
    shown = {t.effect for t in trials if size[list(t.rows)].max() > SEEN}
    hidden: dict[int, Trial] = {}
    for t in sorted(trials, key=lambda t: size[t.rows[0]], reverse=True):
        if t.effect not in shown and not _is_shown(simulator.effects[t.effect], seen):
            hidden.setdefault(t.effect, t)
    smooth = {i: t.rows[0] for i, t in hidden.items() if t.is_only and size[t.rows[0]] > 0}
    steps = {i: SEEN / size[first] * rows[first].step for i, first in smooth.items()}
    up_to = _enlarged(problem, {i: rows[first] for i, first in smooth.items()}, steps, size_of)
    return tuple(
        _unseen(simulator, index, rows[hidden[index].rows[0]].column, up_to.get(index, np.inf))
        for index in sorted(hidden)
    )


def _enlarged(
    problem: Problem[Simulator],
    rows: Mapping[int, Row],
    steps: Mapping[int, float],
    size_of: Callable[[Sequence[Row]], np.ndarray],
) -> dict[int, float]:
    """Double the steps that do not show yet, as long as bounds allow, and return those that do."""
    found, steps = {}, dict(steps)
    for _ in range(DOUBLINGS + 1):
        tried = {}
        for index, step in steps.items():
            column, slot = rows[index].column, problem.simulator.slots[rows[index].column]
            value = rows[index].values[column] - rows[index].step + step
            if slot.parameter.low <= value <= slot.parameter.high:
                values = {**rows[index].values, column: value}
                tried[index] = rows[index]._replace(values=values, step=step)
        if not tried:
            break
        shows = size_of([*tried.values()]) > SEEN
        for index, does in zip(tried, shows, strict=True):
            if does:
                found[index] = abs(steps[index])
        steps = {index: 2.0 * steps[index] for index in tried if index not in found}
    return found


def _is_shown(effect: Effect, seen: Collection[Named]) -> bool:
    """Say whether recordings show an effect, or a law at its place that it refines."""
    return any(Named(kind, effect.target) in seen for kind in (effect.kind, *effect.refines))


def _unseen(simulator: Simulator, index: int, column: int, up_to: float) -> Unseen:
    effect = simulator.effects[index]
    unit = unit_at(simulator.slots[column].parameter, simulator.host, effect.target)
    names = tuple(p.name for p in effect.parameters())
    return Unseen(effect.kind, effect.target, names, float(up_to), unit)
