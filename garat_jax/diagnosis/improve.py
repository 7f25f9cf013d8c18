"""Repair a model: diagnose, add what was found, repeat until nothing passes the gates."""

import dataclasses
import html
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import plotly.graph_objects as go

from garat_jax import report
from garat_jax.diagnosis.conditions import (
    add_conditions,
    check_conditions,
    read_all,
    write_cards,
)
from garat_jax.diagnosis.diagnose import diagnose, few_segments, make_simulator, split, thin
from garat_jax.diagnosis.drift import find_drifts
from garat_jax.diagnosis.export import copy_model, needed_files
from garat_jax.diagnosis.findings import Candidate, Drift, apart
from garat_jax.diagnosis.held_out import HeldOut, measure_held_out
from garat_jax.diagnosis.horizon import choose_horizon, cut_longer
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.metric import is_above, make_metric, noise_floor
from garat_jax.diagnosis.model_card import Model, load_model
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.progress import progress
from garat_jax.diagnosis.repeat import found_theta, repeatability, sized_columns
from garat_jax.diagnosis.report import diagnosis_facts, diagnosis_lead, diagnosis_sections
from garat_jax.diagnosis.report_conditions import condition_sections
from garat_jax.diagnosis.results import Diagnosis, Rung, Verdict
from garat_jax.diagnosis.segments import grid_for
from garat_jax.diagnosis.starts import settle
from garat_jax.diagnosis.view import repaired
from garat_jax.effects.catalogue import Catalogue
from garat_jax.plain import finite_or_null, to_plain
from garat_jax.report import Reproduce, Section, Table
from garat_jax.runs import RunDirectory

FORMAT = "garat-improve/1"
ROUNDS = 4
"""Most diagnoses in a row; the last one finds nothing, or the catalogue is used up."""


@dataclasses.dataclass(frozen=True)
class Improvement:
    """A repaired model and how it came about.

    Attributes:
        diagnosis: All rounds as one: the first one's view of the model, everything that was added,
            the ladder over all of it at one horizon, and the last one's verdict on what is left,
            unless a finer timestep shows more, its warnings, and what the recordings do not show
            of the repaired model.
        rounds: Each diagnosis, the first of the model as it was.
        model: The repaired model.
    """

    diagnosis: Diagnosis
    rounds: tuple[Diagnosis, ...]
    model: Model

    @property
    def card(self) -> str:
        """What the model card adds, in words."""
        added = [self.diagnosis.spelled(c.named) for c in self.diagnosis.selected]
        return f"adds {' and '.join(added)}" if added else "is the model as it was"

    def __str__(self) -> str:
        lines = [self.diagnosis.sentence]
        lines += [f"  warning: {warning}" for warning in self.diagnosis.warnings]
        lines += [f"  left: {line}" for line in self.diagnosis.left_lines]
        for rung in self.diagnosis.ladder:
            added = self.diagnosis.added(rung)
            lines.append(f"  {added}: held-out error {rung.error_holdout:.4g}")
        lines += [f"  drift: {drift}" for drift in self.diagnosis.drifts]
        return "\n".join([*lines, *self.diagnosis.other_conditions])

    def _repr_html_(self) -> str:
        """Return what a notebook shows."""
        return f"<pre>{html.escape(str(self))}</pre>"

    def plot(self, what: str = "ladder") -> go.Figure:
        """Draw the `ladder` of errors over all rounds, or what `Diagnosis.plot` draws besides."""
        return self.diagnosis.plot(what)

    def to_json(self) -> dict[str, Any]:
        """Return the content of improve.json."""
        whole = self.diagnosis.to_json()
        kept = (
            "model",
            "data",
            "holdout",
            "versions",
            "verdict",
            "error",
            "longest",
            "finer",
            "on_time",
            "ladder",
            "drifts",
            "warnings",
            "unseen",
            "own",
        )
        return {
            "format": FORMAT,
            **{key: whole[key] for key in kept},
            "added": whole["selected"],
            "repeatability": whole["repeatability"],
            "conditions": whole["conditions"],
            "rounds": [found.to_json() for found in self.rounds],
            "seconds": sum(found.seconds for found in self.rounds),
        }


