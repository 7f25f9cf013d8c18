"""Decide which effects are missing: fit the best candidates and let only those pass every gate.

Forward selection with full refits. The gates are evidence (corrected p-value), a physically
possible sign, the share explained, the fall of the held-out error and its lead over the
runner-up, each with a block-bootstrap interval, and stability over block resamples.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from garat_jax.diagnosis.contend import (
    Contender,
    complete,
    fit_contenders,
    fit_further,
    fit_refinements,
    with_evidence,
    with_twins,
)
from garat_jax.diagnosis.fit import Fit, count_timestep, fit, settle
from garat_jax.diagnosis.metric import Floor, Metric, is_above, make_metric, noise_floor
from garat_jax.diagnosis.problem import Problem, block_labels
from garat_jax.diagnosis.results import Candidate, Estimate, Interval, Named
from garat_jax.diagnosis.screen import EQUIVALENT, Score, cosine, screen
from garat_jax.effects import unit_at

SMALLEST_SHARE = 0.05
"""Share of the residual that an effect must explain."""
SIGNIFICANCE = 0.01
"""Largest corrected p-value."""
STABLE = 0.8
"""Share of block resamples in which an effect must be first."""
REFINED_ABOVE = 1.1
"""Multiple of the noise floor above which refinements of the best law are tried."""
TOO_CLOSE = 1.05
"""Ratio of two candidates' costs below which neither leads, whatever the resamples say."""
ROUNDS = 5
RESAMPLES = 500


class Step(NamedTuple):
    """One effect that was added, and the fit with it."""

    candidate: Candidate
    effect: int
    fit: Fit


class Outcome(NamedTuple):
    """What forward selection found.

    Attributes:
        before: The model as it is, initial states settled.
        after: With all selected effects.
        candidates: The first round's candidates, best first.
        steps: The effects added, in order, each with the fit at the time.
        selected: The effects kept in the end, with their final parameters.
        floor: Noise floor of the metric on the held-out segments.
        adequate: Whether the model as it is comes near its noise floor in every signal.
        best: The fit that says most of what is left: all selected effects, or the best candidate
            that was not; None where nothing is left or nothing was fitted.
    """

    before: Fit
    after: Fit
    candidates: tuple[Candidate, ...]
    steps: tuple[Step, ...]
    selected: tuple[Candidate, ...]
    floor: float
    adequate: bool
    best: Fit | None


def explain(problem: Problem, start: np.ndarray, say: Callable[[str], None]) -> Outcome:
    """Add effects as long as one passes every gate.

    Args:
        problem: The recordings and the model with every candidate.
        start: Initial states to start from, [S, nq + nv].
        say: Told what is being done.
    """
    before = settle(problem, problem.simulator.base, start)
    metric = make_metric(problem)
    floor = noise_floor(problem, metric, before)
    adequate = not is_above(problem, metric, before, floor)
    current, steps, first_round, best, added = before, [], (), None, None
    for number in range(ROUNDS):
        gap = is_above(problem, metric, current, floor)
        if number and not gap:
            break
        held = [step.effect for step in steps]
        say(f"scoring the candidates, round {number + 1}")
        scores = screen(problem, current, held)
        contenders = fit_contenders(problem, current, scores, say) if gap else []
        contenders = _refine(problem, metric, current, scores, contenders, floor, say)
        contenders = with_twins(problem, current, scores, contenders, say)
        contenders = with_evidence(problem, current, contenders, _num_tried(problem, scores))
        judged = _judge(problem, metric, current, scores, contenders, gap)
        first_round = first_round or tuple(candidate for candidate, _ in judged)
        candidate, contender = judged[0] if judged else (None, None)
        best = contender.fit if contender is not None else best
        if candidate is None or contender is None or not candidate.passes:
            break
        added = complete(problem, contender, say)
        current = added.fit
        steps.append(Step(candidate, contender.score.effect, current))
        steps, current = _prune(problem, before, steps, current, say)
        floor = noise_floor(problem, metric, current)
    if added is not None:
        known = added.timeless if current is added.fit else None
        current = known or count_timestep(problem, current)
        steps[-1] = steps[-1]._replace(fit=current)
    selected = tuple(_refreshed(problem, step, current) for step in steps)
    candidates = _without_superfluous(first_round, selected)
    best = current if steps else best
    if not is_above(problem, metric, current, floor):
        best = None
    return Outcome(before, current, candidates, tuple(steps), selected, floor.error, adequate, best)


