"""The errors on held-out recordings that are reported."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from garat_jax.diagnosis.columns import signals
from garat_jax.diagnosis.findings import Candidate, Named
from garat_jax.diagnosis.horizon import cut_longest
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.metric import (
    Errors,
    Floor,
    Metric,
    make_metric,
    noise_floor,
    signals_above,
    signals_mostly_above,
    trusted,
)
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.segments import Grid
from garat_jax.diagnosis.starts import Fit, settle
from garat_jax.diagnosis.timestep import REFINEMENTS, at_finer_timestep

COARSE = 3.0
"""The timestep's error, in standard deviations of a signal's noise, that a warning is given of."""


class HeldOut(NamedTuple):
    """The errors that are reported.

    Attributes:
        error: Over the segments that were fitted, at the model's timestep.
        longest: Over the longest segments; see `longest_errors`.
        finer: At a finer timestep; see `finer_errors`.
        on_time: As `error`, or as `finer` where that was measured, but `before` of the model with
            the delays alone that were found.
    """

    error: Errors
    longest: Errors | None = None
    finer: Errors | None = None
    on_time: Errors | None = None

    @property
    def are_explained(self) -> bool:
        """Whether what was found explains the errors, all that were measured."""
        return all(errors is None or errors.is_explained for errors in self)

    @property
    def are_explained_at_finer(self) -> bool:
        """Whether it explains those at a finer timestep, if they were measured."""
        return self.finer is None or HeldOut(self.finer, on_time=self.on_time).are_explained


def measure_held_out(
    problem: Problem,
    fits: tuple[Fit, Fit],
    floor: Floor,
    recordings: Sequence[Recording],
    grid: Grid,
    how: str,
    selected: Sequence[Candidate] = (),
) -> HeldOut:
    """Return the held-out errors of the model as it is and with what was found.

    A delay may make nearly all of the error and is no part of the mechanism: where one was found,
    what is left is held against what the delay alone leaves, too.

    Those at a finer timestep are measured where something was found that explains the others, and
    the integrator's error is above the noise.

    Args:
        problem: The recordings, cut as they were fitted.
        fits: The two, initial states settled.
        floor: What noise and the integrator's error make.
        recordings: What was measured.
        grid: The simulated steps.
        how: Names the recordings that are held out.
        selected: What was found.
    """
    after, delays = fits[1], [c.named for c in selected if c.is_delay]
    error = errors_of(problem, fits, floor, how)
    longest = longest_errors(problem, after.theta, recordings, grid, how)
    found = HeldOut(error, longest, None, _errors_on_time(problem, after, delays, floor, how))
    is_found = np.any(after.theta != problem.simulator.base)
    if not (is_found and error.integrator_exceeds_noise and found.are_explained):
        return found
    finer, on_time = finer_errors(problem, after, how, delays)
    return found._replace(finer=finer, on_time=on_time or found.on_time)


def _errors_on_time(
    problem: Problem, after: Fit, delays: Sequence[Named], floor: Floor, how: str
) -> Errors | None:
    """Return the errors as if the model had had the delays from the start; None without any."""
    if not delays:
        return None
    simulator, theta = problem.simulator, problem.simulator.base.copy()
    for j, slot in enumerate(simulator.slots):
        effect = simulator.effects[slot.effect]
        if Named(effect.kind, effect.target) in delays:
            theta[j] = after.theta[j]
    alone = np.array_equal(theta, after.theta)
    before = after if alone else settle(problem, theta, after.start)
    return errors_of(problem, (before, after), floor, how)


def errors_of(
    problem: Problem,
    fits: tuple[Fit, Fit],
    floor: Floor,
    how: str,
    above: Callable[[Problem, Metric, Fit, Floor], np.ndarray] = signals_above,
) -> Errors:
    """Return the held-out errors of the model as it is and with what was found.

    Args:
        problem: The recordings, cut.
        fits: The two, initial states settled.
        floor: What noise and the integrator's error make; see `metric.noise_floor`.
        how: Names the recordings that are held out.
        above: Which signals count as well above their floor, [num_signals].
    """
    metric, held_out = make_metric(problem), ~problem.fitted
    noise, listed = problem.segments.noise, signals(problem.simulator.host)
    sizes = [*(metric.rms(fit.residual, held_out) for fit in fits), floor.rms]
    named = ("before", "after", "noise_floor")
    per_signal = {
        signal.name: {**dict(zip(named, of_signal.tolist(), strict=True)), "unit": signal.unit}
        for signal, of_signal in zip(listed, np.stack(sizes, axis=1) * noise[:, None], strict=False)
        if np.all(np.isfinite(of_signal))
    }
    loud = np.flatnonzero(above(problem, metric, fits[1], floor))
    before, after = (metric.error(fit.residual, held_out) for fit in fits)
    return Errors.above(
        floor.error,
        metric.of_noise(held_out),
        metric=metric_in_words(problem, how),
        horizon=problem.horizon,
        before=before,
        after=after,
        timestep=problem.simulator.host.opt.timestep,
        per_signal=per_signal,
        above_floor=tuple(listed[i].name for i in loud),
    )


def longest_errors(
    problem: Problem,
    theta: np.ndarray,
    recordings: Sequence[Recording],
    grid: Grid,
    how: str,
) -> Errors | None:
    """Return the errors over the longest segments within which small changes do not grow.

    Fits need short segments where the model errs much in longer ones. What stays unexplained may
    show in those alone: a small steady force that is missing grows with time, noise does not.

    Args:
        problem: The recordings, cut as they were fitted.
        theta: Parameters with what was found, [num_parameters].
        recordings: What was measured.
        grid: The simulated steps.
        how: Names the recordings that are held out.

    Returns:
        None where segments of `problem` are as long, or where the integrator's error over longer
        ones would hide any other.
    """
    longer = cut_longest(problem, recordings, grid, theta)
    if longer is None:
        return None
    after = settle(longer, theta)
    longer = trusted(longer, after)
    after = settle(longer, theta, after.start)
    before = settle(longer, longer.simulator.base)
    floor = noise_floor(longer, make_metric(longer), after)
    errors = errors_of(longer, (before, after), floor, how, signals_mostly_above)
    return None if errors.is_too_coarse else errors


def finer_errors(
    problem: Problem, after: Fit, how: str, delays: Sequence[Named] = ()
) -> tuple[Errors | None, Errors | None]:
    """Return the errors at a finer timestep, down to one whose own error noise hides.

    What stays unexplained may show there alone: at the model's timestep the integrator's error,
    after impacts most of all, may hide much more than noise does. Physics that is right at any
    timestep comes down to the noise. Segments whose initial state is not found do not count.

    Args:
        problem: The recordings, cut as they were fitted.
        after: The fit of what was found, as near to a timestep of 0 as it could be taken.
        how: Names the recordings that are held out.
        delays: Those that were found.

    Returns:
        The errors, and those as if the model had had the delays; None where the integrator's error
        would hide any other there, too.
    """
    finest: tuple[Errors | None, Errors | None] = None, None
    for _ in range(REFINEMENTS):
        held_out = np.flatnonzero(~problem.fitted)
        problem, near = at_finer_timestep(problem.take(held_out), after.take(held_out))
        after = settle(problem, near.theta, near.start)
        before = settle(problem, problem.simulator.base)
        floor = noise_floor(problem, make_metric(problem), after)
        errors = errors_of(problem, (before, after), floor, how)
        if not errors.is_too_coarse:
            finest = errors, _errors_on_time(problem, after, delays, floor, how)
        if not errors.integrator_exceeds_noise:
            break
    return finest


def warn_of_timestep(problem: Problem, floor: Floor, host: mujoco.MjModel) -> tuple[str, ...]:
    """Say which signal the engine errs most in at the model's timestep, if by far beyond noise.

    Args:
        problem: The recordings, cut.
        floor: What noise and the integrator's error make.
        host: The compiled model.
    """
    error = np.sqrt(np.nan_to_num(floor.rms, nan=1.0) ** 2 - 1.0)  # beside noise, which is 1
    worst = int(np.argmax(error))
    if error[worst] < COARSE:
        return ()
    return (
        f"at a timestep of {problem.simulator.host.opt.timestep:g} s the engine's own error is "
        f"{error[worst]:.0f} times the noise of {signals(host)[worst].name}; give the model a "
        "smaller timestep, and the recordings will show more",
    )


def warn_of_fitted(problem: Problem, fitted: Fit, host: mujoco.MjModel) -> tuple[str, ...]:
    """Say that the recordings that are fitted show a gap, if they do.

    Of use where those held out show none: they may lack the motion, or the signal, that would.

    Args:
        problem: The recordings, cut.
        fitted: The model, initial states settled.
        host: The compiled model.
    """
    other = dataclasses.replace(problem, fitted=~problem.fitted)
    metric = make_metric(other)
    loud = signals_above(other, metric, fitted, noise_floor(other, metric, fitted))
    if not loud.any():
        return ()
    names = " and ".join(signals(host)[i].name for i in np.flatnonzero(loud))
    return (
        f"the recordings held out agree with the model, but it does not predict {names} of the "
        "others as well as noise allows; hold out others (--holdout)",
    )


def metric_in_words(problem: Problem, how: str) -> str:
    """Say what the reported errors are; `how` names the recordings."""
    return (
        "root mean square of all signals' prediction errors, each divided by its signal's standard "
        "deviation (where a signal hardly moves, by as many times its noise as is usual of the "
        f"others), {how}, segments of {problem.horizon:.2g} s, a timestep of "
        f"{problem.simulator.host.opt.timestep:.2g} s"
    )
