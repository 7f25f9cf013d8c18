"""The command `garat diagnose`: read the files, diagnose, write diagnosis.json and report.html."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from garat_jax import terminal
from garat_jax.diagnosis.conditions import (
    add_conditions,
    check_conditions,
    read_all,
    write_cards,
)
from garat_jax.diagnosis.diagnose import diagnose_keeping
from garat_jax.diagnosis.export import copy_model, needed_files
from garat_jax.diagnosis.model_card import load_model
from garat_jax.diagnosis.progress import progress
from garat_jax.diagnosis.repeat import repeatability
from garat_jax.diagnosis.report import diagnosis_sections, write_diagnosis
from garat_jax.diagnosis.report_conditions import condition_sections
from garat_jax.diagnosis.results import Diagnosis
from garat_jax.effects.catalogue import Catalogue
from garat_jax.report import Section
from garat_jax.runs import RunDirectory


class Diagnosed(NamedTuple):
    """A diagnosis, and the sections of its report."""

    diagnosis: Diagnosis
    sections: Sequence[Section]


def run_diagnose(
    model: Path,
    data: Sequence[Path],
    holdout: Sequence[Path],
    run: RunDirectory,
    columns: Path | None = None,
    catalogue: Catalogue | None = None,
    conditions: Mapping[str, Sequence[Path]] | None = None,
) -> Diagnosed:
    """Diagnose a model file with recordings; write diagnosis.json and report.html into a run.

    With conditions, model.toml and a model-CONDITION.toml for each hold what was found, with the
    model's own files in `model/`.

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
    check_conditions(loaded, others)
    if others:
        needed_files(loaded)  # or the refusal would come at the end
    with progress("looking at the recordings") as say:
        base, simulator = diagnose_keeping(loaded, recordings, held_out, say)
        diagnosis = add_conditions(loaded, base, recordings, others, held_out, say)
        diagnosis = repeatability(
            loaded, diagnosis, recordings, held_out, others, say, simulator=simulator
        )
        run.write_json("diagnosis.json", diagnosis.to_json())
        if others:
            copied = copy_model(loaded, run.path("model"))
            write_cards(run, dataclasses.replace(loaded, mjcf=copied), diagnosis)
        say("writing the report")
        sections = diagnosis_sections(diagnosis, loaded, recordings, held_out)
        sections += condition_sections(diagnosis, loaded, others)
        write_diagnosis(run, diagnosis, loaded.name, sections)
    terminal.say(str(diagnosis))
    return Diagnosed(diagnosis, sections)
