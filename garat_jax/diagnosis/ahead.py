"""Where no candidate passes by itself, or a simple law may be hidden: look one effect further.

Of two effects that are missing, neither explains so much by itself that no third can rival it, and
the other may drown what it gains on what is held out; of three, not even two may gain there for
certain. And a law that refines another may do some of what that one does with a further effect.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from garat_jax.diagnosis.contend import Contender, refines
from garat_jax.diagnosis.findings import Candidate, Named
from garat_jax.diagnosis.judge import (
    ANOTHER_MAY_HELP,
    NO_CERTAIN_LEAD,
    PASSING,
    Judged,
    do_the_same,
    held_out_gain,
    is_certain,
    leads,
    may_be_mended,
    simplest,
)
from garat_jax.diagnosis.metric import AT_FLOOR, Metric, is_above, noise_floor
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.starts import Fit
from garat_jax.diagnosis.steps import Step, fit_only, prune

RIVALS = 2
"""How many candidates behind the first are followed for one more effect."""
LOOK_AHEAD = 2
"""Effects held from which rivals are not followed any more: each path is a round of its own, and
rounds take longer with every effect held."""
AT_ONCE = 4
"""Effects that are added at once, at most."""
LARGE = 0.3
"""Share of what is left that each of these explains, at least: less, and so few do not explain all
of an error that is far above its floor."""
TOGETHER = f"{PASSING} together with "


class Path(NamedTuple):
    """A candidate that may be added, and the round that would follow."""

    candidate: Candidate
    contender: Contender
    then: Judged

    @property
    def second(self) -> Contender | None:
        """What would pass then, or would but for another that explains as much."""
        for candidate, contender in self.then[:1]:
            return contender if candidate.passes or candidate.why == NO_CERTAIN_LEAD else None
        return None

    @property
    def added(self) -> list[Candidate]:
        """What is added on it."""
        return [self.candidate, *([self.then[0][0]] if self.second else [])]

    @property
    def fit(self) -> Fit:
        """Where the path leads."""
        return (self.second or self.contender).fit

    def adds(self, named: Named) -> bool:
        """Say whether an effect is added on it, or what recordings cannot tell from one that is."""
        return any(named in (c.named, *c.indistinguishable_from) for c in self.added)

    def is_as_sure_as(self, other: "Path") -> bool:
        """Say whether its first fails no gate but those that another effect may mend.

        And its second passes if that of the other path does.
        """
        is_sure_then = self.then[0][0].passes or not other.then[0][0].passes
        return may_be_mended(self.candidate) and is_sure_then

    def is_like(self, other: "Path") -> bool:
        """Say whether the other adds the same, or what recordings cannot tell from it."""
        same_number = len(self.added) == len(other.added)
        return same_number and all(self.adds(c.named) for c in other.added)


def choose(
    problem: Problem,
    metric: Metric,
    current: Fit,
    judged: Judged,
    held: Sequence[int],
    follow: Callable[[Sequence[int], Contender], Judged],
    say: Callable[[str], None],
) -> tuple[Judged, list[Step]]:
    """Return a round's candidates and what of them is to be added, which may need another.

    Args:
        problem: What is fitted.
        metric: Of the errors.
        current: The fit of the effects selected so far.
        judged: The candidates, best first.
        held: The effects selected so far.
        follow: Returns the round that would follow one beside some effects.
        say: Told what is being done.

    Returns:
        The candidates, the first of which passes if with another it leads its rivals with another
        (or does as well with fewer parameters), or if all that these do not lead add it, too, or
        the same beside another first; and what is to be added: the first if it passes, with the
        other if it needs that and no third explains as much; a next round may tell these. Where
        nothing is held and nothing passes so, several that explain all, if each is needed.
    """
    followed = []
    for candidate, contender in _rivals(problem, metric, judged, len(held)):
        say(f"looking for what would be missing beside {candidate.named}")
        followed.append(Path(candidate, contender, follow(held, contender)))
    judged, steps = _one_or_two(problem, metric, current, judged, followed)
    if steps or held:
        return judged, steps
    then = {path.contender.score.effect: path.then for path in followed}
    return _several(problem, metric, current, judged, then, follow, say)


def _one_or_two(
    problem: Problem, metric: Metric, current: Fit, judged: Judged, followed: Sequence[Path]
) -> tuple[Judged, list[Step]]:
    """Return a round's candidates and what is to be added, by paths with one more; see `choose`."""
    if not followed:
        return judged, first_step(problem, judged, current)
    known = [k.fit for first, k in judged[:1] if k and first.passes]

    def gains(path: Path) -> bool:
        lowers = path.second and is_certain(held_out_gain(problem, metric, current, path.fit))
        return bool(lowers and all(leads(problem, path.fit, fit) for fit in known))

    best = min(followed, key=lambda path: path.fit.cost.sum())
    if not gains(best):
        return judged, first_step(problem, judged, current)
    rivals = [path for path in followed if path is not best]
    sure = [path for path in rivals if gains(path) and path.is_as_sure_as(best)]
    simple = simplest(problem, metric, best.fit, [path.fit for path in sure])
    best = next(path for path in followed if path.fit is simple)
    others = [path for path in followed if not best.is_like(path)]
    undecided = [best, *(path for path in others if not leads(problem, best.fit, path.fit))]
    shared = _shared(undecided, judged)
    if shared is None:
        return judged, first_step(problem, judged, current)
    first, contender, is_second = shared
    itself = {first.named, *first.indistinguishable_from}
    added = dict.fromkeys(c.named for path in undecided for c in path.added)
    why = TOGETHER + " or ".join(str(named) for named in added if named not in itself)
    first = dataclasses.replace(first, passes=True, why=why)
    judged = [(first, contender), *(pair for pair in judged if pair[1] is not contender)]
    steps = first_step(problem, judged, current)
    if len(undecided) == 1 or is_second:
        steps += first_step(problem, best.then, best.contender.fit)
    return judged, steps


