"""Score every candidate effect at the current fit, before any of them is fitted.

A candidate's sensitivity is the change of the predictions at a realistic size of its parameters; a
law with a threshold, which does nothing below it, is tried at several (`Effect.starts`). What
initial states and parameters already free can explain is projected out. Evidence is a Wald test of
what is left after common delay, sensor offsets and the integrator's error too, with blocks of time
as the independent units (Liang and Zeger 1986) and Holm's correction (1979).
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from garat_jax.diagnosis.fit import Fit
from garat_jax.diagnosis.problem import (
    Linearisation,
    Problem,
    StartSpace,
    block_labels,
    difference_steps,
    linearise,
    tall,
)
from garat_jax.diagnosis.robust import orthonormal, wald_test, without
from garat_jax.diagnosis.simulate import Simulator, columns_of
from garat_jax.effects import Effect

EQUIVALENT = 0.95
"""Cosine of two candidates' contributions above which the recordings cannot tell them apart."""
WORTH_A_REFINEMENT = 0.8
"""Share of what a simpler law leaves unexplained that a refinement of it must get below."""
SCREENED = 24
"""Segments that are screened at least, evenly chosen; scores take many simulations each."""
VISIBLE = 3.0
"""Whitened change over a parameter's whole range below which the data cannot show it."""
WORTHWHILE = 0.01
"""Share of the residual that a further parameter of the same effect must explain."""
DELAYS = ("actuator_delay", "sensor_delay")
"""Kinds that a common delay stands for: it is no nuisance to them."""
OFFSETS = (
    "torque_offset", "gravity_scale", "gravity_tilt", "payload_mass", "com_offset",
    "joint_stiffness", "encoder_offset",
)  # fmt: skip
"""Kinds whose static part an offset of a position sensor imitates: it is no nuisance to them."""


@dataclasses.dataclass(frozen=True)
class Score:
    """What the residual says about one candidate.

    Attributes:
        effect: Index among the simulator's effects.
        columns: Its parameters' indices in `theta` that the data excite.
        size: Expected values of these parameters.
        start: Where a fit starts, by column.
        share: Share of the residual's squares that it would explain.
        p_value: Probability of such evidence without the effect, corrected for the number of tests.
        possible: Whether the expected values are physically possible.
        contribution: Its part of the predictions on the fitted data, [M].
        excluded: Why it cannot be judged; empty if it can.
    """

    effect: int
    columns: tuple[int, ...]
    size: tuple[float, ...]
    start: Mapping[int, float]
    share: float
    p_value: float
    possible: bool
    contribution: np.ndarray
    excluded: str = ""


class _Row(NamedTuple):
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


class _Trial(NamedTuple):
    """One candidate tried at one size.

    Attributes:
        effect: Index among the simulator's effects.
        start: What "tried" sets, by column.
        rows: Indices of the rows that move one parameter each, the first parameter's first.
        is_only: Whether the law is tried at one size; then sizes are extrapolated from it.
    """

    effect: int
    start: dict[int, float]
    rows: tuple[int, ...]
    is_only: bool


class _Sensitivities(NamedTuple):
    """What the fitted data say once initial states and free parameters are removed.

    Attributes:
        residual: [M].
        changes: Of each row, [M, rows].
        delay: Columns of a common delay, [M, 0 or 1].
        offsets: Of an offset of each position sensor, [M, nq].
        integrator: Of the integrator's error, [M, 1].
        labels: Block of each residual, [M].
    """

    residual: np.ndarray
    changes: np.ndarray
    delay: np.ndarray
    offsets: np.ndarray
    integrator: np.ndarray
    labels: np.ndarray


