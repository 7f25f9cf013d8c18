"""The errors on held-out recordings that are reported."""

import dataclasses
from collections.abc import Callable, Sequence

import mujoco
import numpy as np

from garat_jax.diagnosis.columns import signals
from garat_jax.diagnosis.horizon import cut_longest
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.metric import (
    Floor,
    Metric,
    make_metric,
    noise_floor,
    signals_above,
    signals_mostly_above,
    trusted,
)
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.results import Errors
from garat_jax.diagnosis.segments import Grid
from garat_jax.diagnosis.starts import Fit, settle

COARSE = 3.0
"""The timestep's error, in standard deviations of a signal's noise, that a warning is given of."""


def errors_of(
    problem: Problem,
    fits: tuple[Fit, Fit],
    floor: Floor,
    host: mujoco.MjModel,
    how: str,
    above: Callable[[Problem, Metric, Fit, Floor], np.ndarray] = signals_above,
) -> Errors:
    """Return the held-out errors of the model as it is and with what was found.

    Args:
        problem: The recordings, cut.
        fits: The two, initial states settled.
        floor: What noise and the integrator's error make; see `metric.noise_floor`.
        host: The compiled model.
        how: Names the recordings that are held out.
        above: Which signals count as well above their floor, [num_signals].
    """
    metric, held_out = make_metric(problem), ~problem.fitted
    noise, listed = problem.segments.noise, signals(host)
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
    host: mujoco.MjModel,
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
        host: The compiled model.
        how: Names the recordings that are held out.

    Returns:
        None where segments of `problem` are as long, or where the integrator's error over longer
        ones would hide any other.
    """
    longer = cut_longest(problem, recordings, grid, theta)
    if longer is None:
        return None
    after = settle(longer, theta, longer.segments.start)
    longer = trusted(longer, after)
    after = settle(longer, theta, after.start)
    before = settle(longer, longer.simulator.base, longer.segments.start)
    floor = noise_floor(longer, make_metric(longer), after)
    errors = errors_of(longer, (before, after), floor, host, how, signals_mostly_above)
    return None if errors.is_too_coarse else errors


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


def are_explained(error: Errors, longest: Errors | None) -> bool:
    """Return whether what was found explains the errors, over the longest segments too."""
    return error.is_explained and (longest is None or longest.is_explained)


def metric_in_words(problem: Problem, how: str) -> str:
    """Say what the reported errors are; `how` names the recordings."""
    return (
        "root mean square of all signals' prediction errors, each divided by its signal's standard "
        "deviation (where a signal hardly moves, by as many times its noise as is usual of the "
        f"others), {how}, segments of {problem.horizon:.2g} s"
    )