def _several(
    problem: Problem,
    metric: Metric,
    current: Fit,
    judged: Judged,
    known: Mapping[int, Judged],
    follow: Callable[[Sequence[int], Contender], Judged],
    say: Callable[[str], None],
) -> tuple[Judged, list[Step]]:
    """Return a round's candidates and several to be added at once; none if they do not explain all.

    The first that lacks only what others may drown is taken, round after round, until one passes
    every gate beside those and no more than noise is left. Each of them has to be needed then.

    Args:
        problem: What is fitted.
        metric: Of the errors.
        current: The fit of no effect.
        judged: The candidates, best first.
        known: The rounds that would follow some effects, by these.
        follow: Returns the round that would follow one beside some effects.
        say: Told what is being done.
    """
    steps: list[Step] = []
    fit, then, is_all = current, judged, False
    while not is_all:
        likely = [(c, k) for c, k in then if k and c.share > LARGE and may_be_mended(c)]
        if not likely:
            return judged, []
        candidate, contender = likely[0]
        taken = dataclasses.replace(candidate, passes=True)
        others = [(c, k) for c, k in then if k is not contender]
        effects = [step.effect for step in steps]
        steps += first_step(problem, [(taken, contender), *others], fit)
        fit = contender.fit
        is_all = candidate.passes and _is_at_floor(problem, metric, fit)
        if not is_all and len(steps) == AT_ONCE:
            return judged, []
        if not is_all:
            say(f"looking for what else would be missing beside {candidate.named}")
            is_known = not effects and contender.score.effect in known
            then = known[contender.score.effect] if is_known else follow(effects, contender)
    steps, fit = prune(problem, steps, fit, steps[:-1], say)
    is_all = len(steps) > 1 and _is_at_floor(problem, metric, fit)
    if not is_all or not all(_is_needed(problem, metric, steps, fit, step) for step in steps):
        return judged, []
    last = dataclasses.replace(steps[-1].contender, fit=fit)  # without what went
    steps = [*steps[:-1], steps[-1]._replace(contender=last)]
    steps = [_as_one_of(steps, step) for step in steps]
    first = steps[0]
    others = [(c, k) for c, k in judged if c.named != first.candidate.named]
    return [(first.candidate, first.contender), *others], steps


def _is_at_floor(problem: Problem, metric: Metric, fit: Fit) -> bool:
    """Say whether a fit leaves no more than noise in all signals together, and in each hardly more.

    One of many signals may be a little above its floor by chance.
    """
    floor = noise_floor(problem, metric, fit)
    error = metric.error(fit.residual, ~problem.fitted)
    return error <= AT_FLOOR * floor.error and not is_above(problem, metric, fit, floor)


def _is_needed(problem: Problem, metric: Metric, steps: Sequence[Step], fit: Fit, step: Step):
    """Say whether errors grow for certain without a step, those that are held out among them."""
    without = fit_only(problem, fit, [other.effect for other in steps if other is not step])
    gain = held_out_gain(problem, metric, without, fit)
    return leads(problem, fit, without) and is_certain(gain)


