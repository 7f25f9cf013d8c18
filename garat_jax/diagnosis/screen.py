"""Score every candidate effect at the current fit, before any of them is fitted.

A candidate's sensitivity is the change of the predictions at a realistic size of its parameters; a
law with a threshold, which does nothing below it, is tried at several (`Effect.starts`; see
`trials`). What initial states and parameters already free can explain is projected out. P-values
(`evidence`) pay for every size that was tried and have Holm's correction (1979); those of the
candidates that are fitted are replaced.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from garat_jax.diagnosis.differences import ALIKE, cosines
from garat_jax.diagnosis.evidence import Evidence
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.robust import orthonormal, without
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.diagnosis.starts import Fit
from garat_jax.diagnosis.trials import (
    Row,
    Trial,
    best_sizes,
    enlarge,
    firsts,
    others,
    with_opposites,
)

EQUIVALENT = 0.95
"""Cosine of two candidates' contributions above which the recordings cannot tell them apart."""
WORTH_A_REFINEMENT = 0.8
"""Share of what a simpler law leaves unexplained that a refinement of it must get below."""
SCREENED = 24
"""Segments that are screened at least, evenly chosen; scores take many simulations each."""
HEAVY = 0.1
"""Share of all the squared residual from which a segment is screened wherever it lies."""
ENLARGED = 3
"""How often a size is enlarged at most that does something else when it is larger."""
VISIBLE = 3.0
"""Whitened change over a parameter's whole range below which the data cannot show it."""
WORTHWHILE = 0.01
"""Share of the residual that a further parameter of the same effect must explain."""


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
        changes: What each of `columns` changes there, likewise beyond what initial states and the
            parameters already free do, [M, k]; empty where it cannot be judged.
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
    changes: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 0)))


def screen(problem: Problem[Simulator], fit: Fit, skip: Sequence[int] = ()) -> list[Score]:
    """Score all candidates that are not in the model yet, largest share first.

    Args:
        problem: What is fitted.
        fit: The current fit.
        skip: Indices of effects that are in the model already.
    """
    chosen, evidence, weight = gather(problem, fit)
    problem = problem.take(chosen)
    rows, trials, changes = _measure(problem, fit.theta, evidence, weight, skip)
    raw = [_score(problem, evidence, weight, changes, rows, trial) for trial in trials]
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


