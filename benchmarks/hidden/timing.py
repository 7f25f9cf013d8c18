"""Time `garat diagnose` beside mujoco.sysid, which is told the model's only wrong parameter.

Both read the same recordings and run as processes of their own, start-up included. In turns with
the diagnosis runs one with the compiler options of training. Each finds an empty compilation cache.
"""

import functools
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from garat_jax.compiler_options import FUSION_EMITTERS, OPTIMISATION_LEVEL

from .bodies import SECRETS
from .generate import Case, Surveys, Truth, generate

REPEATS = 3
OPTIONS = {
    "garat": "",
    "garat_with_training_options": f"--{OPTIMISATION_LEVEL}=1 --{FUSION_EMITTERS}=true",
}
"""XLA_FLAGS of each diagnosis that is timed."""
RATE = 250.0
CASES = {
    "pendulum": ("coulomb_friction", "joint/hinge", {"torque": 0.06}, 8.0, 20.0),
    "arm6": ("viscous_damping", "joint/lift", {"coefficient": 0.9}, 10.0, 90.0),
}
"""Kind, target and size of the effect; seconds of a recording; seconds a diagnosis may take."""


def measure_all() -> list[dict[str, Any]]:
    """Return a row for each case."""
    return [measure(name) for name in CASES]


def measure(robot: str) -> dict[str, Any]:
    """Generate a set and time both tools on it."""
    kind, target, parameters, seconds, limit = CASES[robot]
    scenes = Surveys()
    case = Case(f"timing-{robot}", "single", (kind,), "medium", (0, 0))
    secret = SECRETS[kind](target, parameters)
    truth = Truth(case, robot, (secret,), RATE, seconds, "white", 0.0, ())
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        paths = generate(truth, scenes[robot], folder)
        took = {name: [] for name in OPTIONS}
        for _ in range(REPEATS):
            for name, flags in OPTIONS.items():
                took[name].append(_time(functools.partial(_diagnose, robot, paths, folder, flags)))
        found = json.loads((folder / "out" / "diagnosis.json").read_text())
        sysid, said = _time_sysid(robot, folder)
    row = {
        **truth.to_json(),
        **{f"{name}_seconds": seconds for name, seconds in took.items()},
        **{f"{name}_median": statistics.median(seconds) for name, seconds in took.items()},
        "limit": limit,
        "met": statistics.median(took["garat"]) <= limit,
        "garat_found": [
            {k: c[k] for k in ("effect", "target", "parameters")} for c in found["selected"]
        ],
        "sysid_seconds": sysid,
        "sysid_median": statistics.median(sysid) if sysid else None,
        "sysid_found": said,
    }  # fmt: skip
    print(json.dumps({k: row[k] for k in ("robot", "garat_seconds", "sysid_seconds")}), flush=True)
    return row


def _time(action: Callable[[], Any]) -> float:
    started = time.monotonic()
    action()
    return time.monotonic() - started


def _diagnose(robot: str, paths: list[Path], folder: Path, flags: str) -> None:
    """Diagnose into `folder`/out, with XLA_FLAGS and an empty compilation cache."""
    holdout = ["--holdout", str(paths[-1])]
    data = [str(path) for path in paths[:-1]]
    garat = str(Path(sys.executable).with_name("garat"))
    program = [garat, "diagnose", str(folder / f"{robot}.xml"), *data, *holdout]
    program += ["--out", str(folder / "out"), "--force"]
    with tempfile.TemporaryDirectory() as cache:
        variables = os.environ | {"XLA_FLAGS": flags, "JAX_COMPILATION_CACHE_DIR": cache}
        subprocess.run(program, check=True, capture_output=True, env=variables)