def _as_one_of(steps: Sequence[Step], step: Step) -> Step:
    """Return a step of which is said what it passes together with."""
    others = [str(other.candidate.named) for other in steps if other is not step]
    candidate = dataclasses.replace(step.candidate, why=TOGETHER + " and ".join(others))
    return step._replace(candidate=candidate)


def _shared(undecided: Sequence[Path], judged: Judged) -> tuple[Candidate, Contender, bool] | None:
    """Return what is on all paths, with its fit; where that is the second, what it is second to.

    Args:
        undecided: The best path and those that it does not lead.
        judged: The round's candidates, best first.

    Returns:
        The candidate that is to pass, its fit and whether what the paths share is the best path's
        second: then the candidate is its first, not told from the others'. None if they share
        nothing that may pass.
    """

    def on_all(named: Named) -> bool:
        return all(path.adds(named) for path in undecided)

    best = undecided[0]
    for candidate, contender in [(best.candidate, best.contender), *judged]:
        if contender and on_all(candidate.named):
            if candidate.why in ANOTHER_MAY_HELP:
                return candidate, contender, False
            break
    second = best.then[0][0]
    may_pass = second.passes and best.candidate.why in ANOTHER_MAY_HELP
    if not may_pass or not on_all(second.named):
        return None
    added = [(c.named, *c.indistinguishable_from) for path in undecided for c in path.added]
    firsts = dict.fromkeys(n for names in added if second.named not in names for n in names)
    alike = tuple(named for named in firsts if named != best.candidate.named)
    first = dataclasses.replace(best.candidate, indistinguishable_from=alike)
    return first, best.contender, True


def _rivals(
    problem: Problem, metric: Metric, judged: Judged, num_held: int
) -> list[tuple[Candidate, Contender]]:
    """Return the candidates of which another effect may make the first, with their fits.

    Where one passes, these are the laws that it refines, unless it leaves no more than noise. Where
    none does, there are none beside `LOOK_AHEAD` effects. One that is paired is among them, too.
    """
    fitted = [(candidate, contender) for candidate, contender in judged if contender]
    for first, contender in fitted[:1]:
        if first.passes:
            floor = noise_floor(problem, metric, contender.fit)
            if not is_above(problem, metric, contender.fit, floor, AT_FLOOR):
                return []
            own = contender.score.effect
            simpler = [(c, k) for c, k in fitted if refines(problem, own, k.score.effect)]
            likely = simpler[: 1 + RIVALS]
            return [*likely, *_paired(fitted, [(first, contender), *likely])]
        if first.why in ANOTHER_MAY_HELP and num_held < LOOK_AHEAD:
            likely = _one_of_each(fitted)[: 1 + RIVALS]
            return [*likely, *_paired(fitted, likely)]
    return []


def _paired(
    fitted: Sequence[tuple[Candidate, Contender]], likely: Sequence[tuple[Candidate, Contender]]
) -> list[tuple[Candidate, Contender]]:
    """Return what is paired among those that were fitted, if it is not like one that is likely."""
    like = {named for c, _ in likely for named in (c.named, *c.indistinguishable_from)}
    return [(c, k) for c, k in fitted if k.is_paired and c.named not in like]


def _one_of_each(fitted: Sequence[tuple[Candidate, Contender]]):
    """Leave out those candidates that are like one before them."""
    kept, like = [], set()
    for candidate, contender in fitted:
        if candidate.named not in like:
            kept.append((candidate, contender))
            like |= {*candidate.indistinguishable_from}
    return kept


def first_step(problem: Problem, judged: Judged, current: Fit) -> list[Step]:
    """Return a round's first candidate as a step from the fit before it, if it passes."""
    steps = []
    for first, contender in judged[:1]:
        if first.passes and contender:
            equals = first.indistinguishable_from
            alike = [
                (c, k)
                for c, k in judged[1:]
                if k and (c.named in equals or _may_be_meant(problem, current, contender, k))
            ]
            steps.append(Step(first, contender, contender.fit, alike))
    return steps


def _may_be_meant(problem: Problem, current: Fit, one: Contender, other: Contender) -> bool:
    """Say whether a contender does much what another does, and neither law refines the other's.

    A refinement can do all that the simpler law does, and always fits a little better.
    """
    owners = one.score.effect, other.score.effect
    are_related = refines(problem, *owners) or refines(problem, *owners[::-1])
    return not are_related and do_the_same(current, one, other)
