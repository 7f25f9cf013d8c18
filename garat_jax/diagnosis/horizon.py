"""How long a segment may last: as long as the model can be followed."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from garat_jax.diagnosis.measurements import Recording, longest_span
from garat_jax.diagnosis.problem import FEWEST_SEGMENTS, AnyProblem, Predictor, Problem
from garat_jax.diagnosis.segments import QUIET, Grid, Segments, cut
from garat_jax.diagnosis.sensing import as_they_are
from garat_jax.diagnosis.starts import Fit, settle
from garat_jax.errors import UserError

HORIZONS = (2.0, 1.0, 0.5, 0.3, 0.2)
"""Seconds that a segment may last, longest first."""
PERTURBATIONS = (1e-5, 1e-2)
"""Changes of the initial states whose growth is measured, relative to their spread; the smaller one
counts. Contacts that chatter at the model's timestep make jumps of one size, much beside a small
change, which seldom makes any, and little beside a large one."""
LARGEST_GROWTH = 4.0
"""Growth of a small perturbation within a segment; above it sensitivities cease to be linear."""
LARGEST_ERROR = 0.2
"""Error within a segment, relative to the signal's spread, for the same reason."""
BEYOND = 4.0
"""Standard deviations of its noise that the error of a signal may reach by noise alone."""
MUCH_SHORTER = 0.4
"""Part of the model's timestep up to which one that samples ask for is told."""
MOST = 0.9
"""Share of the segments that must keep below both."""
GONE = 100.0
"""Spreads of a signal that a prediction may be off before it counts as diverged, if half the
timestep makes most of that: a model that only lacks an effect errs alike at any timestep."""


def choose_horizon(
    simulator: Predictor,
    recordings: Sequence[Recording],
    grid: Grid,
    num_fitted: int | None = None,
) -> tuple[float, Segments]:
    """Choose the longest horizon over which fits are nearly linear, and cut there.

    The longest of those that leave enough segments to be certain, of the first `num_fitted`
    recordings or of all.

    Growth is the change of the signals after a small change of the initial state, both relative to
    the signals' spread, if it lasts; the error is that of the model from the measured initial
    state, less what noise makes of it, in signals that spread beyond `QUIET` times their noise, if
    there are any.
    """
    horizons = _possible(recordings)
    segments = cut(recordings, grid, horizons[0])
    predicted = _perturbed(simulator, simulator.base, segments)
    growth, error = _growth(predicted, segments), _error(predicted[0], segments)

    def cut_into(horizon: float) -> Segments:
        return segments if horizon == horizons[0] else cut(recordings, grid, horizon)

    for horizon in horizons[:-1]:
        steps = max(2, round(horizon / grid.interval))
        grown = _lasting(growth, segments.place, steps)
        wrong = np.where(segments.place < steps, error, 0.0).max(axis=1)
        if not (_is_within(grown) and _is_within(wrong)):
            continue
        chosen = cut_into(horizon)
        fitted = chosen.recording < (len(recordings) if num_fitted is None else num_fitted)
        if np.sum(fitted & chosen.is_whole) >= FEWEST_SEGMENTS:
            return horizon, chosen
    return horizons[-1], cut_into(horizons[-1])


def warn_of_divergence(
    simulator: Predictor,
    recordings: Sequence[Recording],
    grid: Grid,
    horizon: float,
) -> tuple[str, ...]:
    """Say in words where the model as it is diverges at its timestep; nothing where it does not.

    Args:
        simulator: The model.
        recordings: What was measured.
        grid: The simulated steps.
        horizon: What `choose_horizon` chose.

    Raises:
        UserError: It diverges even within the shortest segments.
    """
    longest = _possible(recordings)[0]
    segments = cut(recordings, grid, longest)

    base, finer = simulator.base[None], simulator.refined(2)
    start, (predicted,) = _from_measured(
        lambda start: simulator.predict(base, start[None], segments), segments
    )
    (halved,) = finer.predict(finer.base[None], start[None], segments)
    diverges, samples = _gone(predicted, halved, segments)
    if not np.any(diverges):
        return ()
    seconds = segments.place[np.arange(len(samples)), samples] * grid.interval
    early = np.mean(diverges & (seconds <= HORIZONS[-1]))
    when = (
        f"the model diverges within {np.median(seconds[diverges]):.2g} s of a measured state at a "
        f"timestep of {grid.timestep:g} s"
    )
    if early > 1.0 - MOST:
        odd = "look first at the warnings of the recordings, or " * any(
            recording.warnings for recording in recordings
        )
        raise UserError(
            f"{when}, so that no recording can be followed; {odd}give it a smaller timestep, an "
            "implicit integrator or softer gains"
        )
    cut_to = f"; segments were shortened to {horizon:g} s" if horizon < longest else ""
    return (f"{when}, in {diverges.sum()} of {len(diverges)} segments{cut_to}",)


