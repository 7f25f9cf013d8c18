"""From a model and recordings to the diagnosis."""

import dataclasses
import itertools
import time
from collections.abc import Callable, Sequence

import mujoco
import numpy as np

from garat_jax.diagnosis.drift import find_drifts
from garat_jax.diagnosis.fit import settle
from garat_jax.diagnosis.judge import SMALLEST_SHARE
from garat_jax.diagnosis.localise import localise, missing_torque
from garat_jax.diagnosis.measurements import Recording, signals
from garat_jax.diagnosis.metric import ABOVE_FLOOR, make_metric, trusted
from garat_jax.diagnosis.model_card import Model
from garat_jax.diagnosis.problem import Predictor, Problem
from garat_jax.diagnosis.rank import Outcome, explain
from garat_jax.diagnosis.results import Diagnosis, Errors, Rung, Verdict
from garat_jax.diagnosis.segments import QUIET, Segments, choose_grid, cut
from garat_jax.diagnosis.separate import next_experiment
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.dynamics import native_model
from garat_jax.effects import Effect
from garat_jax.provenance import versions

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
MOST = 0.9
"""Share of the segments that must keep below both."""
ENOUGH = 250.0
"""Samples a second that a passive mechanism needs."""
UNEXPLAINED = 0.3
"""Share of the error that may stay, however near to the noise floor that is."""


def diagnose(
    model: Model,
    recordings: Sequence[Recording],
    holdout: Sequence[Recording] = (),
    say: Callable[[str], None] = lambda message: None,
    shared: Sequence[Effect] = (),
) -> Diagnosis:
    """Find where a model fails and which physical effects it is missing.

    Args:
        model: The model under diagnosis.
        recordings: What was measured.
        holdout: Recordings to prove the result on. Without any, the last quarter of the recordings
            is held out; of a single recording, its last third.
        say: Told what is being done.
        shared: Effects that act besides the model's own, and of which each may be another here: one
            that is selected takes its place.
    """
    started = time.monotonic()
    fitted, held_out, how = split(recordings, holdout)
    everything = thin((*fitted, *held_out))
    whole = dataclasses.replace(model, effects=(*model.effects, *shared))
    host = native_model(whole.compile(engine="mujoco"))
    others = make_candidates(whole, native_model(model.compile(engine="mujoco")))
    grid = choose_grid(everything, host.opt.timestep)
    say("choosing the horizon")
    horizon, segments = choose_horizon(Simulator(whole, (), grid), everything, grid)
    simulator, finer = (
        Simulator(model, (*shared, *others), grid, refine, acting=range(len(shared)))
        for refine in (1, 2)
    )
    sample = grid.interval * grid.per_sample
    problem = Problem(simulator, finer, segments, segments.recording < len(fitted), sample)
    say("the model as it is")
    settled = settle(problem, simulator.base, segments.start)
    problem = trusted(problem, settled)
    outcome = explain(problem, settled.start, say)
    error = _errors(problem, outcome, host, f"{how}, segments of {horizon:g} s")
    return Diagnosis(
        model=str(model.path),
        data=tuple(r.name for r in fitted),
        holdout=tuple(r.name for r in held_out),
        versions=versions(),
        seconds=time.monotonic() - started,
        verdict=_verdict(outcome, error),
        error=error,
        where=tuple(localise(missing_torque(host, everything))),
        candidates=outcome.candidates,
        selected=outcome.selected,
        ladder=_ladder(problem, outcome),
        drifts=find_drifts(problem, outcome.best, everything) if outcome.best else (),
        next_experiment=next_experiment((*outcome.selected, *outcome.candidates[:1])),
    )


