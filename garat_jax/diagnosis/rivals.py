"""More of the laws of the best contender and its rivals: one may be the truth without a part."""

from collections.abc import Sequence

from garat_jax.diagnosis.contend import Contender, best_of, fit_further, fit_refinements
from garat_jax.diagnosis.judge import held_out_gain, is_certain, leads
from garat_jax.diagnosis.metric import AT_FLOOR, Floor, Metric, is_above
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.starts import Fit


def refine(problem, metric: Metric, current: Fit, scores, contenders, floor: Floor, say):
    """Put before the best contender, and those that it does not lead, refinements of their laws.

    A refinement comes before a law where it certainly explains more. Screening prefers the
    simpler law. A refinement's threshold hides it there; one without waits for the next round,
    where other effects rival it, if the simpler law proves itself and has no rival.
    """
    best = best_of(contenders)
    if best is None or not is_above(problem, metric, best.fit, floor, AT_FLOOR):
        return contenders
    rivals = unled(problem, best, contenders)
    proves_itself = is_certain(held_out_gain(problem, metric, current, best.fit))
    for rival in rivals:
        names = [c for c in contenders if c.fit.residual is rival.fit.residual]
        for name in names:
            waits = proves_itself and len(rivals) == 1
            for refined in fit_refinements(problem, current, name, scores, say, waits):
                known = (c.fit for c in contenders if c.score.effect == refined.score.effect)
                if all(leads(problem, refined.fit, fit) for fit in (rival.fit, *known)):
                    others = [c for c in contenders if c.score.effect != refined.score.effect]
                    contenders, rival = [refined, *others], refined
    return contenders


def fill_out(problem, metric: Metric, contenders, floor: Floor, say):
    """Replace the best contender, and those that it does not lead, where more of their laws does.

    Of two that explain the same, one may be the truth without a part that screening left out.
    """
    best = best_of(contenders)
    if best is None or not is_above(problem, metric, best.fit, floor, AT_FLOOR):
        return contenders
    for rival in unled(problem, best, contenders):
        for fuller in fit_further(problem, rival, say):
            if leads(problem, fuller.fit, rival.fit):
                contenders = _replaced(contenders, rival, fuller)
    return contenders


def unled(problem: Problem, best: Contender, contenders: Sequence[Contender]) -> list[Contender]:
    """Return the best contender and those that it does not lead, each fit under one name."""
    fits = {id(c.fit.residual): c for c in [*contenders, best]}  # names share one
    others = (c for c in fits.values() if c is not best)
    return [best, *(c for c in others if not leads(problem, best.fit, c.fit))]


def _replaced(contenders: Sequence[Contender], old: Contender, new: Contender) -> list[Contender]:
    """Put one contender in another's place; the other's names go, as the new one has its own."""
    names = (c.score.effect for c in contenders if c.fit.residual is old.fit.residual)
    replaced = {new.score.effect, *names}
    return [new, *(c for c in contenders if c.score.effect not in replaced)]
