"""The report of a diagnosis, and of a comparison, for a reader who was not there."""

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from garat_jax import report
from garat_jax.diagnosis import figures
from garat_jax.diagnosis.diagnose import split
from garat_jax.diagnosis.figures import label
from garat_jax.diagnosis.localise import BY_CONTACTS, Place
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.metric import Errors
from garat_jax.diagnosis.model_card import Model
from garat_jax.diagnosis.report_data import (
    conditions_section,
    drift_section,
    left_section,
    next_section,
    recordings_section,
    repeatability_section,
    residuals_section,
    side_by_side_section,
    torque_section,
    unseen_section,
    warnings_section,
)
from garat_jax.diagnosis.report_effects import (
    ladder_section,
    parameters_section,
    ranking_section,
)
from garat_jax.diagnosis.results import Diagnosis
from garat_jax.diagnosis.view import View, look
from garat_jax.report import Fact, Figure, Reproduce, Section, Table
from garat_jax.runs import RunDirectory

if TYPE_CHECKING:
    from garat_jax.diagnosis.compare import Comparison

NUM_WORST = 3
"""Segments that are shaded as the worst."""
MOST_WARNINGS = 3
"""Warnings that follow the result."""
MOST_PLACES = 6
"""Patterns of the missing torque that are told."""
NUM_SIGNALS = 4
"""Signals that are drawn, those with the largest relative error."""


def write_diagnosis(
    run: RunDirectory, diagnosis: Diagnosis, name: str, sections: Sequence[Section]
) -> Path:
    """Write report.html of a diagnosis into its run directory.

    Args:
        run: The run directory.
        diagnosis: What was found.
        name: The model's name.
        sections: What `diagnosis_sections` returned.
    """
    return report.write(
        run.path("report.html"),
        kind="What is missing in the model",
        title=f"Diagnosis of {name}",
        lead=diagnosis_lead(diagnosis),
        facts=diagnosis_facts(diagnosis),
        sections=sections,
        reproduce=Reproduce.from_config(run.read_json("config.json")),
    )


def diagnosis_lead(diagnosis: Diagnosis) -> str:
    """Return the result in words for a reader who was not there."""
    return _with_warnings(_verdict(diagnosis), diagnosis.warnings)


def _with_warnings(lead: str, warnings: Sequence[str]) -> str:
    """Add the first warnings, as they are: many begin with a file's name."""
    if not warnings:
        return lead
    more = len(warnings) - MOST_WARNINGS
    rest = f"; and {more} more, below" if more > 0 else ""
    word = "Warning" if len(warnings) == 1 else "Warnings"
    told = f"{lead} {word}: {'; '.join(warnings[:MOST_WARNINGS])}{rest}"
    return told if told.endswith("?") else f"{told}."


def _verdict(diagnosis: Diagnosis) -> str:
    error, over = diagnosis.decisive, diagnosis.over
    if error.is_too_coarse:
        return error.coarseness
    spell = functools.partial(diagnosis.spelled, spell=label)
    names = " and ".join(c.with_alike(spell) for c in diagnosis.selected)
    floor = f"noise and the integrator alone make {_percent(error.noise_floor)}"
    if diagnosis.verdict == "adequate":
        return (
            "The model is adequate: on recordings held out its error is "
            f"{_percent(error.before)} of the signals' spread, and {floor}{diagnosis.blindness}."
        )
    fall = (
        f"the error on recordings held out{over} falls from {_percent(error.before)} to "
        f"{_percent(error.after)} of the signals' spread{diagnosis.farther(_percent)}; {floor}"
    )
    them = "it" if len(diagnosis.selected) == 1 else "them"
    lacks = "needs" if any(c.named in diagnosis.own for c in diagnosis.selected) else "lacks"
    if diagnosis.verdict == "missing_effect":
        return f"The model {lacks} {names}. With {them}, {fall}{diagnosis.but}."
    if names:
        rest = f"With {them}, {fall}: {diagnosis.rest}."
        return f"The model {lacks} {names}, but that is not all. {rest}"
    if rivals := diagnosis.rivals(label):
        return (
            f"Something is missing, but none of {rivals} explains more than the others for "
            f"certain, and none is added: {diagnosis.rest}."
        )
    if diagnosis.is_too_short:
        return diagnosis.sentence
    if dropped := diagnosis.dropped(label):
        return (
            f"{dropped[:1].upper()}{dropped[1:]} would explain much, but not for certain at a "
            f"timestep of 0, and is not added: {diagnosis.rest}. A smaller timestep may tell."
        )
    return f"Something is missing that no effect in the catalogue explains: {diagnosis.rest}."


