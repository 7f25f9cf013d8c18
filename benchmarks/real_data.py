"""Diagnose published models of real rigs from their real recordings, and record what was found.

`python benchmarks/real_data.py FOLDER --out DIR`, where FOLDER holds
`free_pendulum/SinglePendulumDataForParameterEstimation.mat` and, in `motor_pendulum/`,
`control_method_METHOD__data_measured.csv` for ddp, sac and energy_shaping, and
`control_method_energy_shaping__data_measured_1kg.csv`.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

from record import write_result

from garat_jax.diagnosis import convert
from garat_jax.diagnosis.compare import read_recordings, tell
from garat_jax.diagnosis.diagnose import diagnose
from garat_jax.diagnosis.model_card import load_model
from garat_jax.diagnosis.report import diagnosis_sections, write_diagnosis
from garat_jax.plain import finite_or_null, to_plain
from garat_jax.runs import RunDirectory

CASES = {
    "free_pendulum": ("free_pendulum", None),
    "motor_pendulum_ddp": ("motor_pendulum", (["ddp"], [])),
    "motor_pendulum_sac_energy_shaping": ("motor_pendulum", (["sac"], ["energy_shaping"])),
    "motor_pendulum_1kg": ("motor_pendulum", (["energy_shaping_1kg"], [])),
}
"""Folder, and of the motor pendulum the runs to fit and those to hold out."""


def run_case(name: str, folder: Path, out: Path, command: str) -> dict[str, Any]:
    """Diagnose one rig and return a row of the table."""
    rig, runs = CASES[name]
    source, target = folder / rig, out / name / "data"
    if runs is None:
        converted = convert.free_pendulum(source, target)
    else:
        converted = convert.motor_pendulum(source, target, *runs)
    model = load_model(converted.model)
    fit, holdout = (read_recordings(model, paths) for paths in (converted.fit, converted.holdout))
    result = diagnose(model, fit, holdout, tell)
    run = RunDirectory.create(out / name / "diagnosis", {"case": name}, command, [], force=True)
    run.write_json("diagnosis.json", result.to_json())
    sections = diagnosis_sections(result, model, fit, holdout)
    write_diagnosis(run, result, model.name, sections)
    sys.stdout.write(f"{name}\n{result}\n\n")
    said = ("effect", "target", "share", "error_after", "passes", "why")
    selected = [
        {
            "effect": c.effect,
            "target": c.target,
            "indistinguishable_from": [str(other) for other in c.indistinguishable_from],
            **c.parameters,
        }
        for c in result.selected
    ]
    row = {
        "case": name,
        "verdict": result.verdict,
        "selected": selected,
        "error": result.decisive,
        "candidates": [{name: getattr(c, name) for name in said} for c in result.candidates],
        "seconds": result.seconds,
    }
    return finite_or_null(to_plain(row))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, default=Path("runs/real_data"))
    parser.add_argument("--only", choices=CASES, nargs="+", default=list(CASES))
    arguments = parser.parse_args()
    command = "python benchmarks/real_data.py FOLDER"
    rows = [run_case(name, arguments.folder, arguments.out, command) for name in arguments.only]
    if set(arguments.only) == set(CASES):
        write_result("real_data", rows, seeds=[], command=command)


if __name__ == "__main__":
    main()
