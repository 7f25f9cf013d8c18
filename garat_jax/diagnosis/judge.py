"""Hold fitted candidates against each other, and say which passes every gate."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from garat_jax.diagnosis.contend import Contender, refines
from garat_jax.diagnosis.findings import Candidate, Estimate, Interval, Named
from garat_jax.diagnosis.metric import (
    AT_FLOOR,
    SMALLEST_SHARE,
    Floor,
    Metric,
    is_above,
    noise_floor,
)
from garat_jax.diagnosis.names import twins
from garat_jax.diagnosis.problem import FEWEST_SEGMENTS, Problem, block_labels
from garat_jax.diagnosis.screen import EQUIVALENT, Score, cosine
from garat_jax.diagnosis.starts import Fit
from garat_jax.effects import Parameter
from garat_jax.effects.units import unit_at

SIGNIFICANCE = 0.01
"""Largest corrected p-value."""
STABLE = 0.8
"""Share of block resamples in which an effect must be first."""
NEGLIGIBLE = 0.01
"""Part of the fall of the held-out error by which a resample may rise: one without any moment at
which the effect acts shows next to no change."""
TOO_CLOSE = 1.05
"""Ratio of two candidates' costs below which neither leads, whatever the resamples say."""
ROUNDING = 1e-9
"""Distance from a bound, relative to a parameter's `scale`, that is only rounding: descents
reach bounds by adding steps."""
TOO_FEW = "too few pieces of recordings to be certain"
NIL = "at a timestep of 0 it is not firmly told from what the model has"
"""Why one that passed every other gate is not added."""
PASSING = "passes every gate"
NO_CERTAIN_LEAD = "its lead over the runner-up is not certain"
BEHIND = "another explains more for certain"
NO_CERTAIN_GAIN = "the held-out error does not fall for certain"
ANOTHER_MAY_HELP = (NO_CERTAIN_LEAD, NO_CERTAIN_GAIN, BEHIND)
"""What may keep a candidate back only because of another effect that is missing, too."""
RESAMPLES = 500

Judged = list[tuple[Candidate, Contender | None]]
"""Candidates, best first, each with its fit if it was fitted."""


def judge(
    problem,
    metric: Metric,
    current: Fit,
    scores: Sequence[Score],
    contenders: Sequence[Contender],
    floor: Floor,
    in_turn: Mapping[int, Interval] = MappingProxyType({}),
) -> Judged:
    """Return every score's candidate, with its contender if it was fitted, best first.

    Of the one that fits best and those that do much the same, the best that passes every gate comes
    first: a lag has no evidence beside the delay that does what it does. Where they leave no more
    than noise and the integrator make, that is the one with the fewest parameters.

    Args:
        problem: What is fitted.
        metric: Of the errors.
        current: The fit of the effects selected so far.
        scores: What screening says.
        contenders: Those that were fitted.
        floor: The noise floor.
        in_turn: Falls of the error with each recording held out in turn, by effect, that count in
            place of those on what is held out; see `cross_validation.gains_in_turn`.
    """
    judged = []
    if contenders:
        costs = block_costs(problem, 1.0, [c.fit for c in contenders], slice(None))
        num_blocks = costs.shape[1]
        num_free = np.asarray([len(c.fit.free) for c in contenders])
        penalty = num_free * np.log(num_blocks) / num_blocks
        criterion = np.log(costs.sum(axis=1)) + penalty
        drawn = np.log(_resamples(num_blocks) @ costs.T) + penalty
        at_floor = [not is_above(problem, metric, c.fit, floor, AT_FLOOR) for c in contenders]
        alike = _alike(problem, current, contenders, at_floor, drawn, penalty)
        order = [int(index) for index in np.argsort(criterion)]
        found = {
            i: _judge_one(problem, metric, current, contenders, i, alike, drawn, in_turn)
            for i in order
        }
        near = {order[0], *alike[order[0]]}
        passing = [i for i in order if i in near and found[i][0].passes]
        if at_floor[order[0]]:
            passing.sort(key=lambda i: (not at_floor[i], len(contenders[i].fit.free)))
        best = next(iter(passing), order[0])
        judged = [found[best], *(found[i] for i in order if i != best)]
        judged.sort(key=lambda pair: not pair[0].passes and pair[0].stability < STABLE)
    fitted = [c.score.effect for c in contenders]
    is_near = not contenders and not is_above(problem, metric, current, floor)
    why = "the model's error is near the noise floor" if is_near else "others explain more"
    rest = [score for score in scores if score.effect not in fitted]
    for score in rest:
        reason = score.excluded or (why if score.possible else _impossible(problem, score))
        judged.append((_unfitted(problem, score, rest, reason), None))
    return judged


def _impossible(problem: Problem, score: Score) -> str:
    """Say why what a score expects is physically impossible."""
    parameter = problem.simulator.slots[score.columns[0]].parameter
    beyond = score.size[0] > parameter.high or score.size[0] < parameter.low < parameter.nominal
    return "the size it would need is beyond its bounds" if beyond else "its sign is impossible"


