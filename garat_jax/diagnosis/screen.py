"""Score every candidate effect at the current fit, before any of them is fitted.

A candidate's sensitivity is the change of the predictions at a realistic size of its parameters.
What initial states and parameters already free can explain is projected out. Evidence is a Wald
test of what is left after common delay, sensor offsets and the integrator's error too, with
blocks of time as the independent units (Liang and Zeger 1986) and Holm's correction (1979).
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from garat_jax.diagnosis.fit import (
    Fit,
    Linearisation,
    Problem,
    StartSpace,
    block_labels,
    difference_steps,
    linearise,
)
from garat_jax.diagnosis.simulate import Simulator

EQUIVALENT = 0.95
"""Cosine of two candidates' contributions above which the recordings cannot tell them apart."""
VISIBLE = 3.0
"""Whitened change over a parameter's whole range below which the data cannot show it."""
WORTHWHILE = 0.01
"""Share of the residual that a further parameter of the same effect must explain."""
DELAYS = ("actuator_delay",)
"""Kinds that a common delay stands for: it is no nuisance to them."""
OFFSETS = ("torque_offset", "gravity_scale", "payload_mass")
"""Kinds whose static part an offset of a position sensor imitates: it is no nuisance to them."""


@dataclasses.dataclass(frozen=True)
class Score:
    """What the residual says about one candidate.

    Attributes:
        effect: Index among the simulator's effects.
        columns: Its parameters' indices in `theta` that the data excite.
        size: Expected values of these parameters.
        share: Share of the residual's squares that it would explain.
        p_value: Probability of such evidence without the effect, corrected for the number of tests.
        possible: Whether the expected values are physically possible.
        contribution: Its part of the predictions on the fitted data, [M].
        excluded: Why it cannot be judged; empty if it can.
    """

    effect: int
    columns: tuple[int, ...]
    size: tuple[float, ...]
    share: float
    p_value: float
    possible: bool
    contribution: np.ndarray
    excluded: str = ""


class _Sensitivities(NamedTuple):
    """Columns on the fitted data, initial states and free parameters removed, [M, k] each."""

    residual: np.ndarray
    candidates: dict[int, np.ndarray]
    columns: dict[int, tuple[int, ...]]
    steps: dict[int, float]
    delay: np.ndarray
    offsets: np.ndarray
    integrator: np.ndarray
    labels: np.ndarray


def screen(problem: Problem, fit: Fit, skip: Sequence[int] = ()) -> list[Score]:
    """Score all candidates that are not in the model yet, largest share first.

    Args:
        problem: What is fitted.
        fit: The current fit.
        skip: Indices of effects that are in the model already.
    """
    sensitivities = _measure(problem, fit, skip)
    raw = [_score(problem, sensitivities, i) for i in sensitivities.candidates]
    judged = [score for score in raw if not score.excluded]
    order = np.argsort([score.p_value for score in judged])
    adjusted, largest = {}, 0.0
    for rank, index in enumerate(order):
        largest = max(largest, min(1.0, judged[index].p_value * (len(judged) - rank)))
        adjusted[judged[index].effect] = largest
    scores = [dataclasses.replace(s, p_value=adjusted.get(s.effect, 1.0)) for s in raw]
    return sorted(scores, key=lambda s: (bool(s.excluded), not s.possible, -s.share))


def cosine(a: Score, b: Score) -> float:
    """Return how alike two candidates' contributions are, 0 to 1."""
    size = np.linalg.norm(a.contribution) * np.linalg.norm(b.contribution)
    return float(abs(a.contribution @ b.contribution) / size) if size > 0 else 0.0


def _perturbations(simulator: Simulator, theta: np.ndarray, skip) -> tuple[list, np.ndarray]:
    """Return (column, switch or None, step) for each thing to perturb; columns may come twice."""
    listed = []
    for j, slot in enumerate(simulator.slots):
        if slot.effect in skip:
            continue
        first = next(k for k, s in enumerate(simulator.slots) if s.effect == slot.effect)
        listed.append((j, None))
        if j != first:
            listed.append((j, first))
    steps = []
    for j, _ in listed:
        p = simulator.slots[j].parameter
        steps.append(p.scale if theta[j] + p.scale <= p.high else -p.scale)
    return listed, np.asarray(steps)


