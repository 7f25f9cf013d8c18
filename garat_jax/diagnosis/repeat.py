"""Is an effect the same in every recording? Each is fitted alone, and the sizes are compared.

Whether it is this effect that each recording needs is told too: by how much the error falls there,
and by the rivals that promise more.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from garat_jax.diagnosis.diagnose import make_simulator, split, thin
from garat_jax.diagnosis.findings import Candidate, Named, Repeated, Sighting
from garat_jax.diagnosis.fit import fit
from garat_jax.diagnosis.horizon import choose_horizon, cut_longer
from garat_jax.diagnosis.judge import TOO_CLOSE
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.metric import make_metric
from garat_jax.diagnosis.model_card import Model
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.results import Diagnosis
from garat_jax.diagnosis.screen import screen
from garat_jax.diagnosis.segments import grid_for
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.diagnosis.slots import columns_of
from garat_jax.diagnosis.starts import Fit, settle
from garat_jax.diagnosis.timestep import REFITTED, count_timestep
from garat_jax.dynamics import native_model

SIGNIFICANCE = 0.01
"""Smallest p-value of equal sizes (Cochran's Q) at which recordings still count as agreeing."""
NUM_RIVALS = 3
"""Effects that a recording may need instead; scores of a few take less time than the fits."""
NUM_REFITTED = REFITTED // 2
"""Segments of a recording that are fitted again at finer timesteps, at least: with those of all
recordings, which are fitted one after another, that took several times as long as the diagnosis."""


def found_theta(simulator: Simulator, selected: Sequence[Candidate]) -> np.ndarray:
    """Return the parameters that a diagnosis found, [num_parameters]; others have no size."""
    found = {c.named: c for c in selected}
    theta = simulator.base.copy()
    for j, slot in enumerate(simulator.slots):
        effect = simulator.effects[slot.effect]
        if candidate := found.get(Named(effect.kind, effect.target)):
            estimate = candidate.parameters.get(slot.parameter.name)
            theta[j] = estimate.estimate if estimate else slot.parameter.nominal
    return theta


def sized_columns(
    simulator: Simulator, selected: Sequence[Candidate]
) -> dict[int, tuple[Candidate, str]]:
    """Return which parameters a diagnosis sized, by their place in `theta`: of what, by name."""
    index = _indices(simulator)
    return {
        j: (candidate, name)
        for candidate in selected
        for name, j in columns_of(simulator.slots, index[candidate.named]).items()
        if (size := candidate.parameters.get(name)) and np.isfinite(size.high - size.low)
    }


def _indices(simulator: Simulator) -> dict[Named, int]:
    return {Named(e.kind, e.target): i for i, e in enumerate(simulator.effects)}


def repeatability(
    model: Model,
    found: Diagnosis,
    recordings: Sequence[Recording],
    holdout: Sequence[Recording] = (),
    conditions: Mapping[str, Sequence[Recording]] | None = None,
    say: Callable[[str], None] = lambda message: None,
    simulator: Simulator | None = None,
) -> Diagnosis:
    """Return a diagnosis with what each recording alone shows of the effects that it found.

    A shared effect is looked for in the recordings of every condition that has no other one in
    its place, and a condition's own effects in its own.

    Args:
        model: The model without the effects.
        found: The diagnosis.
        recordings: Those that it was given.
        holdout: Those that it was given to hold out.
        conditions: Those of other conditions that it was given.
        say: Told what is being done.
        simulator: What made the diagnosis of these recordings, if it is kept; its programs are
            compiled.
    """
    parts = split(recordings, holdout)
    seen = _alone(model, parts, found.selected, found.candidates, say, simulator)
    others = {}
    for name, other in found.conditions.items():
        own = {c.named for c in other.selected}
        measured = split((conditions or {})[name], ())
        rivals = (*other.candidates, *found.candidates)
        there = _alone(model, measured, found.under(name), rivals, say)
        for parameter in seen:
            if parameter.of not in own:
                seen[parameter] += there[parameter]
        mine = {p: sightings for p, sightings in there.items() if p.of in own}
        others[name] = dataclasses.replace(other, repeatability=_summaries(mine))
    return dataclasses.replace(found, repeatability=_summaries(seen), conditions=others)


class _Parameter(NamedTuple):
    """A parameter of an effect that was found."""

    of: Named
    name: str
    unit: str


def _alone(
    model: Model,
    parts: tuple[Sequence[Recording], Sequence[Recording], str],
    selected: Sequence[Candidate],
    candidates: Sequence[Candidate],
    say: Callable[[str], None],
    simulator: Simulator | None = None,
) -> dict[_Parameter, list[Sighting]]:
    """Fit the effects selected to each recording alone.

    Args:
        model: The model without them.
        parts: What `split` returned.
        selected: All effects that act in these recordings.
        candidates: Best first; the first of them that were not selected are the rivals.
        say: Told what is being done.
        simulator: See `repeatability`.
    """
    if not selected:
        return {}
    everything = thin((*parts[0], *parts[1]))
    host = native_model(model.compile(engine="mujoco"))
    grid = grid_for(everything, host)
    simulator = simulator or make_simulator(model, grid)
    theta = found_theta(simulator, selected)
    index = _indices(simulator)
    acting = [index[c.named] for c in selected]
    rivals = {index[named] for named in _rivals(selected, candidates) if named in index}
    skip = [i for i in index.values() if i not in rivals]
    _, segments = choose_horizon(simulator, everything, grid)
    everywhere = np.ones(len(segments.start), bool)
    whole = Problem(simulator, segments, everywhere, grid.sample)
    free = {
        j: _Parameter(candidate.named, name, candidate.parameters[name].unit)
        for j, (candidate, name) in sized_columns(simulator, selected).items()
    }
    longer = cut_longer(whole, everything, grid, theta)
    whole, settled = longer or (whole, settle(whole, theta))
    sightings: dict[_Parameter, list[Sighting]] = {parameter: [] for parameter in free.values()}
    for index, recording in enumerate(everything):
        say(f"fitting {recording.name} alone")
        own = whole.segments.recording == index
        alone = whole.take(own)
        found = fit(alone, theta, settled.start[own], free)
        needs = {number: _need(alone, found, number, skip) for number in acting}
        fitted = count_timestep(alone, found, NUM_REFITTED)
        for place, (j, parameter) in enumerate(free.items()):
            seen = j not in fitted.frozen
            numbers = (fitted.theta[j], fitted.low[place], fitted.high[place])
            estimate, low, high = (float(v) if seen else float("nan") for v in numbers)
            need = needs[simulator.slots[j].effect]
            sightings[parameter].append(
                Sighting(recording.name, estimate, low, high, *need, whole.horizon)
            )
    return sightings


def _rivals(selected: Sequence[Candidate], candidates: Sequence[Candidate]) -> list[Named]:
    """Return the best candidates that these recordings can tell from all selected."""
    taken = {c.named for c in selected}
    taken |= {named for c in selected for named in c.indistinguishable_from}
    best = dict.fromkeys(c.named for c in candidates if c.named not in taken)
    return list(best)[:NUM_RIVALS]


def _need(
    alone: Problem[Simulator], fitted: Fit, effect: int, skip: Sequence[int]
) -> tuple[float, float, tuple[Named, ...]]:
    """Return the errors without and with an effect, and which rivals explain more.

    A rival, which is what is not skipped, explains what its sensitivity promises, as in the scoring
    of candidates; it is ahead if that leaves clearly less of the squared residual than the effect
    does.
    """
    simulator = alone.simulator
    owners = np.asarray([slot.effect for slot in simulator.slots])
    nothing = np.where(owners == effect, simulator.base, fitted.theta)
    without = settle(alone, nothing, fitted.start)
    metric, chosen = make_metric(dataclasses.replace(alone, fitted=~alone.fitted)), alone.fitted
    left = fitted.cost.sum() / without.cost.sum()
    ahead = tuple(
        Named(rival.kind, rival.target)
        for score in screen(alone, without, skip)
        if score.possible and not score.excluded and (1.0 - score.share) * TOO_CLOSE < left
        for rival in [simulator.effects[score.effect]]
    )
    return metric.error(without.residual, chosen), metric.error(fitted.residual, chosen), ahead


def _summaries(sightings: Mapping[_Parameter, list[Sighting]]) -> tuple[Repeated, ...]:
    return tuple(_summary(parameter, seen) for parameter, seen in sightings.items())


def _summary(parameter: _Parameter, seen: list[Sighting]) -> Repeated:
    usable = [s for s in seen if s.is_sized and s.low < s.high]
    sizes = np.asarray([s.estimate for s in usable])
    errors = np.asarray([(s.high - s.low) / 3.92 for s in usable])
    p_value = 1.0
    if len(usable) > 1:
        weight = 1.0 / errors**2
        mean = float(weight @ sizes / weight.sum())
        p_value = float(stats.chi2.sf(float(weight @ (sizes - mean) ** 2), len(sizes) - 1))
    return Repeated(
        effect=parameter.of.effect,
        target=parameter.of.target,
        parameter=parameter.name,
        unit=parameter.unit,
        recordings=tuple(seen),
        p_value=p_value,
        agree=p_value >= SIGNIFICANCE,
    )