def diagnosis_facts(diagnosis: Diagnosis) -> list[Fact]:
    """Return the numbers of a diagnosis to be seen first."""
    error, over = diagnosis.decisive, diagnosis.over
    left = f"of the error{diagnosis.beside_delays} stays unexplained"
    rest = Fact(_percent(diagnosis.gap.unexplained_share), left)
    if num := len(error.above_floor if diagnosis.but else diagnosis.loud):
        rest = Fact(str(num), f"{'signal stays' if num == 1 else 'signals stay'} above the noise")
    after = Fact(_percent(error.after), f"error{over} with the effects that were found")
    return [
        Fact(_percent(error.before), f"error of the model as it is{over}, of each signal's spread"),
        *([after] if diagnosis.selected else []),
        Fact(_percent(error.noise_floor), "noise floor: what noise and the integrator alone make"),
        rest,
    ]


def diagnosis_sections(
    diagnosis: Diagnosis,
    model: Model,
    recordings: Sequence[Recording],
    holdout: Sequence[Recording] = (),
) -> list[Section]:
    """Return the sections of a diagnosis; they simulate what they show.

    Args:
        diagnosis: What was found.
        model: The model as it was given.
        recordings: The recordings that `diagnose` was given.
        holdout: Those that it was given to hold out.
    """
    fitted, held_out, _ = split(recordings, holdout)
    everything = (*fitted, *held_out)
    view = look(model, everything, range(len(fitted), len(everything)), diagnosis.selected)
    return [
        _errors(diagnosis.shown, view),
        traces(view),
        *([] if diagnosis.verdict == "adequate" else _where(diagnosis.where, view)),
        *ranking_section(diagnosis),
        *unseen_section(diagnosis.unseen),
        *ladder_section(diagnosis),
        *parameters_section(diagnosis, model),
        *conditions_section(diagnosis),
        *drift_section(diagnosis.drifts),
        *repeatability_section(diagnosis),
        *next_section(diagnosis),
        *left_section(diagnosis),
        *warnings_section(diagnosis.warnings, MOST_WARNINGS),
    ]


def write_comparison(
    run: RunDirectory,
    comparison: "Comparison",
    model: Model,
    recordings: Sequence[Recording],
) -> Path:
    """Write report.html of a comparison into its run directory."""
    error, view = comparison.error, look(model, recordings, range(len(recordings)))
    facts = [
        Fact(_percent(error.before), "error, of each signal's spread"),
        Fact(_percent(error.noise_floor), "noise floor: what noise and the integrator alone make"),
        Fact(str(len(recordings)), "recording" + "s" * (len(recordings) != 1)),
    ]
    return report.write(
        run.path("report.html"),
        kind="A model against measurements",
        title=f"Comparison of {model.name}",
        lead=_with_warnings(comparison.sentence, comparison.warnings),
        facts=facts,
        sections=[
            *side_by_side_section(comparison),
            _errors(error, view),
            traces(view),
            residuals_section(
                comparison.residuals,
                comparison.residuals.sentence(comparison.near_noise),
                comparison.horizon,
            ),
            *torque_section(comparison.torques),
            *([] if comparison.near_noise else _where(comparison.where, view)),
            recordings_section(comparison.recordings),
            *warnings_section(comparison.warnings, MOST_WARNINGS),
        ],
        reproduce=Reproduce.from_config(run.read_json("config.json")),
    )


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share < 0.995 else f"{100 * share:.0f} %"