def _measure(problem: Problem, fit: Fit, skip) -> _Sensitivities:
    simulator, segments, fitted = problem.simulator, problem.segments, problem.fitted
    steps = difference_steps(problem, fit.theta, fit.free, 1e-2)
    lin = linearise(problem, fit.theta, fit.start, fit.free, steps)
    listed, steps = _perturbations(simulator, fit.theta, skip)
    thetas = np.tile(fit.theta, (len(listed), 1))
    for row, (j, switch) in enumerate(listed):
        thetas[row, j] += steps[row]
        if switch is not None:
            thetas[row, switch] += simulator.slots[switch].parameter.scale
    starts = np.tile(fit.start, (len(listed), 1, 1))
    changes = problem.whiten(simulator.predict(thetas, starts, segments)) - lin.residual
    for row, (_, switch) in enumerate(listed):
        if switch is not None:
            changes[row] -= changes[listed.index((switch, None))]
    integrator = problem.integrator_error(fit.theta, fit.start, lin.residual)
    nuisances = np.stack([integrator, *_offsets(problem)])
    remove = _Remover(lin, fitted)
    columns, candidates = {}, {}
    for effect in dict.fromkeys(simulator.slots[j].effect for j, _ in listed):
        chosen = _choose_rows(simulator, listed, changes, effect)
        columns[effect] = tuple(listed[row][0] for row in chosen)
        candidates[effect] = remove(changes[chosen])
    delays = [i for i in candidates if simulator.effects[i].kind in DELAYS]
    common = [i for i in delays if simulator.effects[i].target == "all"] or delays[:1]
    nuisances = remove(nuisances)
    nothing = np.zeros((len(nuisances), 0))
    return _Sensitivities(
        residual=remove(lin.residual[None])[:, 0],
        candidates=candidates,
        columns=columns,
        steps=dict(zip((j for j, _ in listed), steps, strict=True)),
        delay=candidates[common[0]] if common else nothing,
        offsets=nuisances[:, 1:],
        integrator=nuisances[:, :1],
        labels=block_labels(problem)[fitted].ravel(),
    )


def _choose_rows(simulator: Simulator, listed, changes, effect: int) -> list[int]:
    """Choose for each parameter its change alone, or switched on where alone it does nothing."""
    rows: dict[int, int] = {}
    for row, (j, switch) in enumerate(listed):
        if simulator.slots[j].effect != effect:
            continue
        if switch is None or not np.any(changes[rows[j]]):
            rows[j] = row
    return list(rows.values())


def _offsets(problem: Problem) -> np.ndarray:
    """Return a constant error of each position sensor, whitened, [nq, S, N]."""
    segments = problem.segments
    num_position = problem.simulator.host.nq
    unit = np.eye(segments.measured.shape[2])[:num_position] / segments.noise
    offset = segments.weight[None, :, :, None] * unit[:, None, None, :]
    return offset.reshape(num_position, *segments.weight.shape[:1], -1)


class _Remover:
    """Removes what initial states and free parameters explain from columns [k, S, N]."""

    def __init__(self, lin: Linearisation, fitted: np.ndarray):
        self._fitted = fitted
        self._space = StartSpace(lin.start[fitted])
        free = self._space.remove(lin.parameters[fitted])
        self._free = _orthonormal(_tall(free))

    def __call__(self, columns: np.ndarray) -> np.ndarray:
        rest = self._space.remove(np.moveaxis(columns[:, self._fitted], 0, -1))
        return _without(_tall(rest), self._free)


def _tall(columns: np.ndarray) -> np.ndarray:
    """Turn columns [S, N, k] into [S * N, k]."""
    return columns.reshape(columns.shape[0] * columns.shape[1], columns.shape[2])


