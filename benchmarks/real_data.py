"""Diagnose published models of real rigs from their real recordings, and record what was found.

`python benchmarks/real_data.py FOLDER --out DIR`, where FOLDER holds
`free_pendulum/SinglePendulumDataForParameterEstimation.mat` and, in `motor_pendulum/`,
`control_method_METHOD__data_measured.csv` for ddp, sac and energy_shaping, and
`control_method_energy_shaping__data_measured_1kg.csv`.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from record import write_result

from garat_jax.diagnosis import convert
from garat_jax.diagnosis.compare import read_recordings, tell
from garat_jax.diagnosis.diagnose import diagnose
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.model_card import Model, load_model
from garat_jax.diagnosis.replay import replay
from garat_jax.diagnosis.report import diagnosis_sections, write_diagnosis
from garat_jax.diagnosis.view import repaired
from garat_jax.plain import finite_or_null, to_plain
from garat_jax.runs import RunDirectory


class Case(NamedTuple):
    """What is diagnosed.

    Attributes:
        rig: The rig's folder.
        fit: Runs to fit; of the free pendulum, those that the authors fitted.
        holdout: Runs to hold out; without any, the last third of the only one.
        after: The case whose findings the model has already.
    """

    rig: str
    fit: Sequence[str] = ()
    holdout: Sequence[str] = ()
    after: str | None = None


CASES = {
    "free_pendulum": Case("free_pendulum"),
    "motor_pendulum_ddp": Case("motor_pendulum", ["ddp"]),
    "motor_pendulum_sac": Case("motor_pendulum", ["sac"], ["energy_shaping"]),
    "motor_pendulum_1kg_after_sac": Case(
        "motor_pendulum", ["energy_shaping_1kg"], after="motor_pendulum_sac"
    ),
}


def run_case(
    name: str, folder: Path, out: Path, command: str, models: Mapping[str, Model]
) -> tuple[dict[str, Any], Model]:
    """Diagnose one rig; return a row of the table and the model with what was found.

    `models` holds those that other cases have repaired.
    """
    case = CASES[name]
    source, target = folder / case.rig, out / name / "data"
    if case.fit:
        converted = convert.motor_pendulum(source, target, case.fit, case.holdout)
    else:
        converted = convert.free_pendulum(source, target)
    model = models[case.after] if case.after else load_model(converted.model)
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
    after = repaired(model, result.selected)
    shown = holdout or fit
    row = {
        "case": name,
        "model_after": case.after,
        "verdict": result.verdict,
        "selected": selected,
        "error": result.decisive,
        "whole_runs": {
            "recordings": [recording.name for recording in shown],
            "unit": "rad",
            "before": angle_error(model, shown),
            "after": angle_error(after, shown),
        },
        "candidates": [{name: getattr(c, name) for name in said} for c in result.candidates],
        "seconds": result.seconds,
    }
    return finite_or_null(to_plain(row)), after


def angle_error(model: Model, recordings: Sequence[Recording]) -> float:
    """Return the root mean square error of the angle [rad], each recording followed to its end.

    The states at which they begin are fitted.
    """
    longest = max(float(r.time[-1] - r.time[0]) for r in recordings)
    (played,) = replay(model, recordings, {longest: range(len(recordings))})
    return played.sizes()["qpos.pivot"].rmse


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, default=Path("runs/real_data"))
    arguments = parser.parse_args()
    command = "python benchmarks/real_data.py FOLDER"
    rows, models = [], {}
    for name in CASES:
        row, models[name] = run_case(name, arguments.folder, arguments.out, command, models)
        rows.append(row)
    write_result("real_data", rows, seeds=[], command=command)


if __name__ == "__main__":
    main()
