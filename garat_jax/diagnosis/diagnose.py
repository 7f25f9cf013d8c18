"""From a model and recordings to the diagnosis."""

import dataclasses
import itertools
import time
from collections.abc import Callable, Sequence

import numpy as np

from garat_jax.diagnosis.drift import find_drifts
from garat_jax.diagnosis.findings import Drift, Named
from garat_jax.diagnosis.held_out import (
    HeldOut,
    measure_held_out,
    warn_of_fitted,
    warn_of_timestep,
)
from garat_jax.diagnosis.horizon import (
    choose_horizon,
    say_horizon,
    warn_of_divergence,
    warn_of_sampling,
)
from garat_jax.diagnosis.judge import NIL, is_enough
from garat_jax.diagnosis.leftover import leftover
from garat_jax.diagnosis.localise import localise, missing_torque
from garat_jax.diagnosis.measurements import Recording, checked
from garat_jax.diagnosis.metric import SMALLEST_SHARE, make_metric, trusted
from garat_jax.diagnosis.model_card import Model, check_model
from garat_jax.diagnosis.noise import signal_noise
from garat_jax.diagnosis.oddities import commands_turned
from garat_jax.diagnosis.own_effects import everywhere
from garat_jax.diagnosis.problem import FEWEST_SEGMENTS, Problem
from garat_jax.diagnosis.rank import Outcome, explain
from garat_jax.diagnosis.results import Candidate, Diagnosis, Rung, Verdict
from garat_jax.diagnosis.segments import QUIET, SHORTEST, Grid, grid_for
from garat_jax.diagnosis.separate import next_experiment
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.diagnosis.starts import settle
from garat_jax.diagnosis.steps import fit_equals
from garat_jax.diagnosis.suggest import suggest
from garat_jax.diagnosis.unseen import HELD, is_still, unseen
from garat_jax.dynamics import native_model
from garat_jax.effects import Effect, are_exclusive
from garat_jax.errors import UserError
from garat_jax.provenance import versions

ENOUGH = 250.0
"""Samples a second that a passive mechanism needs."""


def diagnose(
    model: Model,
    recordings: Sequence[Recording],
    holdout: Sequence[Recording] = (),
    say: Callable[[str], None] = lambda message: None,
    shared: Sequence[Effect] = (),
) -> Diagnosis:
    """Find where a model fails and which physical effects it is missing.

    An effect that the model has may be found, too, with another size.

    Args:
        model: The model under diagnosis.
        recordings: What was measured.
        holdout: Recordings to prove the result on. Without any, the last quarter of the recordings
            is held out; of a single recording, its last third.
        say: Told what is being done.
        shared: Effects that act besides the model's own, or in their place.
    """
    return diagnose_keeping(model, recordings, holdout, say, shared)[0]