def _num_tried(problem: Problem, scores: Sequence[Score]) -> int:
    """Return how many sizes of candidates were tried."""
    tried = (problem.simulator.effects[score.effect] for score in scores if not score.excluded)
    return sum(len(effect.starts(problem.simulator.host, effect.target)) for effect in tried)


def _refine(problem, metric: Metric, current: Fit, scores, contenders, floor: Floor, say):
    """Replace the best contender where a refinement, or more of its law, certainly explains more.

    Screening prefers the simpler law, because a refinement's threshold hides it there.
    """
    for find in (
        lambda best: fit_refinements(problem, current, best, scores, say),
        lambda best: fit_further(problem, best, say),
    ):
        best = min(contenders, key=lambda c: c.fit.cost.sum(), default=None)
        if best is None or not is_above(problem, metric, best.fit, floor, REFINED_ABOVE):
            break
        for contender in find(best):
            if _leads(problem, contender.fit, best.fit):
                replaced = (best.score.effect, contender.score.effect)
                others = (c for c in contenders if c.score.effect not in replaced)
                contenders, best = [contender, *others], contender
    return contenders


def _block_costs(problem: Problem, weight: np.ndarray | float, fits: Sequence[Fit], chosen):
    """Return each fit's cost in each block of the chosen segments, [num_fits, num_blocks]."""
    labels = np.unique(block_labels(problem)[chosen].ravel(), return_inverse=True)[1]
    return np.stack([np.bincount(labels, (f.residual[chosen] ** 2 * weight).ravel()) for f in fits])


def _leads(problem: Problem, first: Fit, second: Fit) -> bool:
    """Say whether one fit's cost is certainly lower than another's, by more than a trifle."""
    costs = _block_costs(problem, 1.0, [first, second], slice(None))
    drawn = np.log(_resamples(costs.shape[1]) @ costs.T)
    lead = drawn[:, 1] - drawn[:, 0]
    return bool(np.quantile(lead, 0.025) > 0 and np.median(lead) > np.log(TOO_CLOSE))


def _resamples(num_blocks: int) -> np.ndarray:
    """Return how often each block is drawn, [RESAMPLES, num_blocks]."""
    rng = np.random.default_rng(0)
    return rng.multinomial(num_blocks, np.full(num_blocks, 1 / num_blocks), RESAMPLES)


def _judge(problem, metric: Metric, current: Fit, scores, contenders: list[Contender], gap: bool):
    """Return (candidate, contender or None) for every score, best first."""
    judged = []
    if contenders:
        costs = _block_costs(problem, 1.0, [c.fit for c in contenders], slice(None))
        num_blocks = costs.shape[1]
        penalty = [len(c.score.columns) * np.log(num_blocks) / num_blocks for c in contenders]
        criterion = np.log(costs.sum(axis=1)) + penalty
        drawn = np.log(_resamples(num_blocks) @ costs.T) + penalty
        for index in np.argsort(criterion):
            judged.append(_judge_one(problem, metric, current, contenders, int(index), drawn))
        judged.sort(key=lambda pair: not pair[0].passes and pair[0].stability < STABLE)
        if judged[0][0].passes:
            judged = _with_timestep(problem, metric, judged)
    fitted = [c.score.effect for c in contenders]
    near = "the model's error is near the noise floor" if not gap else "others explain more"
    for score in scores:
        if score.effect not in fitted:
            sign = "its sign is physically impossible" if not score.possible else near
            judged.append((_unfitted(problem, score, score.excluded or sign), None))
    return judged


