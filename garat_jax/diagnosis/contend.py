"""Fit the candidates that screening puts first, so that they can be held against each other."""

import dataclasses
from collections.abc import Callable, Sequence

from garat_jax.diagnosis.fit import Fit, Problem, fit
from garat_jax.diagnosis.screen import EQUIVALENT, Score, cosine, simpler_law

CONTENDERS = 4
"""How many candidates are fitted each round, besides those that are like the first."""
CONTENDER_STEPS = 6
"""Gauss-Newton steps of a contender, which starts where screening expects it."""


@dataclasses.dataclass(frozen=True)
class Contender:
    """A candidate that was fitted.

    Attributes:
        score: What screening said.
        fit: All selected effects and this one, fitted.
    """

    score: Score
    fit: Fit


def fit_contenders(
    problem: Problem, current: Fit, scores: Sequence[Score], say: Callable[[str], None]
) -> list[Contender]:
    """Fit the candidates that may be the missing effect.

    Args:
        problem: The recordings and the model with every candidate.
        current: The fit of the effects selected so far.
        scores: What screening says, best first.
        say: Told what is being done.
    """
    likely = [s for s in scores if not s.excluded and s.possible and s.share > 0.02]
    likely = [s for s in likely if s.share > 0.25 * likely[0].share]
    likely = [s for s in likely if not simpler_law(problem, s, likely)]
    if not likely:
        return []
    chosen = likely[:CONTENDERS]
    chosen += [s for s in likely[CONTENDERS:] if cosine(s, likely[0]) > EQUIVALENT]
    contenders = []
    for score in chosen:
        effect = problem.simulator.effects[score.effect]
        say(f"fitting {effect.kind} at {effect.target}")
        contenders.append(Contender(score, _fit_with(problem, current, score)))
    return contenders


def _fit_with(problem: Problem, current: Fit, score: Score) -> Fit:
    """Fit the selected effects and one more, from where screening puts it."""
    theta = current.theta.copy()
    theta[list(score.start)] = list(score.start.values())
    return fit(problem, theta, current.start, (*current.free, *score.columns), CONTENDER_STEPS)
