"""What screening simulates: each candidate at one size or several, and each of its parameters."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from garat_jax.diagnosis.differences import is_erratic, typical_size
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.simulate import Simulator, columns_of
from garat_jax.effects import are_exclusive

UNEVEN = 2.5
"""Norm of a change, relative to its typical size, from which a larger step is tried, too: a sine
has 1.0, noise 1.5."""
GROWN = 2.0
"""Factor by which a larger step must be larger."""
ROOM = 0.3
"""Share of the way to a bound that a step is enlarged to at most."""


class Row(NamedTuple):
    """One perturbed simulation.

    Attributes:
        column: The parameter that is moved last.
        values: All that is set, by column.
        step: By how much `column` is moved.
        below: The row whose change is subtracted; -1 for none.
    """

    column: int
    values: dict[int, float]
    step: float
    below: int


class Trial(NamedTuple):
    """One candidate tried at one size.

    Attributes:
        effect: Index among the simulator's effects.
        start: What "tried" sets, by column.
        rows: Indices of the rows that move one parameter each, the first parameter's first.
        is_only: Whether it is the one size that the law lists; then sizes are extrapolated from it.
            Each parameter that acts alone has one such trial.
    """

    effect: int
    start: dict[int, float]
    rows: tuple[int, ...]
    is_only: bool


def firsts(problem: Problem[Simulator], theta: np.ndarray, skip) -> tuple[list[Row], list[Trial]]:
    """List each candidate at each of its sizes, a row for each.

    What is skipped is none, nor is what excludes a skipped one that acts. Where one size of one
    parameter is all that a law lists, and its parameters act alone, each of them has a trial: any
    may be the one that the recordings show.
    """
    simulator = problem.simulator
    added = {simulator.slots[j].effect for j in np.flatnonzero(theta != simulator.base)}
    acting = [simulator.effects[i] for i in added.intersection(skip)]
    rows: list[Row] = []
    trials = []
    for index in range(len(simulator.effects)):
        names = columns_of(simulator.slots, index)
        columns = list(names.values())
        taken = any(are_exclusive(simulator.effects[index], other) for other in acting)
        if index in skip or taken or not columns:
            continue
        has_one = problem.num_listed(index) == 1
        for place, given in enumerate(_sizes(problem, theta, index, columns)):
            start = {names[name]: value for name, value in given.items()}
            is_only = has_one and place == 0
            tried = [start]
            if is_only and len(start) == 1:
                alone = columns if simulator.effects[index].independent else columns[:1]
                tried = [{j: theta[j] + _step_within(simulator, j, theta[j])} for j in alone]
            for start in tried:
                moved = next(j for j in columns if j in start)
                trials.append(Trial(index, start, (len(rows),), is_only))
                rows.append(Row(moved, start, start[moved] - theta[moved], -1))
    return rows, trials


def _sizes(problem: Problem[Simulator], theta: np.ndarray, index: int, columns: list[int]):
    """Return the sizes at which to try an effect; half and twice its size where it acts already."""
    simulator = problem.simulator
    effect = simulator.effects[index]
    none = effect.at(simulator.host, effect.target)
    slots = [simulator.slots[j].parameter for j in columns]
    acts = any(theta[j] != none[p.name] for j, p in zip(columns, slots, strict=True))
    starts = problem.starts(index)
    if not acts:
        return starts
    if problem.num_listed(index) == 1:
        return starts[:1]
    first, size = slots[0], float(theta[columns[0]])
    return tuple({first.name: min(factor * size, first.high)} for factor in (0.5, 2.0))


def with_opposites(
    problem: Problem[Simulator], rows: list[Row], trials: list[Trial], changes: np.ndarray
) -> tuple[list[Row], list[Trial], np.ndarray]:
    """Add the trials of what changes the opposite, which need no simulation.

    Of the sizes that a law lists, which are small. One that stands alone is extrapolated either
    way, and suggested ones have the right sign.

    Args:
        problem: What is screened.
        rows: One a trial.
        trials: The candidates at their sizes, in the order of the rows.
        changes: What the rows change, [M, rows].
    """
    simulator, of = problem.simulator, []
    more, others = list(rows), list(trials)
    for index, (row, trial) in enumerate(zip(rows, trials, strict=True)):
        law, names = simulator.effects[trial.effect], columns_of(simulator.slots, trial.effect)
        given = {name: trial.start[j] for name, j in names.items() if j in trial.start}
        if trial.is_only or given not in law.starts(simulator.host, law.target):
            continue
        opposite = law.opposite(given)
        if opposite is not None:
            start = {names[name]: value for name, value in opposite.items()}
            others.append(trial._replace(start=start, rows=(len(more),)))
            more.append(row._replace(values=start))
            of.append(index)
    return more, others, np.concatenate([changes, -changes[:, of]], axis=1)


def best_sizes(
    simulator: Simulator,
    rows: list[Row],
    trials: list[Trial],
    changes: np.ndarray,
    residual: np.ndarray,
) -> list[Trial]:
    """Return each candidate's trial that explains most by itself, in a way that is possible.

    A size that is extrapolated lies within its bounds then; any other acts in the direction tried.

    Args:
        simulator: With all candidates.
        rows: One a trial.
        trials: The candidates at their sizes, in the order of the rows.
        changes: What the rows change, [M, rows].
        residual: [M].
    """
    best: dict[int, tuple[tuple[bool, float], Trial]] = {}
    for row, trial, change in zip(rows, trials, changes.T, strict=True):
        norm = float(np.linalg.norm(change)) or np.inf
        along = -float(change @ residual) / norm
        slot = simulator.slots[row.column].parameter
        size = row.values[row.column] + (along / norm - 1.0) * row.step
        merit = (slot.low <= size <= slot.high if trial.is_only else along > 0, abs(along))
        if trial.effect not in best or merit > best[trial.effect][0]:
            best[trial.effect] = (merit, trial)
    return [trial for _, trial in best.values()]


def others(simulator: Simulator, theta: np.ndarray, rows: list[Row], trials: list[Trial]):
    """Add a row for each further parameter of the trials; return all rows and the trials.

    Parameters that act alone, and had a trial each, have a row already.
    """
    rows, extended = list(rows), []
    alone: dict[int, int] = {}
    for index, row in enumerate(rows):
        if len(row.values) == 1:
            alone.setdefault(row.column, index)
    for trial in trials:
        first, effect = trial.rows[0], simulator.effects[trial.effect]
        columns = list(columns_of(simulator.slots, trial.effect).values())
        chosen = [first]
        for j in columns:
            if j == rows[first].column:
                continue
            if trial.is_only and effect.independent and j in alone:
                chosen.append(alone[j])
                continue
            base = trial.start[j] if j in trial.start else float(theta[j])
            step = _step_within(simulator, j, base)
            is_alone = effect.independent and len(trial.start) == 1
            chosen.append(len(rows))
            values = {j: base + step} if is_alone else {**trial.start, j: base + step}
            rows.append(Row(j, values, step, -1 if is_alone else first))
        extended.append(trial._replace(rows=tuple(chosen)))
    return rows, extended


def _step_within(simulator: Simulator, column: int, value: float) -> float:
    p = simulator.slots[column].parameter
    return p.scale if value + p.scale <= p.high else -p.scale


def enlarge(
    problem: Problem[Simulator],
    rows: list[Row],
    trials: list[Trial],
    changes: np.ndarray,
    residual: np.ndarray,
    tried: Sequence[int],
) -> dict[int, tuple[Row, Trial]]:
    """Return larger steps for where a small one changes few samples of a signal much, most hardly.

    Contacts that open or close a step of the engine earlier change what follows by an amount that
    does not shrink with the perturbation: divided by a small step it drowns the rest. The new step
    makes the median samples of what it changes as large as the residual's there. (Friction changes
    few samples, too, but the same ones with either step.)

    Args:
        problem: What is screened.
        rows: One a trial.
        trials: The candidates at their sizes, in the order of the rows.
        changes: What the rows change, [M, rows].
        residual: [M].
        tried: Indices of the rows for which a larger step is sought.

    Returns:
        A row and the trial that starts from it, by the index of those they may replace.
    """
    num_signals, larger = problem.num_signals, {}
    for index in tried:
        row, trial, change = rows[index], trials[index], changes[:, index]
        if not trial.is_only or len(row.values) > 1:
            continue
        if not is_erratic(change, num_signals, UNEVEN):
            continue
        wanted, size = (typical_size(x, change, num_signals) for x in (residual, change))
        p = problem.simulator.slots[row.column].parameter
        base = row.values[row.column] - row.step
        room = abs((p.high if row.step > 0 else p.low) - base)
        step = np.sign(row.step) * min(wanted / size * abs(row.step), ROOM * room)
        if abs(step) > GROWN * abs(row.step):
            start = {row.column: base + step}
            larger[index] = Row(row.column, start, step, -1), trial._replace(start=start)
    return larger
