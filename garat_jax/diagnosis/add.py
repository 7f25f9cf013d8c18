"""Give a model one more effect, of a size that the user sets or that recordings tell."""

import dataclasses
import html
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from garat_jax.diagnosis.descend import excited
from garat_jax.diagnosis.diagnose import thin
from garat_jax.diagnosis.differences import clear_differences, projected
from garat_jax.diagnosis.findings import Estimate
from garat_jax.diagnosis.fit import fit
from garat_jax.diagnosis.horizon import (
    choose_horizon,
    say_horizon,
    warn_of_divergence,
    warn_of_sampling,
)
from garat_jax.diagnosis.measurements import Recording, checked
from garat_jax.diagnosis.metric import make_metric
from garat_jax.diagnosis.model_card import Model, check_model, make_effect
from garat_jax.diagnosis.own_effects import try_own
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.segments import grid_for
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.diagnosis.starts import Fit, settle
from garat_jax.diagnosis.suggest import suggest
from garat_jax.diagnosis.timestep import count_timestep
from garat_jax.diagnosis.units import after_number
from garat_jax.dynamics import native_model
from garat_jax.effects import Effect, are_exclusive, unit_at
from garat_jax.effects.bounds import ROUNDING, check_bounds
from garat_jax.effects.catalogue import choose_kind
from garat_jax.errors import UserError


class Sized(NamedTuple):
    """An effect whose parameters were fitted.

    Attributes:
        effect: With the fitted parameters.
        parameters: Estimates by name; the ends are not finite where the recordings say nothing.
        horizon: Seconds of the segments whose prediction error was fitted.
        error_before: Error on the recordings, relative to each signal's standard deviation.
        error_after: The same with the effect.
        dead: Parameters that stay at no effect, because they change no signal.
        unsure: Those that act alone, and within whose interval no effect lies.
        at_bound: Which bound those are at that may go no further: `lower` or `upper`.
    """

    effect: Effect
    parameters: Mapping[str, Estimate]
    horizon: float
    error_before: float
    error_after: float
    dead: tuple[str, ...] = ()
    unsure: tuple[str, ...] = ()
    at_bound: Mapping[str, str] = MappingProxyType({})

    def __str__(self) -> str:
        sizes = [f"{name} = {said(e)}{self._doubts(name)}" for name, e in self.parameters.items()]
        sizes += [
            f"{name} = {getattr(self.effect, name):.4g}: it stays at no effect, the recordings do "
            "not excite it"
            for name in self.dead
        ]
        return "\n".join([f"{self.effect.kind} at {self.effect.target}:", *sizes, self.change])

    def _doubts(self, name: str) -> str:
        """Say why a parameter's size is none to trust, if it is."""
        doubts = []
        if name in self.at_bound:
            bound = self.at_bound[name]
            doubts += [f"; it is at its {bound} bound, so the recordings ask for something else"]
        if name in self.unsure:
            doubts += ["; it may as well be no effect"]
        return "".join(doubts)

    @property
    def change(self) -> str:
        """What adding the effect changes on the recordings that it was fitted to."""
        fell = self.error_after < self.error_before
        return (
            f"error over {self.horizon:g} s on these recordings, of the signals' spread: "
            f"{self.error_before:.3g} → {self.error_after:.3g}"
            f"{'' if fell else '; it did not fall: they do not speak for this effect alone'}"
        )


class Added(NamedTuple):
    """A model with one more effect.

    Attributes:
        model: The model with the effect.
        sized: How the recordings sized it; None without recordings.
    """

    model: Model
    sized: Sized | None

    def __str__(self) -> str:
        effect = self.model.effects[-1]
        return str(self.sized) if self.sized else f"{effect.kind} at {effect.target}, as set"

    def _repr_html_(self) -> str:
        """Return what a notebook shows."""
        return f"<pre>{html.escape(str(self))}</pre>"


def add(
    model: Model,
    kind: str,
    target: str,
    values: Mapping[str, float] | None = None,
    recordings: Sequence[Recording] = (),
    say: Callable[[str], None] = lambda message: None,
) -> Added:
    """Give a model one more effect.

    Args:
        model: The model; it stays as it is.
        kind: The effect, by its name in the model's catalogue.
        target: Where it acts.
        values: Parameters that are set.
        recordings: What the other parameters are fitted to; without any, they have no effect.
        say: Told what is being done.

    Raises:
        UserError: The effect, the place or a value cannot be, or nothing tells a size.
    """
    check_model(model)
    values = values or {}
    effect = choose_effect(model, kind, target, values)
    if not values and not recordings:
        raise UserError(
            "an effect needs a size: give --set NAME=VALUE, or --fit DATA (in Python: values, or "
            "recordings)"
        )
    sized = size(model, effect, list(values), recordings, say) if recordings else None
    effect = sized.effect if sized else effect
    return Added(dataclasses.replace(model, effects=(*model.effects, effect)), sized)


def said(estimate: Estimate) -> str:
    """Return an estimate with its interval and unit as a user reads them."""
    unit = after_number(estimate.unit)
    if not np.isfinite([estimate.low, estimate.high]).all():
        return f"{estimate.estimate:.4g}{unit} (the recordings do not tell it)"
    return f"{estimate.estimate:.4g}{unit} (95 %: {estimate.low:.4g} to {estimate.high:.4g})"