def gather(problem: Problem, fit: Fit) -> tuple[np.ndarray, Evidence, np.ndarray]:
    """Return which segments to screen [C], what they say, and the weight of each residual [M]."""
    chosen, weight = _screened(problem, fit)
    evidence = Evidence(problem, fit, chosen)
    return chosen, evidence, np.repeat(weight, len(evidence.residual) // len(chosen))


def _screened(problem: Problem, fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Choose fitted segments evenly, and those that hold much of the residual.

    An effect that seldom acts, as a limit that is seldom reached, shows in those alone. Each of the
    others stands for several.

    Returns:
        Their indices, and the weights of their residuals, each [C].
    """
    fitted = np.flatnonzero(problem.fitted)
    is_heavy = fit.cost > HEAVY * fit.cost[fitted].sum()
    chosen = np.union1d(fitted[:: max(1, len(fitted) // SCREENED)], fitted[is_heavy[fitted]])
    light, of = (np.count_nonzero(~is_heavy[some]) for some in (chosen, fitted))
    return chosen, np.where(is_heavy[chosen] & (light > 0), np.sqrt(light / max(of, 1)), 1.0)


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


def _measure(
    problem: Problem[Simulator], theta: np.ndarray, evidence: Evidence, weight: np.ndarray, skip
):
    """Simulate the candidates at all their sizes, then the other parameters of the best size.

    Returns:
        Rows, a trial for each candidate, and what the rows change, [M, rows].
    """
    simulator, residual = problem.simulator, evidence.residual

    def change(rows: list[Row]) -> np.ndarray:
        thetas = np.tile(theta, (len(rows), 1))
        for moved, row in zip(thetas, rows, strict=True):
            moved[list(row.values)] = list(row.values.values())
        return evidence.change(thetas)

    rows, trials = firsts(problem, theta, skip)
    changes = change(rows)
    tried = range(len(rows))
    for _ in range(ENLARGED):
        larger = enlarge(problem, rows, trials, changes, residual, tried)
        if not larger:
            break
        found = change([row for row, _ in larger.values()])
        other = cosines(found, changes[:, list(larger)]) < ALIKE
        tried = [index for index, is_other in zip(larger, other, strict=True) if is_other]
        for index, new in zip(tried, found.T[other], strict=True):
            rows[index], trials[index] = larger[index]
            changes[:, index] = new
    rows, trials, changes = with_opposites(problem, rows, trials, changes)
    num_firsts = len(rows)
    best = best_sizes(simulator, rows, trials, weight[:, None] * changes, weight * residual)
    rows, trials = others(simulator, theta, rows, best)
    if more := rows[num_firsts:]:
        below = [changes[:, row.below] if row.below >= 0 else 0.0 * residual for row in more]
        changes = np.concatenate([changes, change(more) - np.stack(below, axis=1)], axis=1)
    return rows, trials, changes


def _score(
    problem: Problem,
    evidence: Evidence,
    weight: np.ndarray,
    changes: np.ndarray,
    rows: list[Row],
    trial: Trial,
) -> Score:
    """Judge one candidate at one size; `weight` [M] is that of the residuals."""
    chosen, residual = list(trial.rows), evidence.residual
    slots = [problem.simulator.slots[rows[i].column].parameter for i in chosen]
    matrix = changes[:, chosen]
    norm = np.linalg.norm(matrix, axis=0)
    steps = np.abs([rows[i].step for i in chosen])
    width = np.asarray([p.high - p.low for p in slots])
    is_tried = np.asarray([rows[i].column in trial.start for i in chosen]) & (not trial.is_only)
    times = np.divide(width, steps, out=np.ones_like(width), where=steps > 0)
    switched = np.asarray([rows[i].below == chosen[0] for i in chosen])
    wanted = abs(matrix[:, 0] @ residual) / max(norm[0] ** 2, 1e-300)  # times what is tried
    times = np.where(is_tried, np.where(switched, max(wanted, 1.0), 1.0), np.maximum(times, 1.0))
    seen = (norm * times > VISIBLE) & (norm > 1e-3 * norm.max(initial=0.0))
    given = [k for k, i in enumerate(chosen) if rows[i].column in trial.start]
    refines = bool(problem.simulator.effects[trial.effect].refines)  # else it is the simpler law
    if unseen := [slots[k].name for k in (0, *(given if refines else ())) if not seen[k]]:
        tried = "" if trial.is_only else "at the sizes tried, "
        reason = f"the recordings do not excite it: {tried}no signal depends on its {unseen[0]}"
        columns = tuple(rows[i].column for i in chosen)
        return Score(trial.effect, columns, (), {}, 0.0, 1.0, False, matrix[:, 0], reason)
    given = [k for k in given if seen[k]]
    residual, weighted = weight * residual, weight[:, None] * matrix
    needed = _needed(weighted, residual, seen, given)
    chosen, matrix, weighted = [chosen[i] for i in needed], matrix[:, needed], weighted[:, needed]
    factor = np.linalg.lstsq(weighted, -residual, rcond=1e-6)[0]
    contribution = weighted @ factor
    total = float(residual @ residual)
    share = 1.0 - float(np.sum((residual + contribution) ** 2)) / total if total > 0 else 0.0
    size, start, possible = _size(problem.simulator, rows, trial, chosen, factor)
    p_value = min(1.0, problem.num_tried(trial.effect) * evidence.p_value(trial.effect, matrix))
    columns = tuple(rows[i].column for i in chosen)
    what = (trial.effect, columns, size, start, share, p_value, possible, contribution)
    return Score(*what, changes=weighted)


def _size(simulator: Simulator, rows: list[Row], trial: Trial, chosen: list[int], factor):
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