def warn_of_sampling(grid: Grid, timestep: float) -> tuple[str, ...]:
    """Say that a sample is much shorter than the model's timestep [s], so that another is taken."""
    if grid.timestep > MUCH_SHORTER * timestep:
        return ()
    return (
        f"the model's timestep of {timestep:g} s is longer than a sample; it is simulated at "
        f"{grid.timestep:.3g} s, and errs otherwise at its own",
    )


def say_horizon(recordings: Sequence[Recording], horizon: float) -> str:
    """Say how long segments are, and why they are no longer."""
    if horizon == _possible(recordings)[0]:
        return f"following the recordings for {horizon:g} s at a time"
    return (
        f"segments were shortened to {horizon:g} s: within longer ones the model's error, or a "
        "small change of its initial state, grows too much, or there are too few of them"
    )


def cut_longer(
    problem: AnyProblem, recordings: Sequence[Recording], grid: Grid, theta: np.ndarray
) -> tuple[AnyProblem, Fit] | None:
    """Cut into the longest segments over which a model with some parameters can be followed.

    As `choose_horizon`, but the error is that from initial states that are fitted: those measured
    are noisy, and a better model has a smaller error than their noise makes. Where too few could be
    fitted to be certain of anything, shorter ones say more.

    Args:
        problem: The recordings, cut into shorter segments.
        recordings: What was measured.
        grid: The simulated steps.
        theta: The parameters, [num_parameters].

    Returns:
        The problem of longer segments and a fit of their initial states, or None.
    """
    everything = np.arange(len(recordings))
    for longer, _ in _predictable(problem, recordings, grid, theta, everything):
        if longer.num_fitted < FEWEST_SEGMENTS:
            continue
        settled = settle(longer, theta)
        error = _error(longer.unwhiten(settled.residual), longer.segments)
        if _is_within(error.max(axis=1)):
            return longer, settled
    return None


def cut_ever_longer(
    problem: AnyProblem, recordings: Sequence[Recording], grid: Grid, theta: np.ndarray
) -> Iterator[tuple[AnyProblem, Fit]]:
    """Cut into longer segments, the shortest first, in which small changes do not grow.

    As `cut_longer`, but however much the model errs in them.

    Yields:
        The problem of longer segments and a fit of their initial states.
    """
    everything = np.arange(len(recordings))
    for longer, _ in [*_predictable(problem, recordings, grid, theta, everything)][::-1]:
        yield longer, settle(longer, theta)


def cut_longest(
    problem: Problem, recordings: Sequence[Recording], grid: Grid, theta: np.ndarray
) -> Problem | None:
    """Cut what is held out into the longest segments in which small changes do not grow.

    As `cut_longer`, but however much the model errs: without growth the error is the model's. The
    few segments within which changes do grow are left out.

    Returns:
        Segments that are held out, and no other; None where none can be longer.
    """
    held_out = np.unique(problem.segments.recording[~problem.fitted])
    longest = next(_predictable(problem, recordings, grid, theta, held_out), None)
    if longest is None:
        return None
    longer, growth = longest
    return longer.take(growth <= 1.0)


def _predictable(
    problem: AnyProblem,
    recordings: Sequence[Recording],
    grid: Grid,
    theta: np.ndarray,
    chosen: np.ndarray,
) -> Iterator[tuple[AnyProblem, np.ndarray]]:
    """Yield longer segments of chosen recordings over which perturbations hardly grow.

    Longest first, each with its segments' growth [S], at most 1 in most.
    """
    fitted = np.unique(problem.segments.recording[problem.fitted])
    for horizon in _possible([recordings[number] for number in chosen]):
        segments = cut(recordings, grid, horizon)
        segments = segments.take(np.isin(segments.recording, chosen))
        if segments.seconds < (1 + 1e-9) * problem.horizon:
            break
        growth = _growth(_perturbed(problem.simulator, theta, segments), segments)
        growth = _lasting(growth, segments.place, int(segments.place.max()) + 1)
        if _is_within(growth):
            seen = np.isin(segments.recording, fitted)
            yield dataclasses.replace(problem, segments=segments, fitted=seen), growth


