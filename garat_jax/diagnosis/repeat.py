"""Is an effect the same in every recording? Each is fitted alone, and the sizes are compared."""

from collections.abc import Callable, Sequence

import numpy as np
from scipy import stats

from garat_jax.diagnosis.diagnose import split, thin
from garat_jax.diagnosis.fit import count_timestep, fit
from garat_jax.diagnosis.horizon import choose_horizon, cut_longer
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.model_card import Model, make_effect
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.results import Candidate, Repeated, Sighting
from garat_jax.diagnosis.segments import choose_grid
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.diagnosis.starts import settle
from garat_jax.effects import Effect

SIGNIFICANCE = 0.01
"""Smallest p-value of equal sizes (Cochran's Q) at which recordings still count as agreeing."""


def nominal_effects(model: Model, selected: Sequence[Candidate]) -> tuple[Effect, ...]:
    """Return the effects that a diagnosis found, each of no size yet."""
    classes = [(model.catalogue[c.effect], c.target) for c in selected]
    return tuple(
        make_effect(cls, target, {p.name: p.nominal for p in cls.parameters()})
        for cls, target in classes
    )


def found_theta(simulator: Simulator, selected: Sequence[Candidate]) -> np.ndarray:
    """Return the parameters that a diagnosis found, [num_parameters]."""
    theta = simulator.base.copy()
    for j, slot in enumerate(simulator.slots):
        estimates = selected[slot.effect].parameters
        if slot.parameter.name in estimates:
            theta[j] = estimates[slot.parameter.name].estimate
    return theta


def repeatability(
    model: Model,
    recordings: Sequence[Recording],
    holdout: Sequence[Recording],
    selected: Sequence[Candidate],
    say: Callable[[str], None] = lambda message: None,
) -> tuple[Repeated, ...]:
    """Fit the effects that a diagnosis found to each recording alone.

    Args:
        model: The model without them.
        recordings: Those that the diagnosis was given.
        holdout: Those that it was given to hold out.
        selected: What it found.
        say: Told what is being done.
    """
    fitted, held_out, _ = split(recordings, holdout)
    everything = thin((*fitted, *held_out))
    if not selected:
        return ()
    grid = choose_grid(everything, model.compile(engine="mujoco").host.model.opt.timestep)
    effects = nominal_effects(model, selected)
    simulator = Simulator(model, effects, grid)
    finer = Simulator(model, effects, grid, refine=2)
    theta = found_theta(simulator, selected)
    _, segments = choose_horizon(simulator, everything, grid)
    sample = grid.interval * grid.per_sample
    everywhere = np.ones(len(segments.start), bool)
    whole = Problem(simulator, finer, segments, everywhere, sample)
    free = [
        j
        for j, slot in enumerate(simulator.slots)
        if np.isfinite(_half_width(selected[slot.effect], slot.parameter.name))
    ]
    longer = cut_longer(whole, everything, grid, theta)
    whole, settled = longer or (whole, settle(whole, theta, segments.start))
    sightings: dict[int, list[Sighting]] = {j: [] for j in free}
    for index, recording in enumerate(everything):
        say(f"fitting {recording.name} alone")
        own = whole.segments.recording == index
        alone = whole.take(own)
        found = count_timestep(alone, fit(alone, theta, settled.start[own], free))
        for place, j in enumerate(free):
            seen = j not in found.frozen
            numbers = (found.theta[j], found.low[place], found.high[place])
            values = [float(v) if seen else float("nan") for v in numbers]
            sightings[j].append(Sighting(recording.name, *values))
    return tuple(_summary(simulator, selected, j, sightings[j]) for j in free)


def _half_width(candidate: Candidate, name: str) -> float:
    estimate = candidate.parameters.get(name)
    return float("nan") if estimate is None else 0.5 * (estimate.high - estimate.low)


def _summary(simulator: Simulator, selected, j: int, seen: list[Sighting]) -> Repeated:
    slot = simulator.slots[j]
    candidate = selected[slot.effect]
    usable = [s for s in seen if np.isfinite([s.estimate, s.low, s.high]).all()]
    sizes = np.asarray([s.estimate for s in usable])
    errors = np.asarray([max(s.high - s.low, 1e-300) / 3.92 for s in usable])
    p_value = 1.0
    if len(usable) > 1:
        weight = 1.0 / errors**2
        mean = float(weight @ sizes / weight.sum())
        p_value = float(stats.chi2.sf(float(weight @ (sizes - mean) ** 2), len(sizes) - 1))
    return Repeated(
        effect=candidate.effect,
        target=candidate.target,
        parameter=slot.parameter.name,
        unit=candidate.parameters[slot.parameter.name].unit,
        recordings=tuple(seen),
        p_value=p_value,
        agree=p_value >= SIGNIFICANCE,
    )