def _with_timestep(problem: Problem, metric: Metric, judged):
    """Show the first candidate, and those like it, as a timestep of 0 would have them.

    Candidates are held against each other, and added to, as they fit at the model's own.
    """
    shown = {judged[0][0].named, *judged[0][0].indistinguishable_from}
    for place, (candidate, contender) in enumerate(judged):
        if candidate.named in shown:
            fit = count_timestep(problem, contender.fit)
            candidate = dataclasses.replace(
                candidate,
                parameters=estimates(problem, contender.score.effect, fit),
                error_after=metric.error(fit.residual, ~problem.fitted),
            )
            judged[place] = (candidate, dataclasses.replace(contender, timeless=fit))
    return judged


def _alike(contenders: list[Contender], current: Fit, drawn: np.ndarray, index: int) -> list[int]:
    """Return the contenders that these recordings cannot tell from one of them."""
    change = [(c.fit.residual - current.residual).ravel() for c in contenders]
    size = [float(np.linalg.norm(c)) or 1.0 for c in change]
    alike = []
    for other in range(len(contenders)):
        if other == index:
            continue
        same = cosine(contenders[index].score, contenders[other].score)
        same = max(same, abs(float(change[index] @ change[other])) / (size[index] * size[other]))
        lead = np.quantile(drawn[:, other] - drawn[:, index], [0.025, 0.5, 0.975])
        close = lead[0] < 0 < lead[2] or abs(lead[1]) < np.log(TOO_CLOSE)
        if same > EQUIVALENT and close:
            alike.append(other)
    return alike


def _judge_one(problem, metric: Metric, current: Fit, contenders, index: int, drawn):
    contender, held_out = contenders[index], ~problem.fitted
    alike = _alike(contenders, current, drawn, index)
    others = [i for i in range(len(contenders)) if i != index and i not in alike]
    stability = float(np.mean(np.isin(drawn.argmin(axis=1), [index, *alike])))
    lead = np.inf
    if others:
        lead = float(np.quantile(drawn[:, others].min(axis=1) - drawn[:, index], 0.025))
    gain = _gain(problem, metric, current, contender.fit, held_out)
    share = 1.0 - contender.fit.cost[problem.fitted].sum() / current.cost[problem.fitted].sum()
    why = _failed_gate(contender.score, share, gain, lead, stability)
    effects = problem.simulator.effects
    named = [effects[contenders[i].score.effect] for i in alike]
    candidate = Candidate(
        effect=effects[contender.score.effect].kind,
        target=effects[contender.score.effect].target,
        parameters=estimates(problem, contender.score.effect, contender.fit),
        share=float(share),
        p_value=contender.score.p_value,
        error_after=metric.error(contender.fit.residual, held_out),
        held_out_gain=gain,
        stability=stability,
        indistinguishable_from=tuple(Named(e.kind, e.target) for e in named),
        passes=not why,
        why=why or "passes every gate",
    )
    return candidate, contender


def _failed_gate(score: Score, share: float, gain: Interval, lead: float, stability: float) -> str:
    """Return the first gate that is failed, or an empty string."""
    if score.p_value > SIGNIFICANCE:
        return f"not significant (corrected p = {score.p_value:.2g})"
    if share < SMALLEST_SHARE:
        return f"explains only {100 * share:.1f} % of the residual"
    if gain.low <= 0:
        return "the held-out error does not fall for certain"
    if lead <= 0:
        return "its lead over the runner-up is not certain"
    if stability < STABLE:
        return f"first in only {100 * stability:.0f} % of the resamples"
    return ""


def _gain(problem, metric: Metric, before: Fit, after: Fit, held_out) -> Interval:
    """Return the fall of the held-out error with a block-bootstrap interval."""
    costs = _block_costs(problem, metric.weight, [before, after], held_out)
    count = metric.count(held_out)
    drawn = np.sqrt(_resamples(costs.shape[1]) @ costs.T / count)
    whole = np.sqrt(costs.sum(axis=1) / count)
    low, high = np.quantile(drawn[:, 0] - drawn[:, 1], [0.025, 0.975])
    return Interval(float(whole[0] - whole[1]), float(low), float(high))


