"""Recordings: what was measured on the real machine, one file a recording, checked on reading.

Sample k is the state at `time[k]`; the command in row k is held from `time[k]` to `time[k + 1]`.
Columns: `time`, `qpos.JOINT`, `qvel.JOINT` (optional), `ctrl.ACTUATOR`, `torque.JOINT` (optional);
ball and free joints add `.0 .1 ...`. SI units.
"""

import dataclasses
import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from garat_jax.diagnosis.filters import local_slope, white_noise
from garat_jax.diagnosis.maps import ColumnMap
from garat_jax.diagnosis.model_card import Model
from garat_jax.diagnosis.tables import Table, read_table
from garat_jax.dynamics import native_model
from garat_jax.effects.base import DOFS_OF_JOINT, element_names
from garat_jax.errors import UserError, nearest, unknown_name

FEWEST_SAMPLES = 20
"""Samples that a recording must have, and each part of it between gaps."""
GAP = 5.0
"""A step longer than this many median steps is a gap."""
LARGEST_ANGLE = 50.0
"""Radians, eight turns, beyond which an angle may well be in degrees."""
SLACK = 0.5
"""Radians by which a measured angle may leave the joint's range without a word."""


class Signal(NamedTuple):
    """One measured number: its column's name and its unit."""

    name: str
    unit: str


@dataclasses.dataclass(frozen=True)
class Recording:
    """One recording of the real machine.

    Attributes:
        name: File name.
        time: Seconds, strictly increasing, [T].
        qpos: Positions, [T, nq].
        qvel: Velocities, [T, nv]; measured, or estimated from the positions.
        ctrl: Commands, [T, nu]; row k is held from `time[k]` to `time[k + 1]`.
        torque: Measured torques by joint, [T] each.
        velocity_measured: Whether `qvel` was measured.
        spans: Index ranges [start, stop) without gaps.
        warnings: What is odd but usable, one line each.
    """

    name: str
    time: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray
    torque: Mapping[str, np.ndarray]
    velocity_measured: bool
    spans: tuple[tuple[int, int], ...]
    warnings: tuple[str, ...]

    @classmethod
    def read(
        cls,
        path: str | Path,
        model: Model | mujoco.MjModel,
        column_map: ColumnMap | None = None,
    ) -> "Recording":
        """Read and check a recording of a model.

        Args:
            path: CSV, Parquet or NPZ file.
            model: The model, which names the columns.
            column_map: How the file names its columns, and in which units; see `maps.read_map`.

        Raises:
            UserError: The file cannot be read or does not fit the model; one line says where and
                how to mend it.
        """
        if isinstance(model, Model):
            model = native_model(model.compile(engine="mujoco"))
        table = _read(path, model, column_map)
        velocity_measured = _check_columns(table, model)
        _check_values(table)
        columns = table.columns
        time = columns["time"]
        spans, warnings = _split(table.path, time)
        names = signals(model)
        qpos = _stack(columns, [s.name for s in names[: model.nq]], len(time))
        qpos = _unit_quaternions(table, model, qpos)
        if velocity_measured:
            qvel = _stack(columns, [s.name for s in names[model.nq :]], len(time))
        else:
            qvel = _estimate(model, time, qpos, spans)
        ctrl = _stack(columns, ["ctrl." + name for name in _actuators(model)], len(time))
        recording = cls(
            name=table.path.name,
            time=time,
            qpos=qpos,
            qvel=qvel,
            ctrl=ctrl,
            torque={n[7:]: column for n, column in columns.items() if n.startswith("torque.")},
            velocity_measured=velocity_measured,
            spans=spans,
            warnings=(),
        )
        return dataclasses.replace(
            recording, warnings=(*warnings, *_oddities(table.path, recording, model))
        )


def _read(path: str | Path, model: mujoco.MjModel, column_map: ColumnMap | None) -> Table:
    if column_map is None:
        return read_table(path)
    column_map.check({"time": "s", **{s.name: s.unit for s in (*signals(model), *torques(model))}})
    raw = read_table(path, column_map.sources)
    return Table(raw.path, column_map.apply(raw.columns))


def torques(model: mujoco.MjModel) -> tuple[Signal, ...]:
    """List the torques that may be measured, by joint."""
    slide = int(mujoco.mjtJoint.mjJNT_SLIDE)
    kinds = [int(kind) for kind in model.jnt_type]
    return tuple(
        Signal(f"torque.{name}", "N" if kind == slide else "N m")
        for name, kind in zip(_joints(model), kinds, strict=True)
    )