def _time_sysid(robot: str, folder: Path) -> tuple[list[float], Any]:
    """Time mujoco.sysid; no seconds and a reason where it cannot run."""
    said: list[str] = []
    program = [sys.executable, "-m", "hidden.timing", robot, str(folder)]

    def run() -> None:
        here = Path(__file__).resolve().parents[1]
        done = subprocess.run(program, cwd=here, check=True, capture_output=True, text=True)
        said.append(done.stdout.splitlines()[-1])

    try:
        seconds = [_time(run) for _ in range(REPEATS)]
    except subprocess.CalledProcessError as error:
        return [], f"mujoco.sysid did not run: {error.stderr.strip().splitlines()[-1]}"
    return seconds, json.loads(said[-1])


def fit_with_sysid(robot: str, folder: Path) -> dict[str, float]:
    """Fit the one wrong parameter to the recordings that are not held out."""
    from mujoco import sysid

    kind, target, parameters, *_ = CASES[robot]
    joint = target.partition("/")[2]
    spec = mujoco.MjSpec.from_file(str(folder / f"{robot}.xml"))
    for other in spec.joints:
        for sensor in ("jointpos", "jointvel"):
            spec.add_sensor(
                name=f"{sensor}_{other.name}",
                type=getattr(mujoco.mjtSensor, f"mjSENS_{sensor.upper()}"),
                objtype=mujoco.mjtObj.mjOBJ_JOINT,
                objname=other.name,
            )
    model = spec.compile()
    sequences = [
        _sequence(sysid, spec, model, path) for path in sorted(folder.glob("recording_*.csv"))[:-1]
    ]
    ((name, true),) = parameters.items()
    compiled = model.joint(joint)
    before = compiled.damping[0] if kind == "viscous_damping" else compiled.frictionloss[0]

    def modify(spec: mujoco.MjSpec, p) -> None:
        if kind == "viscous_damping":
            spec.joint(joint).damping[0] = before + p.value[0]
        else:
            spec.joint(joint).frictionloss = before + p.value[0]

    start = 0.3 * true
    wanted = sysid.Parameter(
        name, nominal=start, min_value=1e-6, max_value=10 * true, modifier=modify
    )
    unknown = sysid.ParameterDict()
    unknown.add(wanted)
    residual = sysid.build_residual_fn(models_sequences=sequences)
    fitted, result = sysid.optimize(initial_params=unknown, residual_fn=residual, verbose=False)
    residuals, _, _ = residual(result.x, fitted)
    _, half = sysid.calculate_intervals(residuals, result.jac)
    estimate = float(fitted[name].value[0])
    return {"true": true, "estimate": estimate, "half_interval": float(half[0])}


def _sequence(sysid, spec: mujoco.MjSpec, model: mujoco.MjModel, path: Path):
    """Return a recording as mujoco.sysid wants it: commands at the model's timestep, sensors."""
    rows = np.genfromtxt(path, delimiter=",", names=True, deletechars="")
    assert rows.dtype.names
    step = model.opt.timestep
    repeat = round((rows["time"][1] - rows["time"][0]) / step)
    actuators = [f"ctrl.{model.actuator(i).name}" for i in range(model.nu)]
    held = np.repeat(np.stack([rows[name] for name in actuators], axis=1), repeat, axis=0)
    columns = []
    for sensor in range(model.nsensor):
        kind, _, joint = model.sensor(sensor).name.partition("_")
        columns.append(rows[f"{'qpos' if kind == 'jointpos' else 'qvel'}.{joint}"])
    measured = np.stack(columns, axis=1)
    data = mujoco.MjData(model)
    for joint in range(model.njnt):
        data.qpos[joint] = rows[f"qpos.{model.joint(joint).name}"][0]
    state = sysid.create_initial_state(model, data.qpos, data.qvel, data.act)
    return sysid.ModelSequences(
        "robot",
        spec,
        path.stem,
        state,
        sysid.TimeSeries(step * np.arange(len(held)), held),
        # mj_step's sensors are those of the step's beginning, stamped with its end.
        sysid.TimeSeries.from_names(rows["time"][1:-1] + step, measured[1:-1], model),
    )


if __name__ == "__main__":
    print(json.dumps(fit_with_sysid(sys.argv[1], Path(sys.argv[2]))))