def improve(
    model: Model,
    recordings: Sequence[Recording],
    holdout: Sequence[Recording] = (),
    say: Callable[[str], None] = lambda message: None,
    conditions: Mapping[str, Sequence[Recording]] | None = None,
) -> Improvement:
    """Add effects to a model until no further one passes the gates of a diagnosis.

    Args:
        model: The model.
        recordings: What was measured.
        holdout: Recordings to prove the result on; see `diagnose`.
        say: Told what is being done.
        conditions: Recordings made under other conditions, by name; what they show besides is found
            once the model of the base condition is whole. See `diagnose_conditions`.

    Raises:
        UserError: The recordings of a condition are too short to be diagnosed.
    """
    check_conditions(model, conditions or {})
    current, rounds = model, []
    for number in range(ROUNDS):
        found = diagnose(
            current,
            recordings,
            holdout,
            lambda line, n=number: say(f"diagnosis {n + 1}: {line}"),
        )
        rounds.append(found)
        if not found.selected:
            break
        current = repaired(current, found.selected)
    added = tuple({c.named: c for found in rounds for c in found.selected}.values())
    say("measuring the ladder")
    whole = _as_one(model, recordings, holdout, rounds, added)
    if conditions:
        whole = add_conditions(model, whole, recordings, conditions, holdout, say)
    whole = repeatability(model, whole, recordings, holdout, conditions, say)
    return Improvement(whole, tuple(rounds), repaired(model, whole.selected))


def _as_one(model: Model, recordings, holdout, rounds: list[Diagnosis], added) -> Diagnosis:
    """Return all rounds as one diagnosis, its errors measured at one horizon."""
    first, last = rounds[0], rounds[-1]
    if not added:
        return first
    ladder, measured, drifts = _ladder(model, recordings, holdout, added)
    if drifts and len(added) == len(first.selected):  # its diagnosis tested what is as good, too
        drifts = first.drifts or drifts
    stays = last.verdict == "unexplained" and not measured.are_explained
    stays |= not measured.are_explained_at_finer
    verdict: Verdict = "unexplained" if stays else "missing_effect"
    return dataclasses.replace(
        first,
        verdict=verdict,
        **measured._asdict(),
        selected=apart(added),
        ladder=ladder,
        drifts=drifts,
        left=last.left if stays else (),
        next_experiment=last.next_experiment or first.next_experiment,
        warnings=last.warnings,
        unseen=last.unseen,
    )


def _ladder(
    model: Model, recordings, holdout, added: Sequence[Candidate]
) -> tuple[tuple[Rung, ...], HeldOut, tuple[Drift, ...]]:
    """Return what the errors of all effects together are, measured at one horizon.

    Returns:
        A rung for each effect, at its final size; the errors at this horizon, as
        `measure_held_out` has them; and which of the sizes drift.
    """
    fitted, held_out, how = split(recordings, holdout)
    everything = thin((*fitted, *held_out))
    grid = grid_for(everything, model.compile(engine="mujoco").host.model)
    simulator = make_simulator(model, grid)
    _, segments = choose_horizon(simulator, everything, grid)
    seen = segments.recording < len(fitted)
    problem = Problem(simulator, segments, seen, grid.sample)
    final = found_theta(simulator, added)
    if longer := cut_longer(problem, everything, grid, final):
        problem, _ = longer
    seen, segments, metric = problem.fitted, problem.segments, make_metric(problem)
    fits = [
        settle(problem, found_theta(simulator, added[:count])) for count in range(len(added) + 1)
    ]
    rungs = tuple(
        Rung(candidate, metric.error(f.residual, seen), metric.error(f.residual, ~seen))
        for candidate, f in zip((None, *added), fits, strict=True)
    )
    floor = noise_floor(problem, metric, fits[-1])
    measured = measure_held_out(problem, (fits[0], fits[-1]), floor, everything, grid, how, added)
    if few_segments(problem) or not is_above(problem, metric, fits[-1], floor):
        return rungs, measured, ()
    whole = dataclasses.replace(fits[-1], free=tuple(sized_columns(simulator, added)))
    return rungs, measured, find_drifts(problem, [whole], everything)