def estimates(problem: Problem, effect: int, fitted: Fit) -> dict[str, Estimate]:
    """Return the fitted parameters of an effect, and those set to another than no effect's."""
    simulator = problem.simulator
    estimates = {}
    for j, slot in enumerate(simulator.slots):
        if slot.effect != effect:
            continue
        unit = unit_at(slot.parameter, simulator.host, simulator.effects[effect].target)
        if j in fitted.free and j not in fitted.frozen:
            at = fitted.free.index(j)
            low, high = float(fitted.low[at]), float(fitted.high[at])
            estimates[slot.parameter.name] = Estimate(float(fitted.theta[j]), low, high, unit)
        elif fitted.theta[j] != slot.parameter.nominal:
            value = float(fitted.theta[j])
            estimates[slot.parameter.name] = Estimate(value, float("nan"), float("nan"), unit)
    return estimates


def _unfitted(problem: Problem, score: Score, why: str) -> Candidate:
    simulator, nan = problem.simulator, float("nan")
    effect = simulator.effects[score.effect]
    parameters = {}
    for j, size in zip(score.columns, score.size, strict=False):
        p = simulator.slots[j].parameter
        parameters[p.name] = Estimate(size, nan, nan, unit_at(p, simulator.host, effect.target))
    return Candidate(
        effect=effect.kind,
        target=effect.target,
        parameters=parameters,
        share=score.share,
        p_value=score.p_value,
        error_after=nan,
        held_out_gain=Interval(nan, nan, nan),
        stability=0.0,
        indistinguishable_from=(),
        passes=False,
        why=why,
    )


def _prune(problem: Problem, before: Fit, steps: list[Step], current: Fit, say):
    """Drop effects that a later one made superfluous: without them the cost stays as it is."""
    kept = steps
    for step in steps[:-1]:
        say(f"trying without {step.candidate.named}")
        others = [s.effect for s in kept if s.effect != step.effect]
        without = _fit_only(problem, current, others, current.cost[problem.fitted].sum())
        if not _leads(problem, current, without):
            kept = [other for other in kept if other.effect != step.effect]
            current = without
    if len(kept) == len(steps):
        return steps, current
    again = [_fit_only(problem, current, [s.effect for s in kept[:n]]) for n in range(1, len(kept))]
    return [s._replace(fit=f) for s, f in zip(kept, (*again, current), strict=True)], current


def _fit_only(problem: Problem, current: Fit, effects: Sequence[int], rival=np.inf) -> Fit:
    """Fit again with some of the selected effects, the others back at no effect."""
    slots = problem.simulator.slots
    present = np.asarray([slot.effect in effects for slot in slots])
    theta = np.where(present, current.theta, problem.simulator.base)
    free = [j for j in current.free if present[j]]
    return fit(problem, theta, current.start, free, rival=rival, sensitivity=current.sensitivity)


def _without_superfluous(candidates, selected) -> tuple[Candidate, ...]:
    """Where a later effect replaced the first one, say so and put the effects kept first."""
    kept = {c.named: place for place, c in enumerate(selected)}
    alike = {other for c in selected for other in c.indistinguishable_from}
    corrected = []
    for candidate in candidates:
        if candidate.passes and candidate.named not in {*kept, *alike}:
            why = f"superfluous with {' and '.join(map(str, kept))}"
            candidate = dataclasses.replace(candidate, passes=False, why=why)
        corrected.append(candidate)
    dropped = any("superfluous" in c.why for c in corrected)
    return tuple(sorted(corrected, key=lambda c: kept.get(c.named, len(kept)) if dropped else 0))


def _refreshed(problem: Problem, step: Step, final: Fit) -> Candidate:
    """Return a selected effect with its parameters from the final fit."""
    return dataclasses.replace(step.candidate, parameters=estimates(problem, step.effect, final))