def diagnose_keeping(
    model: Model,
    recordings: Sequence[Recording],
    holdout: Sequence[Recording],
    say: Callable[[str], None],
    shared: Sequence[Effect] = (),
) -> tuple[Diagnosis, Simulator]:
    """Return a diagnosis and the simulator that made it, whose programs are compiled.

    Args are those of `diagnose`.
    """
    started = time.monotonic()
    check_model(model)
    fitted, held_out, how = split(checked(recordings), checked(holdout, least=0))
    everything = thin((*fitted, *held_out))
    whole = model.with_effects(shared)
    world = whole.compile(engine="mujoco")
    host = native_model(world)
    grid = grid_for(everything, host)
    say("choosing the horizon")
    plain = Simulator(whole, (), grid)
    horizon, segments = choose_horizon(plain, everything, grid, num_fitted=len(fitted))
    say(say_horizon(everything, horizon))
    simulator = make_simulator(whole, grid)
    warnings = tuple(dict.fromkeys(w for r in (*recordings, *holdout) for w in r.warnings))
    warnings += warn_of_rest(fitted, held_out) + warn_of_copies(fitted, held_out)
    warnings += warn_of_sampling(grid, host.opt.timestep)
    warnings += warn_of_divergence(simulator, everything, grid, horizon)
    suggested = suggest(simulator.effects, host, fitted, world)
    seen = segments.recording < len(fitted)
    problem = Problem(simulator, segments, seen, grid.sample, suggested)
    say("the model as it is")
    settled = settle(problem, simulator.base)
    problem = trusted(problem, settled)
    outcome = explain(problem, everything, grid, settled.start, say)
    problem = outcome.problem
    too_few = few_segments(problem)
    warnings += too_few
    warnings += warn_of_fitted(problem, outcome.before, host) if outcome.adequate else ()
    fits = outcome.before, outcome.after
    floor, selected = outcome.floor, outcome.selected
    measured = measure_held_out(problem, fits, floor, everything, grid, how, selected)
    if not measured.error.is_too_coarse:
        warnings += warn_of_timestep(problem, floor, host)
    first = [c for c in outcome.candidates[:1] if c.why != NIL]
    explaining = {c.named for c in outcome.candidates if c.share >= SMALLEST_SHARE}
    verdict = verdict_of(outcome.adequate, selected, measured)
    still, missing = is_still(problem.segments), missing_torque(host, everything, world)
    if not measured.error.is_near_floor:
        warnings += tuple(commands_turned(missing))
    if still and not outcome.adequate:
        warnings += (HELD,)
    found = Diagnosis(
        model=str(model.path),
        data=tuple(r.name for r in fitted),
        holdout=tuple(r.name for r in held_out),
        versions=versions(),
        seconds=0.0,
        verdict=verdict,
        **measured._asdict(),
        where=tuple(localise(missing)),
        candidates=outcome.candidates,
        selected=selected,
        ladder=_ladder(problem, outcome),
        drifts=() if too_few else _drifts(problem, outcome, everything, verdict, say),
        next_experiment=next_experiment((*selected, *first), host),
        warnings=warnings,
        unseen=unseen(problem, outcome.before, explaining),
        still=still,
        left=(),
        own=tuple(Named(e.kind, e.target) for e in sizable(model.without(shared))),
    )
    is_seen = found.is_left and not found.is_gap_finer
    left = leftover(problem, outcome.after, everything, host) if is_seen else ()
    found = dataclasses.replace(found, left=tuple(left), seconds=time.monotonic() - started)
    return found, simulator


def split(
    recordings: Sequence[Recording], holdout: Sequence[Recording]
) -> tuple[Sequence[Recording], Sequence[Recording], str]:
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
    before, after = _long_enough(before), _long_enough(after)
    if not (before and after):
        raise UserError(
            f"{whole.name} is too short to hold out its last third; record for longer, or give "
            "another recording to prove the result on"
        )
    first = dataclasses.replace(whole, spans=before)
    last = dataclasses.replace(whole, name=f"{whole.name} (last third)", spans=after)
    return (first,), (last,), "on the last third of the only recording"


def warn_of_rest(fitted: Sequence[Recording], held_out: Sequence[Recording]) -> tuple[str, ...]:
    """Say where nothing moves, in all that is to be fitted or in all that is held out, not both.

    Rest says something where the model would move, and little elsewhere.
    """
    parts = (fitted, "to be fitted", "found"), (held_out, "held out", "proved")
    still = [part for part in parts if not any(map(_moves, part[0]))]
    if len(still) != 1:
        return ()
    ((recordings, what, why),) = still
    names = ", ".join(recording.name for recording in recordings)
    return (
        f"nothing moves in what is {what} ({names}): no command changes, and no signal by more "
        f"than {QUIET:g} times its noise, so that little can be {why} there; record motion, or "
        "hold out others (--holdout)",
    )


def warn_of_copies(fitted: Sequence[Recording], held_out: Sequence[Recording]) -> tuple[str, ...]:
    """Say which recordings that are held out have the samples of one that is fitted."""
    return tuple(
        f"{other.name} is held out and has the same samples as {one.name}, which is fitted: it "
        "proves nothing; hold out another recording"
        for one, other in itertools.product(fitted, held_out)
        if one.spans == other.spans
        and all(np.array_equal(*(getattr(r, x) for r in (one, other))) for x in ("qpos", "ctrl"))
    )


def _moves(recording: Recording) -> bool:
    num = recording.qpos.shape[1] + recording.velocity_measured * recording.qvel.shape[1]
    state = np.concatenate([recording.qpos, recording.qvel], axis=1)[:, :num]
    kept, ctrl = (
        np.concatenate([of_all[a:b] for a, b in recording.spans])
        for of_all in (state, recording.ctrl)
    )
    moves = np.any(kept.std(axis=0) > QUIET * signal_noise(recording)[:num])
    return bool(moves or np.any(np.ptp(ctrl, axis=0) > 0))