def screen(problem: Problem[Simulator], fit: Fit, skip: Sequence[int] = ()) -> list[Score]:
    """Score all candidates that are not in the model yet, largest share first.

    Args:
        problem: What is fitted.
        fit: The current fit.
        skip: Indices of effects that are in the model already.
    """
    fitted = np.flatnonzero(problem.fitted)
    chosen = fitted[:: max(1, len(fitted) // SCREENED)]
    problem, start = problem.take(chosen), fit.start[chosen]
    rows, trials, sensitivities = _measure(problem, fit, start, skip)
    raw = [_score(problem, sensitivities, rows, trial) for trial in trials]
    judged = [score for score in raw if not score.excluded]
    order = np.argsort([score.p_value for score in judged])
    adjusted, largest = {}, 0.0
    for rank, index in enumerate(order):
        largest = max(largest, min(1.0, judged[index].p_value * (len(judged) - rank)))
        adjusted[judged[index].effect] = largest
    scores = [dataclasses.replace(s, p_value=adjusted.get(s.effect, 1.0)) for s in raw]
    simpler = [simpler_law(problem, s, scores) for s in scores]
    place = [s.share if o is None else min(s.share, o.share - 1e-9) for s, o in zip(
        scores, simpler, strict=True
    )]  # fmt: skip
    order = sorted(
        range(len(scores)),
        key=lambda i: (bool(scores[i].excluded), not scores[i].possible, -place[i]),
    )
    return [scores[i] for i in order]


def simpler_law(problem: Problem, score: Score, scores: Sequence[Score]) -> Score | None:
    """Return the score of a simpler law at the same place that leaves hardly more unexplained."""
    effect = problem.simulator.effects[score.effect]
    for other in scores:
        simpler = problem.simulator.effects[other.effect]
        is_simpler = simpler.target == effect.target and simpler.kind in effect.refines
        if is_simpler and 1 - score.share > WORTH_A_REFINEMENT * (1 - other.share):
            return other
    return None


def cosine(a: Score, b: Score) -> float:
    """Return how alike two candidates' contributions are, 0 to 1."""
    size = np.linalg.norm(a.contribution) * np.linalg.norm(b.contribution)
    return float(abs(a.contribution @ b.contribution) / size) if size > 0 else 0.0


def _firsts(simulator: Simulator, theta: np.ndarray, skip) -> tuple[list[_Row], list[_Trial]]:
    """List each candidate at each of its sizes, a row for each."""
    rows: list[_Row] = []
    trials = []
    for index, effect in enumerate(simulator.effects):
        names = columns_of(simulator.slots, index)
        columns = list(names.values())
        if index in skip or not columns:
            continue
        starts = _sizes(simulator, theta, effect, columns)
        for given in starts:
            start = {names[name]: value for name, value in given.items()}
            if len(starts) == 1 and len(start) == 1:
                step = _step_within(simulator, columns[0], theta[columns[0]])
                start = {columns[0]: theta[columns[0]] + step}
            moved = next(j for j in columns if j in start)
            trials.append(_Trial(index, start, (len(rows),), len(starts) == 1))
            rows.append(_Row(moved, start, start[moved] - theta[moved], -1))
    return rows, trials


def _sizes(simulator: Simulator, theta: np.ndarray, effect: Effect, columns: list[int]):
    """Return the sizes at which to try an effect; half and twice its size where it acts already."""
    starts = effect.starts(simulator.host, effect.target)
    none = effect.at(simulator.host, effect.target)
    slots = [simulator.slots[j].parameter for j in columns]
    acts = any(theta[j] != none[p.name] for j, p in zip(columns, slots, strict=True))
    if len(starts) == 1 or not acts:
        return starts
    first, size = slots[0], float(theta[columns[0]])
    return tuple({first.name: min(factor * size, first.high)} for factor in (0.5, 2.0))


def _best_sizes(trials: list[_Trial], changes: np.ndarray, residual: np.ndarray) -> list[_Trial]:
    """Return each candidate's trial that explains most by itself, in the direction tried."""
    best: dict[int, tuple[tuple[bool, float], _Trial]] = {}
    for trial in trials:
        change = changes[:, trial.rows[0]]
        along = -float(change @ residual) / (float(np.linalg.norm(change)) or np.inf)
        merit = (trial.is_only or along > 0, abs(along))
        if trial.effect not in best or merit > best[trial.effect][0]:
            best[trial.effect] = (merit, trial)
    return [trial for _, trial in best.values()]


def _others(simulator: Simulator, theta: np.ndarray, rows: list[_Row], trials: list[_Trial]):
    """Add a row for each further parameter of the trials; return all rows and the trials."""
    rows, extended = list(rows), []
    for trial in trials:
        first, effect = trial.rows[0], simulator.effects[trial.effect]
        columns = list(columns_of(simulator.slots, trial.effect).values())
        chosen = [first]
        for j in columns:
            if j == rows[first].column:
                continue
            base = trial.start[j] if j in trial.start else float(theta[j])
            step = _step_within(simulator, j, base)
            alone = effect.independent and len(trial.start) == 1
            chosen.append(len(rows))
            values = {j: base + step} if alone else {**trial.start, j: base + step}
            rows.append(_Row(j, values, step, -1 if alone else first))
        extended.append(trial._replace(rows=tuple(chosen)))
    return rows, extended


def _step_within(simulator: Simulator, column: int, value: float) -> float:
    p = simulator.slots[column].parameter
    return p.scale if value + p.scale <= p.high else -p.scale


def _measure(problem: Problem[Simulator], fit: Fit, start, skip):
    """Simulate the candidates at all their sizes, then the other parameters of the best size.

    Returns:
        Rows, a trial for each candidate, and the sensitivities.
    """
    simulator, segments = problem.simulator, problem.segments
    steps = difference_steps(problem, fit.theta, fit.free, 1e-2)
    lin = linearise(problem, fit.theta, start, fit.free, steps)
    remove = _Remover(lin)

    def change(rows: list[_Row]) -> np.ndarray:
        thetas = np.tile(fit.theta, (len(rows), 1))
        for theta, row in zip(thetas, rows, strict=True):
            theta[list(row.values)] = list(row.values.values())
        moved = simulator.linear_change(thetas, fit.theta, start, segments)
        return remove(problem.whiten_change(moved))

    residual = remove(lin.residual[None])[:, 0]
    firsts, trials = _firsts(simulator, fit.theta, skip)
    changes = change(firsts)
    rows, trials = _others(simulator, fit.theta, firsts, _best_sizes(trials, changes, residual))
    if more := rows[len(firsts) :]:
        below = [changes[:, row.below] if row.below >= 0 else 0.0 * residual for row in more]
        changes = np.concatenate([changes, change(more) - np.stack(below, axis=1)], axis=1)
    integrator = problem.integrator_error(fit.theta, start, lin.residual)
    nuisances = remove(np.stack([integrator, *_offsets(problem)]))
    delays = [t for t in trials if simulator.effects[t.effect].kind in DELAYS]
    common = [t for t in delays if simulator.effects[t.effect].target == "all"] or delays[:1]
    sensitivities = _Sensitivities(
        residual=residual,
        changes=changes,
        delay=changes[:, [t.rows[0] for t in common[:1]]],
        offsets=nuisances[:, 1:],
        integrator=nuisances[:, :1],
        labels=block_labels(problem).ravel(),
    )
    return rows, trials, sensitivities


def _offsets(problem: Problem) -> np.ndarray:
    """Return a constant error of each position sensor, whitened, [nq, S, N]."""
    segments = problem.segments
    num_position = problem.simulator.host.nq
    unit = np.eye(segments.measured.shape[2])[:num_position] / segments.noise
    offset = segments.weight[None, :, :, None] * unit[:, None, None, :]
    return offset.reshape(num_position, *segments.weight.shape[:1], -1)


class _Remover:
    """Removes what initial states and free parameters explain from columns [k, S, N]."""

    def __init__(self, lin: Linearisation):
        self._space = StartSpace(lin.start)
        self._free = orthonormal(tall(self._space.remove(lin.parameters)))

    def __call__(self, columns: np.ndarray) -> np.ndarray:
        rest = self._space.remove(np.moveaxis(columns, 0, -1))
        return without(tall(rest), self._free)


def _score(problem: Problem, s: _Sensitivities, rows: list[_Row], trial: _Trial) -> Score:
    """Judge one candidate at one size."""
    chosen = list(trial.rows)
    slots = [problem.simulator.slots[rows[i].column].parameter for i in chosen]
    matrix = s.changes[:, chosen]
    norm = np.linalg.norm(matrix, axis=0)
    steps = np.abs([rows[i].step for i in chosen])
    width = np.asarray([p.high - p.low for p in slots])
    is_tried = np.asarray([rows[i].column in trial.start for i in chosen]) & (not trial.is_only)
    seen = norm * np.where(is_tried, 1.0, np.maximum(width / steps, 1.0)) > VISIBLE
    seen &= norm > 1e-3 * norm.max(initial=0.0)
    given = [k for k, i in enumerate(chosen) if rows[i].column in trial.start]
    if unseen := [slots[k].name for k in (0, *given) if not seen[k]]:
        reason = f"the recordings do not excite it: its {unseen[0]} changes no signal"
        columns = tuple(rows[i].column for i in chosen)
        return Score(trial.effect, columns, (), {}, 0.0, 1.0, False, matrix[:, 0], reason)
    needed = _needed(matrix, s.residual, seen, given)
    chosen, matrix = [chosen[i] for i in needed], matrix[:, needed]
    factor = np.linalg.lstsq(matrix, -s.residual, rcond=1e-6)[0]
    contribution = matrix @ factor
    total = float(s.residual @ s.residual)
    share = 1.0 - float(np.sum((s.residual + contribution) ** 2)) / total if total > 0 else 0.0
    size, start, possible = _size(problem.simulator, rows, trial, chosen, factor)
    kind = problem.simulator.effects[trial.effect].kind
    nuisances = [s.integrator]
    nuisances += [] if kind in DELAYS else [s.delay]
    nuisances += [] if kind in OFFSETS else [s.offsets]
    p_value = wald_test(matrix, s.residual, orthonormal(np.concatenate(nuisances, 1)), s.labels)
    columns = tuple(rows[i].column for i in chosen)
    return Score(trial.effect, columns, size, start, share, p_value, possible, contribution)


def _size(simulator: Simulator, rows: list[_Row], trial: _Trial, chosen: list[int], factor):
    """Return the expected values of the chosen rows, where a fit starts, and if it is possible.

    Where the first parameter switches an effect on, it multiplies the others. A law with a
    threshold is no multiple of itself: it keeps the size at which it was tried.
    """
    columns = [rows[i].column for i in chosen]
    base, first = simulator.base[columns], simulator.slots[columns[0]].parameter
    if not trial.is_only:
        kept = [trial.start[j] if j in trial.start else float(simulator.base[j]) for j in columns]
        return tuple(kept), trial.start, bool(factor[0] > 0)
    size = base + factor * [rows[i].step for i in chosen]
    switched = np.asarray([rows[i].below >= 0 for i in chosen])
    multiplier = (size[0] - base[0]) / rows[chosen[0]].step or 1.0
    size = np.where(switched, base + (size - base) / multiplier, size)
    possible = bool(first.low - 1e-12 <= size[0] <= first.high + abs(first.scale))
    start = float(np.clip(size[0], first.low, first.high))
    if abs(start - base[0]) < 1e-3 * first.scale:
        start = base[0] + 0.1 * first.scale
    return tuple(float(value) for value in size), {columns[0]: start}, possible


def _needed(matrix: np.ndarray, residual: np.ndarray, seen: np.ndarray, given) -> list[int]:
    """Return the given columns and, one by one, those that explain a worthwhile part more."""
    chosen, others = list(given), [i for i in range(len(seen)) if seen[i] and i not in given]
    while others:
        basis = orthonormal(matrix[:, chosen])
        rest = without(residual[:, None], basis)[:, 0]
        fresh = without(matrix[:, others], basis)
        norm = np.linalg.norm(fresh, axis=0)
        gain = (fresh.T @ rest / np.maximum(norm, 1e-300)) ** 2 * (norm > 1e-6 * norm.max())
        best = int(np.argmax(gain))
        if gain[best] < WORTHWHILE * float(residual @ residual):
            break
        chosen.append(others.pop(best))
    return chosen
