"""Turn published recordings of real rigs into recordings and models that this package reads."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from garat_jax.diagnosis.tables import read_mat, read_table
from garat_jax.errors import UserError
from garat_jax.files import write_whole, written_whole

FREE_PENDULUM_FILE = "SinglePendulumDataForParameterEstimation.mat"
# dynamicslab/MultiArm-Pendulum (MIT), EstimatedParameters_SinglePendulum.mat: distance to the
# centre of mass 0.147755 m, mass 0.147585 kg, inertia about the centre of mass 1.09119e-4 kg m²,
# gravity 9.81 m/s². Its viscous friction is left out: that is what there is to be found. An angle
# of 0 is upright, so the body lies along +z at 0.
FREE_PENDULUM_MJCF = """<mujoco model="free_pendulum">
  <option timestep="0.004" gravity="0 0 -9.81" integrator="RK4"/>
  <worldbody>
    <body name="arm">
      <joint name="pivot" type="hinge" axis="0 1 0"/>
      <inertial pos="0 0 0.147755" mass="0.147585" diaginertia="1.09119e-4 1.09119e-4 1e-6"/>
    </body>
  </worldbody>
</mujoco>
"""

# dfki-ric-underactuated-lab/torque_limited_simple_pendulum (BSD-3-Clause), its documentation of
# the hardware: point mass 0.546 kg at 0.5 m, rod and mounting 0.13 kg, in all 0.676 kg with the
# centre of mass at 0.45 m; rotor inertia 6.07e-5 kg m² before the 6:1 gear. The rod's centre of
# mass follows: (0.676 * 0.45 - 0.546 * 0.5) / 0.13 = 0.24 m, and with a length of 0.48 m its
# inertia.
MOTOR_PENDULUM_MJCF = """<mujoco model="motor_pendulum">
  <option timestep="0.002" gravity="0 0 -9.81"/>
  <worldbody>
    <body name="rod">
      <joint name="pivot" type="hinge" axis="0 1 0" armature="0.0021852"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.48" size="0.005" mass="0.13"
            contype="0" conaffinity="0"/>
      <geom name="bob" type="sphere" pos="0 0 -0.5" size="0.01" mass="0.546"
            contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="pivot"/></actuator>
</mujoco>
"""
MOTOR_PENDULUM_RUNS = {
    "ddp": ("control_method_ddp__data_measured.csv", 3.0),
    "sac": ("control_method_sac__data_measured.csv", 3.0),
    "energy_shaping": ("control_method_energy_shaping__data_measured.csv", 4.0),
    "energy_shaping_1kg": ("control_method_energy_shaping__data_measured_1kg.csv", 6.0),
}
"""File, and the seconds that look untouched by hand."""
MOTOR_PENDULUM_COLUMNS = ("time", "position", "velocity", "torque")
"""Of each file: s, rad, rad/s, N m."""


class Converted(NamedTuple):
    """A model and recordings of it.

    Attributes:
        model: MJCF file.
        fit: Recordings to find effects with.
        holdout: Recordings to prove them on.
    """

    model: Path
    fit: tuple[Path, ...]
    holdout: tuple[Path, ...]


def free_pendulum(folder: Path, out: Path) -> Converted:
    """Convert the free pendulum of the University of Washington, 1 kHz, no actuator.

    The authors' identification segments become the recordings to fit, the validation segments
    those to hold out; the model is the published one without friction.

    Args:
        folder: Holds `SinglePendulumDataForParameterEstimation.mat`.
        out: Where the model and the recordings go.

    Raises:
        UserError: The file is not there or holds something else.
    """
    path = folder / FREE_PENDULUM_FILE
    if not path.is_file():
        raise UserError(
            f"{folder}: there is no {FREE_PENDULUM_FILE}, the free pendulum's recording"
        )
    content = read_mat(path, squeeze=False)
    try:
        segments = {"fit": _segments(content, "id"), "holdout": _segments(content, "vad")}
    except (KeyError, IndexError, ValueError, TypeError) as error:
        raise UserError(
            f"{path}: no recording of the free pendulum: {error}; expected cells Time_id and "
            "Time_vad of times [T], Y_id and Y_vad of states [2, T]"
        ) from error
    written = {
        kind: tuple(write_csv(out / f"{kind}_{i}.csv", columns) for i, columns in enumerate(made))
        for kind, made in segments.items()
    }
    model = _write_text(out / "free_pendulum.xml", FREE_PENDULUM_MJCF)
    return Converted(model, written["fit"], written["holdout"])


def _segments(content: Mapping[str, np.ndarray], key: str) -> list[dict[str, np.ndarray]]:
    """Return the columns [T] of each segment of the free pendulum: s, rad and rad/s."""
    segments = []
    cells = np.ravel(content[f"Time_{key}"]), np.ravel(content[f"Y_{key}"])
    for cell, state in zip(*cells, strict=True):
        time, (angle, speed) = np.asarray(cell, float).ravel(), np.asarray(state, float)
        columns = np.stack([time - time[0], angle, speed])
        segments.append(dict(zip(("time", "qpos.pivot", "qvel.pivot"), columns, strict=True)))
    return segments


def motor_pendulum(
    folder: Path, out: Path, fit: Sequence[str], holdout: Sequence[str] = ()
) -> Converted:
    """Convert the torque-limited pendulum of DFKI: the measured torque is the command.

    Args:
        folder: Holds the `control_method_*__data_measured*.csv` files.
        out: Where the model and the recordings go.
        fit: Runs to fit, names in `MOTOR_PENDULUM_RUNS`.
        holdout: Runs to hold out.

    Raises:
        UserError: A file is not there or holds something else.
    """
    written = {}
    for run in (*fit, *holdout):
        name, seconds = MOTOR_PENDULUM_RUNS[run]
        columns = read_table(folder / name, MOTOR_PENDULUM_COLUMNS).columns
        kept = columns["time"] <= seconds
        written[run] = write_csv(
            out / f"{run}.csv",
            {
                "time": columns["time"][kept],
                "qpos.pivot": columns["position"][kept],
                "qvel.pivot": columns["velocity"][kept],
                "ctrl.motor": columns["torque"][kept],
            },
        )
    model = _write_text(out / "motor_pendulum.xml", MOTOR_PENDULUM_MJCF)
    return Converted(model, tuple(written[r] for r in fit), tuple(written[r] for r in holdout))


def write_csv(path: Path, columns: Mapping[str, np.ndarray]) -> Path:
    """Write columns of equal length as a CSV file and return its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with (
        written_whole(path) as temporary,
        temporary.open("w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.writer(file)
        writer.writerow(columns)
        rows = zip(*columns.values(), strict=True)
        writer.writerows([f"{value:.10g}" for value in row] for row in rows)
    return path


def _write_text(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_whole(path, text)