def signals(model: mujoco.MjModel) -> tuple[Signal, ...]:
    """List the measured numbers of a model's state: positions [nq], then velocities [nv].

    Raises:
        UserError: A joint of the model has no name.
    """
    positions, velocities = [], []
    for joint, name in enumerate(_joints(model)):
        kind = int(model.jnt_type[joint])
        dofs = DOFS_OF_JOINT[kind]
        if dofs == 1:
            unit = "m" if kind == mujoco.mjtJoint.mjJNT_SLIDE else "rad"
            positions.append(Signal(f"qpos.{name}", unit))
            velocities.append(Signal(f"qvel.{name}", f"{unit}/s"))
            continue
        places = ["m"] * (dofs - 3)
        units = [*places, "1", "1", "1", "1"]
        positions += [Signal(f"qpos.{name}.{i}", unit) for i, unit in enumerate(units)]
        units = [*(f"{unit}/s" for unit in places), "rad/s", "rad/s", "rad/s"]
        velocities += [Signal(f"qvel.{name}.{i}", unit) for i, unit in enumerate(units)]
    return (*positions, *velocities)


def estimate_velocity(model: mujoco.MjModel, time: np.ndarray, qpos: np.ndarray) -> np.ndarray:
    """Estimate velocities from positions, by `filters.local_slope`.

    Apply it to simulated positions too wherever estimated velocities are compared.

    Args:
        model: The model, for ball and free joints: their angular velocity is in the body's frame.
        time: Seconds, increasing, [T].
        qpos: Positions, [T, nq].

    Returns:
        Velocities, [T, nv].
    """
    qpos = qpos.copy()
    for start in _quaternions(model):
        flips = np.sign(np.sum(qpos[1:, start : start + 4] * qpos[:-1, start : start + 4], axis=1))
        qpos[1:, start : start + 4] *= np.cumprod(np.where(flips < 0, -1.0, 1.0))[:, None]
    slope = local_slope(time, qpos)
    velocity = np.zeros((len(time), model.nv))
    for joint in range(model.njnt):
        position, dof = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
        dofs = DOFS_OF_JOINT[int(model.jnt_type[joint])]
        straight = dofs - 3 if dofs > 1 else 1
        velocity[:, dof : dof + straight] = slope[:, position : position + straight]
        if dofs > 1:
            at = slice(position + straight, position + straight + 4)
            velocity[:, dof + straight : dof + dofs] = _angular_velocity(qpos[:, at], slope[:, at])
    return velocity


def noise(recording: Recording) -> np.ndarray:
    """Estimate the standard deviation of each signal's noise, [nq + nv]; see `white_noise`."""
    state = np.concatenate([recording.qpos, recording.qvel], axis=1)
    parts = [white_noise(recording.time[a:b], state[a:b]) for a, b in recording.spans]
    lengths = [b - a for a, b in recording.spans]
    return np.sqrt(np.average(np.square(parts), axis=0, weights=lengths))


def _joints(model: mujoco.MjModel) -> list[str]:
    return _named(model, "joint")


def _actuators(model: mujoco.MjModel) -> list[str]:
    return _named(model, "actuator")


def _named(model: mujoco.MjModel, element: str) -> list[str]:
    names = element_names(model, element)
    if "" in names:
        raise UserError(
            f"{element} {names.index('')} of the model has no name; name it in the MJCF, since the "
            "columns of a recording are named after it"
        )
    return names


def _check_columns(table: Table, model: mujoco.MjModel) -> bool:
    """Refuse unknown and missing columns; say whether velocities were measured."""
    names = [s.name for s in signals(model)]
    positions, velocities = names[: model.nq], names[model.nq :]
    commands = ["ctrl." + name for name in _actuators(model)]
    known = ["time", *positions, *velocities, *commands, *(s.name for s in torques(model))]
    _check_actuators(table, commands)
    for name in table.columns:
        if name not in known:
            unknown = unknown_name("column", name, known)
            raise UserError(
                f"{table.path}: {unknown} (--map renames columns and leaves others out)"
            )
    measured = any(name in table.columns for name in velocities)
    for name in ["time", *positions, *commands, *(velocities if measured else [])]:
        if name not in table.columns:
            raise _missing(table, name)
    return measured


def _check_actuators(table: Table, commands: list[str]) -> None:
    """Where commands and actuators do not match, list both sides."""
    there = [name for name in table.columns if name.startswith("ctrl.")]
    if set(there) == set(commands) or len(set(there) ^ set(commands)) == 1:
        return
    raise UserError(
        f"{table.path}: its commands are {', '.join(there) or 'none'}, and the model's actuators "
        f"want {', '.join(commands) or 'none'}; rename the columns (see --map) or use the model "
        "that was recorded"
    )


def _missing(table: Table, name: str) -> UserError:
    reason = {
        "time": "the time of each sample in seconds",
        "qpos": "the position of every joint is needed",
        "ctrl": "the command of every actuator is needed; write 0 where it was off",
        "qvel": "give the velocity of every joint, or of none and it is estimated",
    }[name.partition(".")[0]]
    close = nearest(name, table.columns)
    there = f"nearest is {close[0]}" if close else f"there are {', '.join(table.columns)}"
    return UserError(f"{table.path}: missing column {name!r} ({reason}); {there}")


