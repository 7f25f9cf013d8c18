"""The command `garat diagnose`: read the files, diagnose, write diagnosis.json and report.html."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from rich.console import Console

from garat_jax.diagnosis.compare import read_recordings
from garat_jax.diagnosis.conditions import diagnose_conditions
from garat_jax.diagnosis.model_card import load_model
from garat_jax.diagnosis.progress import progress
from garat_jax.diagnosis.repeat import repeatability
from garat_jax.diagnosis.report import diagnosis_sections, write_diagnosis
from garat_jax.diagnosis.results import Diagnosis
from garat_jax.effects import CATALOGUE
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
    catalogue: Catalogue = CATALOGUE,
    conditions: Mapping[str, Sequence[Path]] | None = None,
) -> Diagnosed:
    """Diagnose a model file with recordings; write diagnosis.json and report.html into a run.

    Args:
        model: MJCF or model card.
        data: Recordings to find the missing effects with.
        holdout: Recordings to prove them on; some of `data` are held out if there are none.
        run: Where to write.
        columns: Map of the recordings' columns.
        catalogue: The kinds of effect that may be missing.
        conditions: Recordings made under other conditions than `data`, by the condition's name.

    Raises:
        UserError: A file cannot be read or does not fit the model.
    """
    loaded = load_model(model, catalogue)
    recordings, held_out = (read_recordings(loaded, paths, columns) for paths in (data, holdout))
    others = {
        name: read_recordings(loaded, paths, columns) for name, paths in (conditions or {}).items()
    }
    with progress("looking at the recordings") as say:
        diagnosis = diagnose_conditions(loaded, recordings, others, held_out, say)
        again = repeatability(loaded, recordings, held_out, diagnosis.selected, say)
        diagnosis = dataclasses.replace(diagnosis, repeatability=again)
        run.write_json("diagnosis.json", diagnosis.to_json())
        say("writing the report")
        sections = diagnosis_sections(diagnosis, loaded, recordings, held_out)
        write_diagnosis(run, diagnosis, loaded.name, sections)
    Console(highlight=False, markup=False, soft_wrap=True).print(str(diagnosis))
    return Diagnosed(diagnosis, sections)