def _alike(
    problem: Problem,
    current: Fit,
    contenders: Sequence[Contender],
    at_floor: Sequence[bool],
    drawn: np.ndarray,
    penalty: np.ndarray,
) -> list[list[int]]:
    """List for each contender those that these recordings do not tell from it.

    They do much the same, and neither leads for certain or both leave no more than noise and the
    integrator make: what the one explains beyond that is not physics. Where both is so, they need
    not do the same: beside contacts, initial states that jump are most of what a fit changes. That
    a law has more parameters may tell it from one that it refines, and from no other.

    Args:
        problem: What is fitted.
        current: The fit of the effects selected so far.
        contenders: Those that were fitted.
        at_floor: Which of them leave no more than noise and the integrator make.
        drawn: Logarithms of their costs in resamples, with the penalty, [RESAMPLES, num].
        penalty: What each pays for its parameters, [num].
    """

    def are_alike(one: int, other: int) -> bool:
        same = do_the_same(current, contenders[one], contenders[other])
        owners = contenders[one].score.effect, contenders[other].score.effect
        are_related = refines(problem, *owners) or refines(problem, *owners[::-1])
        paid = [0.0] if are_related else [0.0, penalty[other] - penalty[one]]
        leads = (drawn[:, other] - drawn[:, one])[:, None] - paid
        low, middle, high = np.quantile(leads, [0.025, 0.5, 0.975], axis=0)
        neither_leads = low.min() < 0 < high.max()
        is_close = neither_leads or np.abs(middle).min() < np.log(TOO_CLOSE)
        nothing_left = at_floor[one] and at_floor[other]
        return bool((same and (is_close or nothing_left)) or (neither_leads and nothing_left))

    every = range(len(contenders))
    return [[j for j in every if j != i and are_alike(i, j)] for i in every]


def do_the_same(current: Fit, one: Contender, other: Contender) -> bool:
    """Say whether two contenders do much the same, as screened or as fitted, to a current fit."""
    a, b = ((c.fit.residual - current.residual).ravel() for c in (one, other))
    size = float(np.linalg.norm(a) * np.linalg.norm(b)) or 1.0
    return bool(max(cosine(one.score, other.score), abs(a @ b) / size) > EQUIVALENT)


def _judge_one(
    problem, metric: Metric, current: Fit, contenders, index: int, alike, drawn, in_turn
):
    contender, alike = contenders[index], alike[index]
    others = [i for i in range(len(contenders)) if i != index and i not in alike]
    stability = float(np.mean(np.isin(drawn.argmin(axis=1), [index, *alike])))
    lead = np.inf
    if others:
        rival, group = drawn[:, others].min(axis=1), drawn[:, [index, *alike]].min(axis=1)
        lead = float(np.quantile(rival - group, 0.025))
        if np.quantile(rival - drawn[:, index], 0.975) < 0:  # one that is not alike beats it
            lead = -np.inf
    gain = held_out_gain(problem, metric, current, contender.fit)
    share = 1.0 - contender.fit.cost[problem.fitted].sum() / current.cost[problem.fitted].sum()
    why, passing = TOO_FEW, PASSING
    if is_enough(problem):
        why = _failed_gate(contender.score, share, gain, lead, stability)
    if why == NO_CERTAIN_GAIN and contender.score.effect in in_turn:
        fallen = in_turn[contender.score.effect]
        why = _failed_gate(contender.score, share, fallen, lead, stability)
        passing = (
            f"{PASSING} with each recording held out in turn (the error falls by "
            f"{fallen.estimate:.3g}, {fallen.low:.3g} to {fallen.high:.3g}): those held out hardly "
            "show it"
        )
    effects = problem.simulator.effects
    named = [effects[contenders[i].score.effect] for i in alike]
    candidate = Candidate(
        effect=effects[contender.score.effect].kind,
        target=effects[contender.score.effect].target,
        parameters=estimates(problem, contender.score.effect, contender.fit),
        share=float(share),
        p_value=contender.score.p_value,
        error_after=metric.error(contender.fit.residual, ~problem.fitted),
        held_out_gain=gain,
        stability=stability,
        indistinguishable_from=tuple(Named(e.kind, e.target) for e in named),
        passes=not why,
        why=why or passing,
    )
    return candidate, contender


def is_enough(problem: Problem) -> bool:
    """Say whether there is enough, fitted and held out, to be certain of anything."""
    num_held_out = len(np.unique(block_labels(problem)[~problem.fitted]))
    return min(problem.num_fitted, num_held_out) >= FEWEST_SEGMENTS


def _failed_gate(score: Score, share: float, gain: Interval, lead: float, stability: float) -> str:
    """Return the first gate that is failed, or an empty string."""
    if score.p_value > SIGNIFICANCE:
        return f"not significant (corrected p = {score.p_value:.2g})"
    if share < SMALLEST_SHARE:
        return f"explains only {100 * share:.1f} % of the residual"
    if not is_certain(gain):
        return NO_CERTAIN_GAIN
    if lead <= 0:
        return NO_CERTAIN_LEAD if np.isfinite(lead) else BEHIND
    if stability < STABLE:
        return f"first in only {100 * stability:.0f} % of the resamples"
    return ""