def _check_values(table: Table) -> None:
    time = table.columns["time"]
    if len(time) < FEWEST_SAMPLES:
        raise UserError(
            f"{table.path}: {len(time)} samples; expected at least {FEWEST_SAMPLES}, "
            "and some seconds of motion"
        )
    for name, column in table.columns.items():
        bad = ~np.isfinite(column)
        if bad.any():
            raise UserError(
                f"{table.path}: {name} is NaN, infinite or empty at {table.rows(bad)}; "
                "expected a finite number: leave such samples out, a gap is split there"
            )
    late = np.concatenate([[False], np.diff(time) <= 0])
    if late.any():
        raise UserError(
            f"{table.path}: time does not increase at {table.rows(late)}; "
            "sort the samples, leave double ones out, and give each recording its own file"
        )


def _split(path: Path, time: np.ndarray) -> tuple[tuple[tuple[int, int], ...], list[str]]:
    """Return the spans between gaps, and what to say about them."""
    steps = np.diff(time)
    usual = float(np.median(steps))
    gaps = np.flatnonzero(steps > GAP * usual)
    borders = [0, *(int(gap) + 1 for gap in gaps), len(time)]
    parts = list(itertools.pairwise(borders))
    spans = tuple((a, b) for a, b in parts if b - a >= FEWEST_SAMPLES)
    if not len(gaps):
        return spans, []
    if not spans:
        raise UserError(
            f"{path}: {len(gaps)} gaps longer than {GAP:g} × the usual step of {usual:g} s leave "
            f"no {FEWEST_SAMPLES} samples in a row; record without interruptions"
        )
    where = ", ".join(f"{time[gap]:g}" for gap in gaps[:5]) + (", ..." if len(gaps) > 5 else "")
    dropped = len(time) - sum(b - a for a, b in spans)
    lost = f"; {dropped} samples in shorter parts are left out" if dropped else ""
    return spans, [
        f"{path.name}: {len(gaps)} gap{'s' if len(gaps) > 1 else ''} (at {where} s, usual step "
        f"{usual:g} s); split there into {len(spans)} part{'s' if len(spans) > 1 else ''}{lost}"
    ]


def _stack(columns: Mapping[str, np.ndarray], names: list[str], length: int) -> np.ndarray:
    return np.stack([columns[name] for name in names], axis=1) if names else np.zeros((length, 0))


def _quaternions(model: mujoco.MjModel) -> list[int]:
    """List where quaternions start in `qpos`."""
    extra = {int(mujoco.mjtJoint.mjJNT_BALL): 0, int(mujoco.mjtJoint.mjJNT_FREE): 3}
    kinds = [int(kind) for kind in model.jnt_type]
    return [int(model.jnt_qposadr[j]) + extra[k] for j, k in enumerate(kinds) if k in extra]


def _unit_quaternions(table: Table, model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    qpos = qpos.copy()
    for start in _quaternions(model):
        norm = np.linalg.norm(qpos[:, start : start + 4], axis=1)
        bad = np.abs(norm - 1) > 0.01
        if bad.any():
            first, last = (signals(model)[i].name for i in (start, start + 3))
            raise UserError(
                f"{table.path}: {first} to {last} are no unit quaternion (w x y z) "
                f"at {table.rows(bad)}: their norm is {norm[bad][0]:.3g}"
            )
        qpos[:, start : start + 4] /= norm[:, None]
    return qpos


def _estimate(model: mujoco.MjModel, time, qpos, spans) -> np.ndarray:
    qvel = np.zeros((len(time), model.nv))
    for a, b in spans:
        qvel[a:b] = estimate_velocity(model, time[a:b], qpos[a:b])
    return qvel


def _angular_velocity(quaternion: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Return twice the vector part of conj(q) dq/dt, [T, 3]."""
    w, x, y, z = quaternion.T
    rows = np.stack([[-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]])
    return 2 * np.einsum("ijt,tj->ti", rows, slope)


def _oddities(path: Path, recording: Recording, model: mujoco.MjModel) -> list[str]:
    """Say what is odd but usable: angles and commands that cannot well be."""
    lines = []
    for joint, name in enumerate(_joints(model)):
        if model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_HINGE:
            continue
        angle = recording.qpos[:, model.jnt_qposadr[joint]]
        largest = float(np.abs(angle).max())
        low, high = model.jnt_range[joint]
        limited = bool(model.jnt_limited[joint])
        beyond = limited and (angle.min() < low - SLACK or angle.max() > high + SLACK)
        if largest > LARGEST_ANGLE or beyond:
            span = f" and the joint's range is {low:.3g} to {high:.3g} rad" if limited else ""
            lines.append(
                f"{path.name}: qpos.{name} reaches {largest:.4g} rad{span}; is it in degrees? "
                "multiply by pi/180"
            )
    for i, name in enumerate(_actuators(model)):
        low, high = model.actuator_ctrlrange[i]
        command = recording.ctrl[:, i]
        beyond = (command < low - 1e-6) | (command > high + 1e-6)
        if model.actuator_ctrllimited[i] and beyond.any():
            lines.append(
                f"{path.name}: ctrl.{name} is beyond its range {low:g} to {high:g} in "
                f"{int(beyond.sum())} of {len(command)} samples (from {command.min():.4g} to "
                f"{command.max():.4g}); the model clamps it"
            )
    return lines
