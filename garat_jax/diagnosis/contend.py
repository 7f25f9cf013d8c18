"""Fit the candidates that screening puts first, so that they can be held against each other.

A candidate that was fitted is tested anew, by what its fit changes in all the segments that are
fitted: screening looks at some of them, at a size that is only realistic.
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from garat_jax.diagnosis.evidence import Evidence
from garat_jax.diagnosis.fit import fit
from garat_jax.diagnosis.names import is_predicted, renamed, stands_for, twins
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.screen import EQUIVALENT, VISIBLE, Score, cosine, simpler_law
from garat_jax.diagnosis.slots import columns_of
from garat_jax.diagnosis.starts import Fit
from garat_jax.diagnosis.timestep import count_timestep

CONTENDERS = 4
"""How many candidates are fitted each round; see `fit_contenders`."""
FIRM = 2.0
"""Half-widths of its 95 % interval by which a parameter must differ from no effect, at a timestep
of 0, to be fitted in the end: one that screening left out, or the only one of an effect. One half-
width is too few among some hundred candidates."""
LIKELY = 0.02
"""Share of the residual that a candidate must be expected to explain to be fitted."""
HOPELESS = 8.0
"""What a candidate is expected to leave unexplained, relative to what the best one left when it was
fitted, above which it is not fitted; the runner-up always is."""


@dataclasses.dataclass(frozen=True)
class Contender:
    """A candidate that was fitted.

    Attributes:
        score: What screening said, with the fit's p-value once it was tested.
        fit: All selected effects and this one, fitted.
        timeless: As a timestep of 0 would have it, where that was measured.
        is_paired: Whether it is the stronger of two that may explain far more; see `together`.
    """

    score: Score
    fit: Fit
    timeless: Fit | None = None
    is_paired: bool = False


def fit_contenders(
    problem: Problem,
    current: Fit,
    refinable: Sequence[int],
    scores: Sequence[Score],
    say: Callable[[str], None],
    num: int = CONTENDERS,
) -> list[Contender]:
    """Fit the candidates that may be the missing effect.

    Args:
        problem: The recordings and the model with every candidate.
        current: The fit of the effects selected so far.
        refinable: Indices of those of them in whose place a refinement may come.
        scores: What screening says, best first.
        say: Told what is being done.
        num: How many, those like the first counted as one.
    """
    contenders = _fit_refined(problem, current, refinable, scores, say)
    done = {c.score.effect for c in contenders}
    likely = likely_ones(problem, [score for score in scores if score.effect not in done])
    for score in _first_of(likely, num):
        rival = min((c.fit.cost[problem.fitted].sum() for c in contenders), default=np.inf)
        hopeless = 1.0 - score.share > HOPELESS * rival / current.cost[problem.fitted].sum()
        alike = any(cosine(score, c.score) > EQUIVALENT for c in contenders)
        if not hopeless or alike or len(contenders) < 2:
            contenders.append(fit_one(problem, current, score, rival, say))
    return contenders


def likely_ones(problem: Problem, scores: Sequence[Score]) -> list[Score]:
    """Return the candidates that are expected to explain a good part, of equals the first."""
    likely = [score for score in scores if score.possible and score.share > LIKELY]
    likely = [s for s in likely if s.share > 0.25 * likely[0].share]
    likely = [s for s in likely if not simpler_law(problem, s, likely)]
    return [s for i, s in enumerate(likely) if not twins(s, likely[:i])]


def best_of(contenders: Sequence[Contender]) -> Contender | None:
    """Return the contender that fits best, if there is any."""
    return min(contenders, key=lambda contender: contender.fit.cost.sum(), default=None)


def _first_of(likely: Sequence[Score], num: int) -> list[Score]:
    """Return the first candidates that are not like the very first, and all that are."""
    chosen, num_others = [], 0
    for score in likely:
        is_alike = score is likely[0] or cosine(score, likely[0]) > EQUIVALENT
        if is_alike or num_others < num - 1:
            chosen.append(score)
        num_others += not is_alike
    return chosen


def fit_refinements(
    problem: Problem,
    current: Fit,
    contender: Contender,
    scores: Sequence[Score],
    say: Callable[[str], None],
    hidden_only: bool,
) -> list[Contender]:
    """Fit the laws that refine a contender's at its place.

    A law that acted before it was fitted is left as it is.

    Args:
        problem: The recordings and the model with every candidate.
        current: The fit of the effects selected so far.
        contender: Whose law they refine.
        scores: What screening says.
        say: Told what is being done.
        hidden_only: Leave out the laws that screening sees, because they have no threshold.
    """
    simple = contender.score.effect
    if acts(problem, simple, current.theta):
        return []
    rival = contender.fit.cost[problem.fitted].sum()
    return [
        fit_one(problem, current, refined, rival, say)
        for score in scores
        if refines(problem, score.effect, simple)
        and (refined := as_refined(problem, score, contender.fit.theta, [simple]))
        and (not hidden_only or problem.num_listed(score.effect) > 1)
    ]


def _fit_refined(
    problem: Problem,
    current: Fit,
    held: Sequence[int],
    scores: Sequence[Score],
    say: Callable[[str], None],
) -> list[Contender]:
    """Fit the laws that refine those of effects selected before, each in the place of the simpler.

    Beside what was found since, or over longer segments, the difference may show. Those are fitted
    that screening expects to explain something more, whatever the sign. A law that acted before
    anything was selected is left as it is.

    Args:
        problem: The recordings and the model with every candidate.
        current: The fit of the effects selected so far.
        held: Their indices.
        scores: What screening says.
        say: Told what is being done.
    """
    simulator, found = problem.simulator, []
    added = [effect for effect in held if not acts(problem, effect, simulator.base)]
    for score in scores:
        if score.excluded or score.share < LIKELY:
            continue
        simpler = [i for i in added if refines(problem, score.effect, i)]
        if refined := as_refined(problem, score, current.theta, simpler):
            without = set_aside(problem, current, simpler)
            found.append(fit_one(problem, without, refined, np.inf, say))
    return found


def set_aside(problem: Problem, current: Fit, effects: Sequence[int]) -> Fit:
    """Return a fit in whose parameters some effects do not act; nothing is fitted again."""
    own = [j for i in effects for j in columns_of(problem.simulator.slots, i).values()]
    theta = current.theta.copy()
    theta[own] = problem.simulator.base[own]
    free = tuple(j for j in current.free if j not in own)
    return dataclasses.replace(current, theta=theta, free=free)


def acts(problem: Problem, effect: int, theta: np.ndarray) -> bool:
    """Say whether an effect acts under some parameters, [num_parameters]."""
    simulator, law = problem.simulator, problem.simulator.effects[effect]
    none = law.at(simulator.host, law.target)
    columns = columns_of(simulator.slots, effect)
    return any(theta[j] != none[name] for name, j in columns.items())


def refines(problem: Problem, finer: int, simpler: int) -> bool:
    """Say whether one effect's law refines another's at its place."""
    one, other = (problem.simulator.effects[i] for i in (finer, simpler))
    return one.target == other.target and other.kind in one.refines


def as_refined(problem: Problem, score: Score, theta: np.ndarray, simpler: Sequence[int]):
    """Return the score of a law that begins as simpler ones were fitted; None if it cannot.

    Args:
        problem: What is fitted.
        score: What screening says of the law.
        theta: The parameters of the simpler ones, among all, [num_parameters].
        simpler: Indices of these effects, whose laws it refines; there may be none.
    """
    simulator = problem.simulator
    columns = columns_of(simulator.slots, score.effect)
    start: dict[int, float] = {}
    for law in simulator.with_parameters([float(value) for value in theta], simpler):
        alike = type(simulator.effects[score.effect]).refined_from(law)
        start |= {columns[name]: value for name, value in alike.items()}
    return dataclasses.replace(score, columns=tuple(start), start=start) if start else None


def fit_further(
    problem: Problem, contender: Contender, say: Callable[[str], None]
) -> list[Contender]:
    """Fit a contender with its further parameters, if screening left some out.

    Beside a large effect, a parameter that matters later explains a small part only.
    """
    columns = columns_of(problem.simulator.slots, contender.score.effect).values()
    further = [j for j in columns if j not in contender.fit.free]
    if not further:
        return []
    effect = problem.simulator.effects[contender.score.effect]
    say(f"fitting every parameter of {effect.kind} at {effect.target}")
    free = (*contender.fit.free, *further)
    start, sensitivity = contender.fit.start, contender.fit.sensitivity
    fitted = fit(problem, contender.fit.theta, start, free, sensitivity=sensitivity)
    score = dataclasses.replace(contender.score, columns=(*contender.score.columns, *further))
    return [dataclasses.replace(contender, score=score, fit=fitted, timeless=None)]


def complete(problem: Problem, best: Contender, say: Callable[[str], None]) -> Contender:
    """Return a contender with those further parameters that firmly differ from no effect.

    However little such a parameter explains, without it the others make up for it.
    """
    for fuller in fit_further(problem, best, say):
        further = [j for j in fuller.fit.free if j not in best.fit.free]
        firm = [j for j in further if is_firm(problem, fuller.fit, j)]
        if not firm:
            continue
        timeless = count_timestep(problem, fuller.fit)
        nil = [j for j in further if j not in firm or not is_firm(problem, timeless, j)]
        if not nil:
            return dataclasses.replace(fuller, timeless=timeless)
        if len(nil) < len(further):
            return _without(problem, fuller, nil)
    return best


def is_firm(problem: Problem, fitted: Fit, column: int) -> bool:
    """Say whether a fitted parameter differs from no effect by far; see `FIRM`."""
    return firmness(problem, fitted, column) > FIRM


def firmness(problem: Problem, fitted: Fit, column: int) -> float:
    """Return by how many half-widths of its interval a fitted parameter differs from no effect."""
    place = fitted.free.index(column)
    half = 0.5 * float(fitted.high[place] - fitted.low[place])
    off = abs(float(fitted.theta[column] - problem.simulator.base[column]))
    return off / max(half, 1e-300)


def _without(problem: Problem, fuller: Contender, columns: Sequence[int]) -> Contender:
    """Fit a contender again without some parameters."""
    near, theta = fuller.fit, fuller.fit.theta.copy()
    theta[list(columns)] = problem.simulator.base[list(columns)]
    free = [j for j in near.free if j not in columns]
    fitted = fit(problem, theta, near.start, free, sensitivity=near.sensitivity)
    kept = tuple(j for j in fuller.score.columns if j not in columns)
    return Contender(dataclasses.replace(fuller.score, columns=kept), fitted)


def with_twins(
    problem: Problem,
    current: Fit,
    scores: Sequence[Score],
    contenders: Sequence[Contender],
    say: Callable[[str], None],
) -> list[Contender]:
    """Add the candidates that are a contender under another name.

    Two geoms that touch nothing but each other have the same contacts; a motor's back EMF is the
    damping of the joint that it drives alone, where the integrator takes both alike and no limit of
    the force cuts in: one fit serves both. Where segments that were not screened show a difference,
    the other has a fit of its own.
    """
    screened = {score.effect: score for score in scores}
    fitted = {contender.score.effect for contender in contenders}
    others = [s for s in scores if not s.excluded and s.possible and s.effect not in fitted]
    found = []
    for contender in contenders:
        like = screened[contender.score.effect]
        for score in twins(like, others):
            same = _as_twin(problem, current, contender, like, score)
            rival = contender.fit.cost[problem.fitted].sum()
            found.append(same or fit_one(problem, current, score, rival, say))
    return [*contenders, *found]


def _as_twin(problem: Problem, current: Fit, twin: Contender, like: Score, score: Score):
    """Return a contender's fit under another name; None if that predicts something else.

    Args:
        problem: What is fitted.
        current: The fit of the effects selected so far.
        twin: The contender.
        like: What screening said of it.
        score: What it said of the other: the same, at the same sizes.
    """
    names = stands_for(problem, like, score)
    if not names.keys() >= {*twin.score.columns}:
        return None
    columns = tuple(names[j] for j in twin.score.columns)
    values = twin.fit.theta[list(twin.score.columns)]
    if np.any(problem.within_bounds(columns, values) != values):
        return None
    fitted = renamed(twin.fit, twin.score.columns, columns, without=current.theta)
    same = Contender(dataclasses.replace(score, columns=columns), fitted)
    return same if is_predicted(problem, fitted) else None


def under_another_name(
    problem: Problem, fitted: Fit, contender: Contender, other: Contender
) -> Fit | None:
    """Return a fit in which a law is called another that had one fit with it when both came up.

    Args:
        problem: What is fitted.
        fitted: The fit with the law, and what was added since.
        contender: The law as it came up.
        other: The other law, as it came up.

    Returns:
        None if the two had fits of their own, or predict something else by now.
    """
    if other.fit.residual is not contender.fit.residual:
        return None
    names = stands_for(problem, contender.score, other.score)
    same = renamed(fitted, [*names], [*names.values()], without=problem.simulator.base)
    return same if is_predicted(problem, same) else None


def with_evidence(
    problem: Problem, current: Fit, contenders: Sequence[Contender], num_tests: int
) -> list[Contender]:
    """Give contenders the p-values of what their fits change, with Bonferroni's correction.

    A candidate of which many sizes were tried pays for them alone (weighted, Holm 1979).

    Args:
        problem: The recordings and the model with every candidate.
        current: The fit of the effects selected so far.
        contenders: The candidates that were fitted.
        num_tests: How many candidates there were.
    """
    if not contenders:
        return []
    chosen = np.flatnonzero(problem.fitted)
    evidence = Evidence(problem, current, chosen)
    changes = evidence.rest(
        np.stack([(c.fit.residual - current.residual)[chosen] for c in contenders])
    )
    tested = []
    for change, contender in zip(changes.T, contenders, strict=True):
        score = contender.score
        p_value = 1.0
        if np.linalg.norm(change) > VISIBLE:
            num_fitted = len({*score.columns} - {*contender.fit.frozen})
            p_value = evidence.p_value(score.effect, change[:, None], max(num_fitted, 1))
        p_value *= num_tests * problem.num_tried(score.effect)
        score = dataclasses.replace(score, p_value=min(1.0, p_value))
        tested.append(dataclasses.replace(contender, score=score))
    return tested


def fit_one(problem: Problem, current: Fit, score: Score, rival: float, say) -> Contender:
    """Fit the selected effects and one more, from where screening puts it.

    Args:
        problem: The recordings and the model with every candidate.
        current: The fit of the effects selected so far.
        score: What screening says of the one more.
        rival: As for `fit`.
        say: Told what is being done.
    """
    effect = problem.simulator.effects[score.effect]
    say(f"fitting {effect.kind} at {effect.target}")
    theta = current.theta.copy()
    theta[list(score.start)] = list(score.start.values())
    free = (*current.free, *score.columns)
    start, sensitivity = current.start, current.sensitivity
    return Contender(score, fit(problem, theta, start, free, rival=rival, sensitivity=sensitivity))