def _errors(error: Errors, view: View) -> Section:
    before, after = view.before, view.after
    stated = [
        (
            name,
            row["unit"],
            row["before"],
            *([row["after"]] if view.after else []),
            row["noise_floor"],
        )
        for name, row in error.per_signal.items()
    ]
    repaired = ["repaired"] if view.after else []
    columns = ["signal", "unit", "model as it is", *repaired, "noise floor"]
    sizes = [p.sizes() for p in after or before]
    by_horizon = [
        (name, size.unit, *(s[name].rmse for s in sizes)) for name, size in sizes[0].items()
    ]
    fits = [(name, *(round(s[name].fit_percent, 1) for s in sizes)) for name in sizes[0]]
    over = f"over {', '.join(view.recordings[i].name for i in view.shown)}"
    which = "repaired model" if view.after else "model as it is"
    return Section(
        "How far the model is off",
        "The recordings are cut into short segments. The model starts each one from the state that "
        "fits the segment best and is given the recorded commands; what it then predicts is "
        "compared with what was measured. An error of 100 % of the spread is as bad as always "
        "predicting the signal's mean; the spread is that of the recordings on which the error is "
        f"measured.\n\nThe error stated in this report is the {error.metric}.",
        figures=[
            Figure(
                figures.errors_by_horizon(before, after, error.noise_floor),
                f"Error {over} against how far ahead is predicted. At the dotted line the noise "
                "of the sensors and the integrator's error alone are left.",
                "Error by horizon",
            )
        ],
        tables=[
            Table(
                columns,
                stated,
                "Root mean square error of each signal, in its own unit. The noise floor is what "
                "the sensors' noise and the integrator's error alone would make.",
            ),
            Table(
                ["signal", "unit", *(f"{p.horizon:g} s" for p in view.before)],
                by_horizon,
                f"Root mean square error of the {which} by horizon, {over}.",
            ),
            Table(
                ["signal", *(f"{p.horizon:g} s" for p in view.before)],
                fits,
                f"Fit of the {which} in per cent, 100 (1 - |y - ŷ| / |y - mean y|): 100 is "
                "perfect, 0 no better than the mean.",
            ),
        ],
    )


def traces(view: View) -> Section:
    """Return the section that shows predictions beside the measurements."""
    before = view.before[view.middle]
    after = view.after[view.middle] if view.after else None
    order = before.worst(len(before.segments.first))
    index = int(before.segments.recording[order[0]])
    recording = view.recordings[index]
    worst = [s for s in order if before.segments.recording[s] == index][:NUM_WORST]
    measured = before.only([index]).names  # what was estimated is no proof
    sizes = [size.relative for size in before.sizes().values()][: len(measured)]
    chosen = sorted(np.argsort(sizes)[::-1][:NUM_SIGNALS])
    seconds = before.horizon
    segments = f"{len(worst)} segments" if len(worst) > 1 else "segment"
    drawn = [
        Figure(
            figures.traces(recording, index, int(i), before, after, worst),
            f"Above, {before.names[i]} as measured in {recording.name} and as simulated; every "
            f"{seconds:g} s the simulation starts anew. Below, simulated minus measured. Shaded: "
            f"the {segments} in which the model as it is does worst.",
            before.names[i],
        )
        for i in chosen
    ]
    held = "Of the recordings that were held out, this is" if view.after else "This is"
    text = f"{held} {recording.name}, in which the model as it is does worst."
    return Section("Measured against simulated", text, figures=drawn)


def _where(places: Sequence[Place], view: View) -> list[Section]:
    if not places:
        return []
    dof = view.missing.dofs.index(places[0].signal)
    unit = "m" if view.missing.slides[dof] else "rad"
    law = ""
    if view.explained is not None:
        law = " The line is what the repaired model gives by the same computation."
    told = places[:MOST_PLACES]
    evidence = "\n".join(f"- {place.evidence}" for place in told)
    if any(place.regime == BY_CONTACTS for place in told):
        evidence += (
            "\n\nThe torque of a contact follows from how deep the bodies press into each other, "
            "which the noise of measured positions changes by much: read that line as a sign that "
            "something is off while in contact, not of how much."
        )
    return [
        Section(
            "Where it fails",
            "Inverse dynamics tells the torque that the measured motion took; what the model's "
            "actuators did not give is missing. The shares say how well one simple pattern "
            "fits the missing torque; patterns overlap, so they do not add up to 100 %."
            f"\n\n{evidence}",
            figures=[
                Figure(
                    figures.where_it_fails(places),
                    "The longest bar is the pattern that the missing torque follows most closely.",
                    "What the missing torque goes with",
                )
            ],
        ),
        Section(
            f"The missing torque at {places[0].signal}",
            "The shape of this cloud tells effects apart: a step at zero velocity is dry friction, "
            "a slope is viscous friction, a level is an offset, a slope against the command is a "
            "wrong gain, or a mass where commands make most of the acceleration, and a slope "
            f"against the command's change is a delay.{law}",
            figures=[
                Figure(
                    figures.missing_torques(view.missing, view.explained, dof, unit),
                    "Grey: samples, but for a few far out. Black: their mean in bins that hold "
                    "equally many." + (" Blue: the effects that were found." if law else ""),
                )
            ],
        ),
    ]