def held_out_gain(problem: Problem, metric: Metric, before: Fit, after: Fit) -> Interval:
    """Return the fall of the held-out error with a block-bootstrap interval."""
    return fall(problem, metric, before, after, ~problem.fitted)


def fall(problem: Problem, metric: Metric, before: Fit, after: Fit, chosen: np.ndarray) -> Interval:
    """Return the fall of the error in chosen segments with a block-bootstrap interval."""
    costs = block_costs(problem, metric.weight, [before, after], chosen)
    count = metric.count(chosen)
    drawn = np.sqrt(_resamples(costs.shape[1]) @ costs.T / count)
    whole = np.sqrt(costs.sum(axis=1) / count)
    low, high = np.quantile(drawn[:, 0] - drawn[:, 1], [0.025, 0.975])
    return Interval(float(whole[0] - whole[1]), float(low), float(high))


def is_certain(gain: Interval) -> bool:
    """Say whether the held-out error falls for certain."""
    return gain.estimate > 0 and gain.low > -NEGLIGIBLE * gain.estimate


def estimates(problem: Problem, effect: int, fitted: Fit) -> dict[str, Estimate]:
    """Return the fitted parameters of an effect, and those set to another than no effect's."""
    simulator = problem.simulator
    estimates = {}
    for j, slot in enumerate(simulator.slots):
        if slot.effect != effect:
            continue
        unit = unit_at(slot.parameter, simulator.host, simulator.effects[effect].target)
        value = _at_end(slot.parameter, float(fitted.theta[j]))
        if j in fitted.free and j not in fitted.frozen:
            at = fitted.free.index(j)
            low, high = float(fitted.low[at]), float(fitted.high[at])
            estimates[slot.parameter.name] = Estimate(value, low, high, unit)
        elif fitted.theta[j] != slot.parameter.nominal:
            estimates[slot.parameter.name] = Estimate(value, float("nan"), float("nan"), unit)
    return estimates


def _at_end(parameter: Parameter, value: float) -> float:
    """Return the bound, or no effect, that a value comes to but for rounding; else the value."""
    ends = (parameter.nominal, parameter.low, parameter.high)
    return next((end for end in ends if abs(value - end) < ROUNDING * parameter.scale), value)


def _unfitted(problem: Problem, score: Score, others: Sequence[Score], why: str) -> Candidate:
    simulator, nan = problem.simulator, float("nan")
    effect = simulator.effects[score.effect]
    alike = twins(score, [o for o in others if o is not score and not o.excluded])
    named = [simulator.effects[other.effect] for other in alike]
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
        indistinguishable_from=tuple(Named(e.kind, e.target) for e in named),
        passes=False,
        why=why,
    )


def may_be_mended(candidate: Candidate) -> bool:
    """Say whether a candidate fails no gate but one that it may pass beside another effect."""
    return candidate.passes or candidate.why in ANOTHER_MAY_HELP


def leads(problem: Problem, first: Fit, second: Fit, by: float = TOO_CLOSE) -> bool:
    """Say whether one fit's cost is certainly lower than another's, by more than a factor."""
    costs = block_costs(problem, 1.0, [first, second], slice(None))
    drawn = np.log(_resamples(costs.shape[1]) @ costs.T)
    lead = drawn[:, 1] - drawn[:, 0]
    return bool(np.quantile(lead, 0.025) > 0 and np.median(lead) > np.log(by))


def simplest(problem: Problem, metric: Metric, best: Fit, others: Sequence[Fit]) -> Fit:
    """Return the simplest of those that leave no more than noise and that the best does not lead.

    That is the one with the fewest parameters, if it has fewer than the best, which is returned
    otherwise: a slow ripple, with three, does what a spring or gravity does.
    """
    simpler = [fit for fit in others if len(fit.free) < len(best.free)]
    if not simpler:
        return best
    floor = noise_floor(problem, metric, best)
    as_good = [
        fit
        for fit in simpler
        if not is_above(problem, metric, fit, floor, AT_FLOOR) and not leads(problem, best, fit)
    ]
    return min(as_good, key=lambda fit: (len(fit.free), fit.cost.sum()), default=best)


def block_costs(problem: Problem, weight: np.ndarray | float, fits: Sequence[Fit], chosen):
    """Return each fit's cost in each block of the chosen segments, [num_fits, num_blocks]."""
    labels = np.unique(block_labels(problem)[chosen].ravel(), return_inverse=True)[1]
    return np.stack([np.bincount(labels, (f.residual[chosen] ** 2 * weight).ravel()) for f in fits])


def _resamples(num_blocks: int) -> np.ndarray:
    """Return how often each block is drawn, [RESAMPLES, num_blocks]."""
    rng = np.random.default_rng(0)
    return rng.multinomial(num_blocks, np.full(num_blocks, 1 / num_blocks), RESAMPLES)
