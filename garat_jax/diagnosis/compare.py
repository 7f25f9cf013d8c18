"""Compare a model as it is with measurements: how large its error is, and where."""

import dataclasses
import html
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go

from garat_jax import report
from garat_jax.diagnosis import figures
from garat_jax.diagnosis.diagnose import thin
from garat_jax.diagnosis.held_out import metric_in_words
from garat_jax.diagnosis.horizon import (
    choose_horizon,
    say_horizon,
    warn_of_divergence,
    warn_of_sampling,
)
from garat_jax.diagnosis.localise import Place, localise, missing_torque
from garat_jax.diagnosis.maps import read_map
from garat_jax.diagnosis.measurements import Recording, checked
from garat_jax.diagnosis.metric import ABOVE_FLOOR, Errors, make_metric, noise_floor
from garat_jax.diagnosis.model_card import Model, check_model, check_same_machine, load_model
from garat_jax.diagnosis.oddities import commands_turned
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.progress import tell
from garat_jax.diagnosis.quality import Quality, assess
from garat_jax.diagnosis.replay import Replay, Size, lasting_horizons, replay, replay_with
from garat_jax.diagnosis.residuals import Residuals, examine
from garat_jax.diagnosis.segments import Grid, grid_for
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.diagnosis.starts import settle
from garat_jax.diagnosis.torque import TorqueError, compare_torques
from garat_jax.diagnosis.units import after_number
from garat_jax.diagnosis.unseen import STILL, is_still
from garat_jax.dynamics import native_model
from garat_jax.effects.catalogue import Catalogue
from garat_jax.effects.elements import element_names
from garat_jax.files import distinct_names
from garat_jax.plain import finite_or_null, to_plain
from garat_jax.provenance import versions
from garat_jax.runs import RunDirectory

FORMAT = "garat-compare/1"


@dataclasses.dataclass(frozen=True)
class AtHorizon:
    """The error over one horizon: as a whole, and by signal."""

    seconds: float
    error: float
    per_signal: Mapping[str, Mapping[str, Any]]


@dataclasses.dataclass(frozen=True)
class Alternative:
    """The errors of another model of the same recordings: a repaired or a grounded one.

    Attributes:
        model: Its file or run directory.
        error: Over the horizon of the comparison's error.
        horizons: Over the comparison's horizons.
    """

    model: str
    error: float
    horizons: tuple[AtHorizon, ...]


