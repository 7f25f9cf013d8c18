"""Ground models in recordings with GAT and GARAT, beside the plain and the repaired model.

`python benchmarks/ground.py --out DIR [--measurements FOLDER]`, where FOLDER holds the motor
pendulum's runs as its authors publish them. A case whose row lies in DIR already is not run again.
"""

import argparse
import json
import shlex
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from record import write_result

from garat_jax.diagnosis import compare, convert, load_model
from garat_jax.diagnosis.compare import read_recordings, tell
from garat_jax.diagnosis.convert import Converted
from garat_jax.diagnosis.hidden import (
    ANGLE_NOISE,
    SPEED_NOISE,
    excite,
    finer_timestep,
    simulate,
    write_csv,
)
from garat_jax.diagnosis.improve import run_improve
from garat_jax.ground import load_grounded, run_ground
from garat_jax.presets import GROUNDING
from garat_jax.runs import RunDirectory

MJCF = """<mujoco model="pendulum">
  <option timestep="0.002"/>
  <worldbody><body name="pole" pos="0 0 1">
    <joint name="hinge" axis="0 1 0" damping="0.01"/>
    <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.6"
          contype="0" conaffinity="0"/>
  </body></worldbody>
  <actuator><motor name="motor" joint="hinge" ctrlrange="-3 3" ctrllimited="true"/></actuator>
</mujoco>
"""
SECONDS, RATE, NUM_RECORDINGS = 8.0, 250.0, 4
FRICTION = 0.06
"""N m, dry: the catalogue has it."""
TIGHT, AT, WIDTH = 0.2, 0.3, 0.15
"""N m of dry friction more around an angle [rad], in a bell so wide [rad]: in no catalogue."""
BREAKAWAY = 0.02
"""rad/s below which the tight spot's friction gives way smoothly."""


def tight_spot(angle: float, speed: float) -> float:
    """Return the torque of a bearing that is tight around one angle [N m]."""
    return -TIGHT * np.exp(-(((angle - AT) / WIDTH) ** 2)) * np.tanh(speed / BREAKAWAY)


SIMULATED, REAL = "dry friction and a tight spot", "motor pendulum"
"""The cases."""


def record(out: Path) -> Converted:
    """Write recordings of the machine, by C MuJoCo alone at a finer timestep."""
    out.mkdir(parents=True, exist_ok=True)
    path = out / "pendulum.xml"
    path.write_text(MJCF)
    spec = mujoco.MjSpec.from_string(MJCF)
    spec.joints[0].frictionloss = FRICTION
    spec.option.timestep = finer_timestep(spec.option.timestep, 1 / RATE)
    model = spec.compile()
    substeps = round(1 / RATE / model.opt.timestep)
    time = np.arange(round(SECONDS * RATE)) / RATE
    rng = np.random.default_rng(0)

    def act(data: mujoco.MjData) -> None:
        data.qfrc_applied[0] = tight_spot(data.qpos[0], data.qvel[0])

    files = []
    for index in range(NUM_RECORDINGS):
        ctrl = excite(index, time, 1.2, rng)
        fine, samples = np.repeat(ctrl[:, None], substeps, axis=0), np.arange(len(time)) * substeps
        state = simulate(model, mujoco.MjData(model), fine, samples, act)
        state += rng.normal(size=state.shape) * [ANGLE_NOISE, SPEED_NOISE]
        files.append(out / f"recording_{index}.csv")
        header = ["time", "qpos.hinge", "qvel.hinge", "ctrl.motor"]
        write_csv(files[-1], header, np.column_stack([time, state, ctrl]))
    return Converted(path, tuple(files[:-1]), tuple(files[-1:]))


def run_case(name: str, made: Converted, out: Path, command: str) -> dict[str, Any]:
    """Repair a model, ground it before and after, and score all on held-out recordings."""

    def make_run(part: str, seed: int | None = None) -> RunDirectory:
        seeds = [] if seed is None else [seed]
        return RunDirectory.create(out / part, {"case": name}, command, seeds, force=True)

    repair = make_run("repaired")
    added = run_improve(made.model, made.fit, made.holdout, repair).diagnosis.selected
    card = repair.root / "model.toml"
    also, labels = [load_model(card)], ["repaired"]
    for base, path in {"model": made.model, "repaired": card}.items():
        if base == "repaired" and not added:
            continue
        for method, config in GROUNDING.items():
            run = make_run(f"{method}_{base}", 0)
            run_ground(path, made.fit, made.holdout, config, run)
            also.append(load_grounded(run.root, GROUNDING))
            labels.append(f"{method} on the {base}")
    model = load_model(made.model)
    found = compare(model, read_recordings(model, made.holdout), tell, also)
    return {
        "case": name,
        "added": [str(c.named) for c in added],
        "horizon": found.horizon,
        "noise_floor": found.error.noise_floor,
        "errors": {"model": found.error.before}
        | {label: other.error for label, other in zip(labels, found.also, strict=True)},
        "horizons": {
            str(h.seconds): {"model": h.error}
            | {
                label: other.horizons[i].error
                for label, other in zip(labels, found.also, strict=True)
            }
            for i, h in enumerate(found.horizons)
        },
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/ground"))
    parser.add_argument("--measurements", type=Path, help="folder of the motor pendulum's runs")
    parser.add_argument("--only", nargs="+", choices=[SIMULATED, REAL], default=[SIMULATED, REAL])
    arguments = parser.parse_args()
    rows = []
    for name in arguments.only:
        out = arguments.out / name.replace(" ", "_")
        done = out / "row.json"
        if not done.exists():
            if name == REAL:
                if arguments.measurements is None:
                    parser.error("give --measurements FOLDER, or leave out the real rig by --only")
                made = convert.motor_pendulum(
                    arguments.measurements, out / "data", ["ddp", "sac"], ["energy_shaping"]
                )
            else:
                made = record(out / "data")
            row = run_case(name, made, out, shlex.join(["python", *sys.argv]))
            done.write_text(json.dumps(row, indent=2))
        rows.append(json.loads(done.read_text()))
        sys.stdout.write(f"{json.dumps(rows[-1], indent=2)}\n")
    if arguments.only == [SIMULATED, REAL]:
        command = "python benchmarks/ground.py --measurements FOLDER"
        write_result("ground", rows, seeds=[0], command=command)


if __name__ == "__main__":
    main()