def _possible(recordings: Sequence[Recording]) -> list[float]:
    """Return the horizons that some recording lasts for, longest first; the shortest always."""
    longest = max(longest_span(recordings), HORIZONS[-1])
    return [h for h in HORIZONS if h <= longest]


def _is_within(sizes: np.ndarray) -> bool:
    """Say whether growth or error of enough segments [S] stay below their limits."""
    return bool(np.quantile(sizes, MOST, method="higher") <= 1.0)


def _perturbed(simulator: Predictor, theta: np.ndarray, segments: Segments) -> np.ndarray:
    """Predict from the measured initial states, and from those moved by each of `PERTURBATIONS`."""
    unit = np.diag(segments.start_unit)
    steps = [np.zeros((1, len(unit))), *(size * unit for size in PERTURBATIONS)]
    thetas = np.tile(theta, (sum(map(len, steps)), 1))

    def predict(start: np.ndarray) -> np.ndarray:
        return simulator.predict(thetas, start + np.concatenate(steps)[:, None], segments)

    return _from_measured(predict, segments)[1]


def _from_measured(
    predict: Callable[[np.ndarray], np.ndarray], segments: Segments
) -> tuple[np.ndarray, np.ndarray]:
    """Return the initial states of which sensors report what was measured, and predictions there.

    Args:
        predict: Returns predictions [P, S, L, num_signals], the first of which are from the initial
            states [S, nq + nv] that it is given.
        segments: The measurements.
    """
    predicted, unit = predict(segments.start), segments.start_unit
    start = as_they_are(segments.start, predicted[0, :, 0], lambda s: predict(s)[0, :, 0], unit)
    return start, predicted if start is segments.start else predict(start)


def _growth(predicted: np.ndarray, segments: Segments) -> np.ndarray:
    """Return the largest of any signal by `LARGEST_GROWTH`, [S, L]; see `_perturbed`."""
    change = np.abs(predicted[1:] - predicted[0]) / segments.spread
    by_size = zip(np.split(change, len(PERTURBATIONS)), PERTURBATIONS, strict=True)
    growth = np.min([_or_inf(part.max(axis=(0, 3)) / size) for part, size in by_size], axis=0)
    return growth / LARGEST_GROWTH


def _lasting(growth: np.ndarray, place: np.ndarray, steps: int) -> np.ndarray:
    """Return the largest growth [S, L] in the second half of the first steps of each segment, [S].

    A stiff servo answers a small push with a fast motion that soon dies out, and fits stay linear.
    """
    return np.where((place >= steps // 2) & (place < steps), growth, 0.0).max(axis=1)


def _gone(
    predicted: np.ndarray, halved: np.ndarray, segments: Segments
) -> tuple[np.ndarray, np.ndarray]:
    """Say which segments diverge at the timestep, [S] bool, and at which sample each does, [S]."""
    off = _or_inf(np.abs(predicted - segments.measured) / segments.spread)
    changed = _or_inf(np.abs(predicted - halved) / segments.spread)
    gone = (off > GONE) & (changed >= 0.5 * off) & (segments.counts > 0)
    gone = np.any(gone, axis=2)
    return np.any(gone, axis=1), np.argmax(gone, axis=1)


def _error(predicted: np.ndarray, segments: Segments) -> np.ndarray:
    """Return the largest of any signal by `LARGEST_ERROR`, [S, L]."""
    moves = segments.spread > QUIET * segments.noise
    seen = moves if np.any(moves) else np.ones_like(moves)
    error = np.maximum(np.abs(predicted - segments.measured) - BEYOND * segments.noise, 0.0)
    error = (error * segments.counts / segments.spread)[..., seen].max(axis=2)
    return _or_inf(error) / LARGEST_ERROR


def _or_inf(sizes: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(sizes), sizes, np.inf)