def _orthonormal(columns: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of columns [M, k] without the directions that are zero."""
    scale = np.linalg.norm(columns, axis=0)
    columns = columns[:, scale > 0] / scale[scale > 0]
    if columns.shape[1] == 0:
        return columns
    u, s, _ = np.linalg.svd(columns, full_matrices=False)
    return u[:, s > 1e-6 * s[0]]


def _without(columns: np.ndarray, basis: np.ndarray) -> np.ndarray:
    return columns - basis @ (basis.T @ columns)


def _score(problem: Problem, s: _Sensitivities, effect: int) -> Score:
    simulator = problem.simulator
    matrix, columns = s.candidates[effect], s.columns[effect]
    steps = np.asarray([s.steps[j] for j in columns])
    slots = [simulator.slots[j].parameter for j in columns]
    change = np.linalg.norm(matrix, axis=0) / np.abs(steps)
    seen = change * np.asarray([p.high - p.low for p in slots]) > VISIBLE
    seen &= np.linalg.norm(matrix, axis=0) > 1e-3 * np.linalg.norm(matrix, axis=0).max(initial=0.0)
    if not seen[0]:
        name = slots[0].name
        reason = f"the recordings do not excite it: its {name} changes no signal"
        return Score(effect, columns, (), 0.0, 1.0, False, matrix[:, 0], reason)
    needed = _needed(matrix, s.residual, seen)
    columns, matrix, steps = tuple(columns[i] for i in needed), matrix[:, needed], steps[needed]
    factor = np.linalg.lstsq(matrix, -s.residual, rcond=1e-6)[0]
    contribution = matrix @ factor
    total = float(s.residual @ s.residual)
    share = 1.0 - float(np.sum((s.residual + contribution) ** 2)) / total if total > 0 else 0.0
    base = np.asarray([simulator.slots[j].base for j in columns])
    size = base + factor * steps
    if len(columns) > 1:  # the first parameter switches the effect on and multiplies the others
        size[1:] = base[1:] + factor[1:] * steps[1:] * steps[0] / (size[0] - base[0] or steps[0])
    first = slots[0]
    possible = bool(first.low - 1e-12 <= size[0] <= first.high + abs(first.scale))
    kind = simulator.effects[effect].kind
    nuisances = [s.integrator]
    nuisances += [] if kind in DELAYS else [s.delay]
    nuisances += [] if kind in OFFSETS else [s.offsets]
    p_value = _wald(matrix, s.residual, _orthonormal(np.concatenate(nuisances, 1)), s.labels)
    return Score(effect, columns, tuple(size), share, p_value, possible, contribution)


def _needed(matrix: np.ndarray, residual: np.ndarray, seen: np.ndarray) -> list[int]:
    """Return the first column and, one by one, those that explain a worthwhile part more."""
    chosen, others = [0], [i for i in range(1, len(seen)) if seen[i]]
    while others:
        basis = _orthonormal(matrix[:, chosen])
        rest = _without(residual[:, None], basis)[:, 0]
        fresh = _without(matrix[:, others], basis)
        norm = np.linalg.norm(fresh, axis=0)
        gain = (fresh.T @ rest / np.maximum(norm, 1e-300)) ** 2 * (norm > 1e-6 * norm.max())
        best = int(np.argmax(gain))
        if gain[best] < WORTHWHILE * float(residual @ residual):
            break
        chosen.append(others.pop(best))
    return chosen


def _wald(matrix, residual, nuisance, labels) -> float:
    """Return the p-value of a robust test that all of the columns' coefficients are 0."""
    unit = np.linalg.norm(matrix, axis=0)
    matrix, residual = (
        _without(matrix / unit, nuisance),
        residual - nuisance @ (nuisance.T @ residual),
    )
    norm = np.linalg.norm(matrix, axis=0)
    matrix = matrix[:, norm > 1e-6]
    if matrix.shape[1] == 0:
        return 1.0
    bread = np.linalg.pinv(matrix.T @ matrix, rcond=1e-9)
    factor = -bread @ (matrix.T @ residual)
    rest = residual + matrix @ factor
    scores = np.stack([np.bincount(labels, column * rest) for column in matrix.T], axis=1)
    covariance = bread @ (scores.T @ scores) @ bread
    num_blocks, num = len(np.unique(labels)), matrix.shape[1]
    statistic = float(factor @ np.linalg.pinv(covariance) @ factor) / num
    return float(stats.f.sf(statistic, num, max(num_blocks - num, 1)))