@dataclasses.dataclass(frozen=True)
class Comparison:
    """The error of a model as it is; fields as in compare.json.

    `error` is that of diagnosis.json with no effect added: `after` equals `before`.
    """

    model: str
    data: tuple[str, ...]
    versions: Mapping[str, str | None]
    seconds: float
    error: Errors
    horizon: float
    horizons: tuple[AtHorizon, ...]
    where: tuple[Place, ...]
    residuals: Residuals
    torques: tuple[TorqueError, ...]
    recordings: tuple[Quality, ...]
    also: tuple[Alternative, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def near_noise(self) -> bool:
        """Whether the error is what noise and the integrator's own error would make."""
        return self.error.is_near_floor

    @property
    def sentence(self) -> str:
        """How large the error is, in one sentence."""
        error = self.error
        if error.is_too_coarse and STILL in self.warnings:
            return "The model cannot be judged: it moves, and in these recordings nothing does."
        if error.is_too_coarse:
            return error.coarseness
        size = f"{100 * error.before:.2g} % of the signals' spread"
        if self.near_noise:
            return f"The model is near the sensors' noise: its error is {size}."
        worst = [f"Most goes wrong at {p.signal}, {p.regime}." for p in self.where[:1]]
        times = f"{error.before / error.noise_floor:.2g} times"
        said = f"The model's error is {size}, {times} what noise and the integrator alone make."
        return " ".join([said, *worst])

    def __str__(self) -> str:
        lines = [self.sentence, *(f"  warning: {warning}" for warning in self.warnings)]
        lines += [f"  residuals: {self.residuals.sentence(self.near_noise)}"]
        for name, row in self.error.per_signal.items():
            moves = np.isfinite(row["fit_percent"])
            fit = f"fit {row['fit_percent']:.1f} %" if moves else "hardly moves"
            unit = after_number(str(row["unit"]))
            floor = f"floor {row['noise_floor']:.2g}{unit}"
            lines.append(f"  {name}: {row['before']:.4g}{unit} ({fit}, {floor})")
        lines += [f"  torque at {torque.sentence}" for torque in self.torques]
        if self.also:
            lines.append(f"  error over {self.horizon:g} s, % of the signals' spread:")
            errors = [(self.model, self.error.before), *((a.model, a.error) for a in self.also)]
            lines += [f"    {100 * error:8.3g}  {model}" for model, error in errors]
        return "\n".join(lines)

    def plot(self) -> go.Figure:
        """Draw the error against the horizon, and the noise floor."""
        named = [("model as it is", self.horizons), *((a.model, a.horizons) for a in self.also)]
        colours = (figures.BEFORE, *(c for c in report.COLOURS if c != figures.BEFORE))
        lines = [
            (name, colours[i % len(colours)], [(h.seconds, h.error) for h in horizons])
            for i, (name, horizons) in enumerate(named)
        ]
        return figures.errors_against_horizon(lines, self.error.noise_floor)

    def _repr_html_(self) -> str:
        """Return what a notebook shows."""
        return f"<pre>{html.escape(str(self))}</pre>"

    def to_json(self) -> dict[str, Any]:
        """Return the content of compare.json; what is not finite is null."""
        return {"format": FORMAT, **finite_or_null(to_plain(self))}


def compare(
    model: Model,
    recordings: Sequence[Recording],
    say: Callable[[str], None] = lambda message: None,
    also: Sequence[Model] = (),
) -> Comparison:
    """Measure the error of a model as it is.

    Args:
        model: The model.
        recordings: What was measured.
        say: Told what is being done.
        also: Other models to score beside it: repaired or grounded ones.

    Raises:
        UserError: Another model has other joints or actuators, or there are no recordings.
    """
    started = time.monotonic()
    for each in (model, *also):
        check_model(each)
    recordings = checked(recordings)
    world = model.compile(engine="mujoco")
    host = native_model(world)
    for other in also:
        theirs = other.compile(engine="mujoco").host.model
        check_same_machine(other.path, theirs, model.path, host)
    qualities = tuple(assess(r, host, world) for r in recordings)
    torques = compare_torques(host, recordings, world)
    recordings = thin(recordings)
    missing = missing_torque(host, recordings, world)
    grid = grid_for(recordings, host)
    simulator = Simulator(model, (), grid)
    say("choosing the horizon")
    stated, segments = choose_horizon(simulator, recordings, grid)
    say(say_horizon(recordings, stated))
    warnings = tuple(dict.fromkeys(w for r in recordings for w in r.warnings))
    warnings += warn_of_sampling(grid, host.opt.timestep)
    warnings += warn_of_divergence(simulator, recordings, grid, stated)
    warnings += (*commands_turned(missing), *((STILL,) if is_still(segments) else ()))
    played = {}
    for horizon in sorted({stated, *lasting_horizons(recordings)}):
        say(f"predicting over {horizon:g} s")
        played[horizon] = replay_with(simulator, recordings, grid, horizon)
    error = _errors(played[stated], simulator, grid)
    alternatives = []
    for other in also:
        say(f"predicting with {other.path}")
        wanted = dict.fromkeys(played, range(len(recordings)))
        replays = dict(zip(played, replay(other, recordings, wanted), strict=True))
        of_other = replays[stated].error()
        alternatives.append(Alternative(str(other.path), of_other, _at_horizons(replays)))
    return Comparison(
        model=str(model.path),
        data=tuple(r.name for r in recordings),
        versions=versions(),
        seconds=time.monotonic() - started,
        error=error,
        horizon=stated,
        horizons=_at_horizons(played),
        where=tuple(localise(missing)),
        residuals=examine(played[stated], recordings, element_names(host, "actuator")),
        torques=torques,
        recordings=qualities,
        also=tuple(alternatives),
        warnings=warnings,
    )


def run_compare(
    model: Path,
    data: Sequence[Path],
    run: RunDirectory,
    columns: Path | None = None,
    catalogue: Catalogue | None = None,
    also: Sequence[Model] = (),
) -> Comparison:
    """Compare a model file with recordings; write compare.json and report.html into a run.

    Args:
        model: MJCF or model card.
        data: Recordings.
        run: Where to write.
        columns: Map of the recordings' columns.
        catalogue: The kinds of effect that there are.
        also: Other models to score beside it: repaired or grounded ones.

    Raises:
        UserError: A file cannot be read or does not fit the model.
    """
    from garat_jax.diagnosis.report import write_comparison

    loaded = load_model(model, catalogue)
    recordings = read_recordings(loaded, data, columns)
    comparison = compare(loaded, recordings, tell, also)
    run.write_json("compare.json", comparison.to_json())
    write_comparison(run, comparison, loaded, recordings)
    return comparison


def read_recordings(
    model: Model,
    paths: Sequence[Path],
    columns: Path | None = None,
    among: Sequence[Path] = (),
) -> list[Recording]:
    """Read recordings of a model, and tell their warnings.

    Args:
        model: The model.
        paths: The files.
        columns: Map of their columns.
        among: All files of which the recordings' names tell each apart, if those are more.
    """
    column_map = read_map(columns) if columns else None
    names = distinct_names([*paths, *among])
    recordings = [Recording.read(path, model, column_map, names[path]) for path in paths]
    for recording in recordings:
        for warning in recording.warnings:
            tell(f"warning: {warning}")
    return recordings


def _at_horizons(played: Mapping[float, Replay]) -> tuple[AtHorizon, ...]:
    return tuple(
        AtHorizon(h, p.error(), {n: s._asdict() for n, s in p.sizes().items()})
        for h, p in played.items()
    )


def _errors(played: Replay, simulator: Simulator, grid: Grid) -> Errors:
    segments = played.segments
    nothing = np.zeros(len(segments.start), bool)
    problem = Problem(simulator, segments, nothing, grid.sample)
    metric = make_metric(problem)
    floor = noise_floor(problem, metric, settle(problem, simulator.base))
    by_noise = dict(zip(played.sizes(), floor.rms.tolist(), strict=True))
    per_signal = {name: _signal(size, by_noise[name]) for name, size in played.sizes().items()}
    return Errors.above(
        floor.error,
        metric.of_noise(~nothing),
        metric=metric_in_words(problem, "on all recordings"),
        horizon=played.horizon,
        before=played.error(),
        after=played.error(),
        timestep=grid.timestep,
        per_signal=per_signal,
        above_floor=tuple(
            name
            for name, size in played.sizes().items()
            if size.rmse > ABOVE_FLOOR * size.noise * by_noise[name]
        ),
    )


def _signal(size: Size, floor_by_noise: float) -> dict[str, float | str]:
    return {
        "before": size.rmse,
        "after": size.rmse,
        "noise_floor": size.noise * floor_by_noise,
        "fit_percent": size.fit_percent,
        "unit": size.unit,
    }
