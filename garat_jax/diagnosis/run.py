"""The command `garat diagnose`: read the files, diagnose, write diagnosis.json and report.html."""

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from garat_jax.diagnosis.compare import read_recordings
from garat_jax.diagnosis.diagnose import diagnose, split
from garat_jax.diagnosis.model_card import load_model
from garat_jax.diagnosis.report import write_diagnosis
from garat_jax.diagnosis.results import Diagnosis
from garat_jax.runs import RunDirectory


def run_diagnose(
    model: Path, data: Sequence[Path], holdout: Sequence[Path], run: RunDirectory
) -> Diagnosis:
    """Diagnose a model file with recordings; write diagnosis.json and report.html into a run.

    Args:
        model: MJCF or model card.
        data: Recordings to find the missing effects with.
        holdout: Recordings to prove them on; some of `data` are held out if there are none.
        run: Where to write.

    Raises:
        UserError: A file cannot be read or does not fit the model.
    """
    loaded = load_model(model)
    recordings, held_out = read_recordings(loaded, data), read_recordings(loaded, holdout)
    with Console(stderr=True).status("reading the recordings") as status:
        diagnosis = diagnose(loaded, recordings, held_out, status.update)
        run.write_json("diagnosis.json", diagnosis.to_json())
        status.update("writing the report")
        write_diagnosis(run, diagnosis, loaded, *split(recordings, held_out)[:2])
    Console(highlight=False, markup=False, soft_wrap=True).print(str(diagnosis))
    return diagnosis