def _long_enough(spans: Sequence[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
    """Return those spans that are long enough to be a segment."""
    return tuple((a, b) for a, b in spans if b - a >= SHORTEST)


def thin(recordings: Sequence[Recording]) -> tuple[Recording, ...]:
    """Leave out samples beyond `ENOUGH` a second where no command acts between them.

    Spans of which too few would be left go; a recording of none but such stays as it is.
    """
    return tuple(r if r.ctrl.shape[1] else _every(r, _excess(r)) for r in recordings)


def _excess(recording: Recording) -> int:
    return max(1, int(1.0 / (ENOUGH * recording.interval) + 1e-6))


def _every(r: Recording, step: int) -> Recording:
    kept = [rows for a, b in r.spans if len(rows := np.arange(a, b, step)) >= SHORTEST]
    if not kept:
        return r
    borders = np.cumsum([0, *(len(k) for k in kept)])
    spans = tuple((int(a), int(b)) for a, b in itertools.pairwise(borders))
    rows = np.concatenate(kept)
    return dataclasses.replace(
        r, time=r.time[rows], qpos=r.qpos[rows], qvel=r.qvel[rows], ctrl=r.ctrl[rows], spans=spans
    )


def make_candidates(model: Model) -> tuple[Effect, ...]:
    """Make every effect of the catalogue at every place of a model, each without effect.

    Places are those of the model without its own effects, of which some add bodies. With one
    actuator, `all` is that actuator.

    Raises:
        UserError: One of a user's own fails; see `everywhere`.
    """
    host = dataclasses.replace(model, effects=()).compile(engine="mujoco").host.model
    candidates = []
    for cls in model.catalogue.values():
        for effect in everywhere(cls, host):
            alone = effect.target == "all" and "actuator" in cls.elements and host.nu < 2
            if not alone and not any(are_exclusive(effect, present) for present in model.effects):
                candidates.append(effect)
    return tuple(candidates)


def sizable(model: Model) -> tuple[Effect, ...]:
    """Return the model's own effects of its catalogue that have a size; those of a table do not."""
    of_table = [any(getattr(e, name) for name in e.tables) for e in model.effects]
    pairs = zip(model.effects, of_table, strict=True)
    return tuple(e for e, is_table in pairs if e.kind in model.catalogue and not is_table)


def make_simulator(model: Model, grid: Grid) -> Simulator:
    """Make the simulator in which any effect may be missing, or one of the model's be another."""
    own = sizable(model)
    candidates = (*own, *make_candidates(model))
    return Simulator(model.without(own), candidates, grid, acting=range(len(own)))


def few_segments(problem: Problem) -> tuple[str, ...]:
    """Say that too little was recorded to be certain of anything; nothing where it suffices."""
    if is_enough(problem):
        return ()
    num, how = problem.num_fitted, "fitted"
    if num >= FEWEST_SEGMENTS:
        num, how = int((~problem.fitted).sum()), "held out"
    pieces = f"{num} piece" + "s" * (num != 1)
    return (
        f"only {pieces} of {problem.horizon:.2g} s could be {how}, too few to be certain of an "
        "effect or of an interval; record for longer",
    )


def verdict_of(adequate: bool, selected: Sequence[Candidate], measured: HeldOut) -> Verdict:
    """Return the verdict.

    Args:
        adequate: Whether the model as it is comes near the noise in what was fitted.
        selected: What was found.
        measured: The held-out errors with it.
    """
    if adequate and not measured.error.is_too_coarse:
        longest = measured.longest
        return "adequate" if longest is None or longest.is_adequate else "unexplained"
    return "missing_effect" if selected and measured.are_explained else "unexplained"


def _drifts(
    problem: Problem,
    outcome: Outcome,
    everything: Sequence[Recording],
    verdict: Verdict,
    say: Callable[[str], None],
) -> tuple[Drift, ...]:
    """Return what drifts: of what was found or, where it is unexplained, of what is as good."""
    if outcome.best is None:
        return ()
    fits = [outcome.best]
    if verdict == "unexplained":
        fits += fit_equals(problem, outcome.steps, outcome.after, say)
    return find_drifts(problem, fits, everything)


def _ladder(problem: Problem, outcome: Outcome) -> tuple[Rung, ...]:
    metric = make_metric(problem)
    steps = zip(outcome.selected, outcome.steps, strict=True)
    fits = [(None, outcome.before), *((final, step.fit) for final, step in steps)]
    return tuple(
        Rung(
            added,
            metric.error(fitted.residual, problem.fitted),
            metric.error(fitted.residual, ~problem.fitted),
        )
        for added, fitted in fits
    )