def run_improve(
    model: Path,
    data: Sequence[Path],
    holdout: Sequence[Path],
    run: RunDirectory,
    columns: Path | None = None,
    catalogue: Catalogue | None = None,
    conditions: Mapping[str, Sequence[Path]] | None = None,
) -> Improvement:
    """Repair a model file with recordings; write model.toml, improve.json and report.html.

    The model's own files are copied into `model/`, so that the run's folder is complete. Each other
    condition has a card of its own, model-CONDITION.toml.

    Args:
        model: MJCF or model card.
        data: Recordings to find the missing effects with.
        holdout: Recordings to prove them on; some of `data` are held out if there are none.
        run: Where to write.
        columns: Map of the recordings' columns.
        catalogue: The kinds of effect that may be missing.
        conditions: Recordings made under other conditions than `data`, by the condition's name.

    Raises:
        UserError: A file cannot be read, does not fit the model, or cannot be copied.
    """
    loaded = load_model(model, catalogue)
    recordings, held_out, others = read_all(loaded, data, holdout, conditions, columns)
    needed_files(loaded)  # or the refusal would come at the end
    with progress("looking at the recordings") as say:
        done = improve(loaded, recordings, held_out, say, others)
        copied = copy_model(loaded, run.path("model"))
        run.write_json("improve.json", finite_or_null(to_plain(done.to_json())))
        write_cards(run, dataclasses.replace(loaded, mjcf=copied), done.diagnosis)
        say("writing the report")
        sections = diagnosis_sections(done.diagnosis, loaded, recordings, held_out)
        sections += condition_sections(done.diagnosis, loaded, others)
    report.write(
        run.path("report.html"),
        kind="A model repaired from measurements",
        title=f"Repair of {loaded.name}",
        lead=diagnosis_lead(done.diagnosis),
        facts=diagnosis_facts(done.diagnosis),
        sections=[*sections, _rounds_section(done.rounds), _card_section(done)],
        reproduce=Reproduce.from_config(run.read_json("config.json")),
    )
    return done


def _rounds_section(rounds: Sequence[Diagnosis]) -> Section:
    """Show what each diagnosis found in the model as the one before had left it."""
    columns = ["", "verdict", "adds", "over", "before [%]", "after [%]", "noise [%]", "left [%]"]
    rows = [
        (
            number,
            found.verdict.replace("_", " "),
            ", ".join(found.spelled(c.named) for c in found.selected) or "nothing",
            found.over.removeprefix(" over "),
            *(f"{100 * e:.3g}" for e in (error.before, error.after, error.noise_floor)),
            round(100 * found.gap.unexplained_share),
        )
        for number, (found, error) in enumerate(((r, r.decisive) for r in rounds), 1)
    ]
    text = (
        "Each diagnosis begins with what the ones before it added. A better model predicts for "
        "longer, so later ones may follow the recordings over longer segments: errors, of what is "
        "held out, compare along a row, not down a column. What is left is that of the error that "
        "noise does not explain; where a gap stays beside a delay, of what the delay leaves."
    )
    return Section("Diagnosis after diagnosis", text, tables=[Table(columns, rows)])


def _card_section(done: Improvement) -> Section:
    last = done.rounds[-1]
    hidden = done.diagnosis.verdict == "unexplained"
    what_is_left = {
        "adequate": "A last diagnosis of the repaired model found it adequate"
        f"{' at its own timestep; at a finer one a gap stays' if hidden else ''}.",
        "unexplained": "A last diagnosis of the repaired model found a gap that no further effect "
        "of the catalogue explains.",
        "missing_effect": "The last diagnosis still found something; it was added, and the "
        "repetition ended there.",
    }[last.verdict]
    text = (
        f"model.toml beside this report {done.card}. It loads wherever a model is asked for: in "
        "garat compare and garat diagnose, and in garat export, which writes plain MJCF. "
        f"{what_is_left}"
    )
    return Section("The repaired model", text)