def split(recordings: Sequence[Recording], holdout: Sequence[Recording]):
    """Return the recordings to fit, those to hold out, and a phrase that says how."""
    if holdout:
        return tuple(recordings), tuple(holdout), "on the recordings given to hold out"
    if len(recordings) > 1:
        count = max(1, len(recordings) // 4)
        return tuple(recordings[:-count]), tuple(recordings[-count:]), "on recordings held out"
    whole = recordings[0]
    border = 2 * len(whole.time) // 3
    before = tuple((a, min(b, border)) for a, b in whole.spans if a < border)
    after = tuple((max(a, border), b) for a, b in whole.spans if b > border)
    first = dataclasses.replace(whole, spans=before)
    last = dataclasses.replace(whole, name=f"{whole.name} (last third)", spans=after)
    return (first,), (last,), "on the last third of the only recording"


def thin(recordings: Sequence[Recording]) -> tuple[Recording, ...]:
    """Leave out samples beyond `ENOUGH` a second where no command acts between them."""
    return tuple(r if r.ctrl.shape[1] else _every(r, _excess(r)) for r in recordings)


def _excess(recording: Recording) -> int:
    return max(1, int(1.0 / (ENOUGH * float(np.median(np.diff(recording.time)))) + 1e-6))


def _every(r: Recording, step: int) -> Recording:
    kept = [np.arange(a, b, step) for a, b in r.spans]
    borders = np.cumsum([0, *(len(k) for k in kept)])
    spans = tuple((int(a), int(b)) for a, b in itertools.pairwise(borders))
    rows = np.concatenate(kept)
    return dataclasses.replace(
        r, time=r.time[rows], qpos=r.qpos[rows], qvel=r.qvel[rows], ctrl=r.ctrl[rows], spans=spans
    )


def make_candidates(model: Model, host: mujoco.MjModel) -> tuple[Effect, ...]:
    """Make every effect of the catalogue at every place of a model, each without effect.

    With one actuator, `all` is that actuator.
    """
    present = {(effect.kind, effect.target) for effect in model.effects}
    candidates = []
    for kind, cls in model.catalogue.items():
        for target in cls.targets(host):
            alone = target == "all" and "actuator" in cls.elements and host.nu < 2
            if alone or (kind, target) in present:
                continue
            candidates.append(cls(target=target, **cls.at(host, target)))
    return tuple(candidates)


def choose_horizon(simulator: Predictor, recordings, grid) -> tuple[float, Segments]:
    """Choose the longest horizon over which fits are nearly linear, and cut there.

    Growth is the change of the signals after a small change of the initial state, both relative to
    the signals' spread; the error is that of the model from the measured initial state, less what
    noise makes of it, in signals that spread beyond `QUIET` times their noise, if there are any.
    """
    longest = max(float(r.time[b - 1] - r.time[a]) for r in recordings for a, b in r.spans)
    horizons = [h for h in HORIZONS if h <= max(longest, HORIZONS[-1])]
    segments = cut(recordings, grid, horizons[0])
    sample = grid.interval * grid.per_sample
    growth, error = _growth_and_error(simulator, segments)
    limits = np.stack([growth / LARGEST_GROWTH, error / LARGEST_ERROR])
    horizon = horizons[-1]
    for horizon in horizons:
        within = limits[:, :, : max(2, round(horizon / sample))].max(axis=2)
        if np.all(np.quantile(within, MOST, axis=1, method="higher") <= 1.0):
            break
    return horizon, segments if horizon == horizons[0] else cut(recordings, grid, horizon)


def _growth_and_error(simulator: Predictor, segments: Segments) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest of any signal, each [S, L]; see `choose_horizon`."""
    unit = np.diag(segments.start_unit)
    steps = [np.zeros((1, len(unit))), *(size * unit for size in PERTURBATIONS)]
    starts = segments.start + np.concatenate(steps)[:, None]
    thetas = np.tile(simulator.base, (len(starts), 1))
    predicted = simulator.predict(thetas, starts, segments)
    moves = segments.spread > QUIET * segments.noise
    seen = moves if np.any(moves) else np.ones_like(moves)
    change = np.abs(predicted[1:] - predicted[0]) / segments.spread
    by_size = zip(np.split(change, len(PERTURBATIONS)), PERTURBATIONS, strict=True)
    growth = np.min([_or_inf(part.max(axis=(0, 3)) / size) for part, size in by_size], axis=0)
    error = np.maximum(np.abs(predicted[0] - segments.measured) - BEYOND * segments.noise, 0.0)
    error = (error * segments.weight[..., None] / segments.spread)[..., seen].max(axis=2)
    return growth, _or_inf(error)


def _or_inf(sizes: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(sizes), sizes, np.inf)


def _verdict(outcome: Outcome, error: Errors) -> Verdict:
    if outcome.adequate:
        return "adequate"
    return "missing_effect" if outcome.selected and is_explained(error) else "unexplained"


def is_explained(error: Errors) -> bool:
    """Say whether what is left is hardly any of the error, or little and near the noise floor."""
    near_floor = error.after <= ABOVE_FLOOR * error.noise_floor
    share = error.unexplained_share
    return share <= SMALLEST_SHARE or (near_floor and share <= UNEXPLAINED)


def _errors(problem: Problem, outcome: Outcome, host: mujoco.MjModel, how: str) -> Errors:
    metric, held_out = make_metric(problem), ~problem.fitted
    before = metric.error(outcome.before.residual, held_out)
    after = metric.error(outcome.after.residual, held_out)
    rest = np.sqrt(max(after**2 - outcome.floor**2, 0.0))
    segments = problem.segments
    shape = (-1, *segments.measured.shape[1:])
    listed = signals(host)
    per_signal = {}
    sampled = segments.weight[held_out] > 0
    for i in range(shape[-1]):
        sizes = [
            float(np.sqrt(np.mean(residual.reshape(shape)[sampled][:, i] ** 2)))
            for residual in (
                outcome.before.residual[held_out] / metric.trust[held_out],
                outcome.after.residual[held_out] / metric.trust[held_out],
            )
        ]
        noise = float(segments.noise[i])
        per_signal[listed[i].name] = {
            "before": sizes[0] * noise,
            "after": sizes[1] * noise,
            "noise_floor": noise,
            "unit": listed[i].unit,
        }
    return Errors(
        metric=f"root mean square of prediction error by signal's standard deviation, "
        f"{QUIET:g} times its noise at least, {how}",
        unit="1",
        before=before,
        after=after,
        noise_floor=outcome.floor,
        unexplained_share=float(rest / before) if before > 0 else 0.0,
        per_signal=per_signal,
    )


def _ladder(problem: Problem, outcome: Outcome) -> tuple[Rung, ...]:
    metric = make_metric(problem)
    fits = [(None, outcome.before), *((step.candidate, step.fit) for step in outcome.steps)]
    return tuple(
        Rung(
            candidate,
            metric.error(fitted.residual, problem.fitted),
            metric.error(fitted.residual, ~problem.fitted),
        )
        for candidate, fitted in fits
    )