def choose_effect(model: Model, kind: str, target: str, values: Mapping[str, float]) -> Effect:
    """Make an effect of the model's catalogue, checked against the model and its bounds.

    Parameters that are not given mean "no effect": what stands for a number of the model keeps it.

    Raises:
        UserError: The kind, the target or a parameter is unknown, a value is outside its bounds,
            the model has what excludes it already, or a user's own law fails; see `try_own`.
    """
    cls = choose_kind(kind, model.catalogue)
    effect = make_effect(cls, target, values)
    bare = dataclasses.replace(model, effects=())  # an effect of the card is none of the model's
    host = native_model(bare.compile(engine="mujoco"))
    effect.check(host)
    effect = effect.replace(**{**cls.at(host, target), **values})
    check_bounds(effect, host)
    try_own(model.spec, model.overrides, (effect,))
    for present in model.effects:
        if are_exclusive(effect, present):
            do = "change it there" if present.kind == kind else f"it is that or {kind} at {target}"
            raise UserError(f"{model.path} has {present.kind} at {present.target} already; {do}")
    return effect


def size(
    model: Model,
    effect: Effect,
    given: Sequence[str],
    recordings: Sequence[Recording],
    say: Callable[[str], None] = lambda message: None,
) -> Sized:
    """Fit an effect's parameters to recordings.

    Args:
        model: The model without the effect.
        effect: The effect; its parameters named in `given` keep their values.
        given: Parameters that are not fitted.
        recordings: What was measured.
        say: Told what is being done.

    Raises:
        UserError: Nothing is left to fit, or the recordings excite none of it.
    """
    recordings = thin(checked(recordings))
    world = model.compile(engine="mujoco")
    host = native_model(world)
    grid = grid_for(recordings, host)
    simulator = Simulator(model, (effect,), grid)
    free = [j for j, slot in enumerate(simulator.slots) if slot.parameter.name not in given]
    if not free:
        raise UserError("every parameter is set, so nothing is left to fit; leave one of them out")
    horizon, segments = choose_horizon(simulator, recordings, grid)
    say(say_horizon(recordings, horizon))
    warnings = warn_of_sampling(grid, host.opt.timestep)
    for warning in (*warnings, *warn_of_divergence(simulator, recordings, grid, horizon)):
        say(f"warning: {warning}")
    problem = Problem(
        simulator,
        segments,
        np.ones(len(segments.start), bool),
        grid.sample,
        suggest((effect,), host, recordings, world),
    )
    metric = make_metric(dataclasses.replace(problem, fitted=~problem.fitted))
    before = settle(problem, simulator.base)
    say(f"fitting {effect.kind} at {effect.target}")
    starts = _starts(problem, before, effect, given)
    seen = _seen(problem, before, starts, free)
    dead = [simulator.slots[j].parameter.name for j in free if j not in seen]
    if not seen:
        raise UserError(
            f"the recordings do not excite {effect.kind} at {effect.target}: its "
            f"{', '.join(dead)} changes no signal; record what identifies it: "
            f"{effect.identified_by}"
        )
    none = effect.at(simulator.host, effect.target)
    for theta in starts:
        for j in set(free) - set(seen):
            theta[j] = none[simulator.slots[j].parameter.name]
    fits = [fit(problem, theta, before.start, seen) for theta in starts]
    best = min(fits, key=lambda fitted: float(fitted.cost.sum()))
    best = count_timestep(problem, best)
    found = estimates(problem, best)
    return Sized(
        effect=simulator.with_parameters([float(v) for v in best.theta], [0])[0],
        parameters=found,
        horizon=horizon,
        error_before=metric.error(before.residual, problem.fitted),
        error_after=metric.error(best.residual, problem.fitted),
        dead=tuple(dead),
        unsure=tuple(
            name
            for name in [p.name for p in effect.parameters()][: None if effect.independent else 1]
            if name in found and found[name].low <= none[name] <= found[name].high
        ),
        at_bound=_at_bound(problem, best, none),
    )


def estimates(problem: Problem, fitted: Fit) -> dict[str, Estimate]:
    """Return the estimates of a problem's only effect, by parameter."""
    simulator = problem.simulator
    found = {}
    for place, j in enumerate(fitted.free):
        slot = simulator.slots[j]
        unit = unit_at(slot.parameter, simulator.host, simulator.effects[slot.effect].target)
        ends = float(fitted.low[place]), float(fitted.high[place])
        found[slot.parameter.name] = Estimate(float(fitted.theta[j]), *ends, unit)
    return found


def _at_bound(problem: Problem, fitted: Fit, none: Mapping[str, float]) -> dict[str, str]:
    """Name the bounds at which fitted parameters are, but for those that mean no effect."""
    bounds = {}
    for j in fitted.free:
        parameter, value = problem.simulator.slots[j].parameter, fitted.theta[j]
        for which, bound in (("lower", parameter.low), ("upper", parameter.high)):
            if np.isclose(value, bound, ROUNDING, 0.0) and bound != none[parameter.name]:
                bounds[parameter.name] = which
    return bounds


def _starts(problem: Problem, before: Fit, effect: Effect, given) -> list[np.ndarray]:
    """List the parameters from which a fit should be tried, each [num_parameters]."""
    simulator = problem.simulator
    known = {name: float(getattr(effect, name)) for name in given}
    thetas = [before.theta.copy() for _ in problem.starts(0)]
    for theta, start in zip(thetas, problem.starts(0), strict=True):
        sizes = effect.beside(start, known)
        for j, slot in enumerate(simulator.slots):
            if slot.parameter.name in sizes and slot.parameter.name not in given:
                theta[j] = sizes[slot.parameter.name]
    return list(np.unique(thetas, axis=0))  # those that differ in given parameters only are one


def _seen(problem: Problem, before: Fit, starts: Sequence[np.ndarray], free) -> list[int]:
    """Return the parameters that change a signal at any of the sizes from which fits start."""
    seen = np.zeros(len(free), bool)
    for theta in starts:
        there = clear_differences(problem, theta, before.start, free, before.sensitivity)
        seen |= excited(problem, free, projected(problem, there.linearisation)[0])
    return [j for j, is_seen in zip(free, seen, strict=True) if is_seen]
