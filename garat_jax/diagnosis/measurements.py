"""Recordings: what was measured on the real machine, one file a recording, checked on reading.

Sample k is the state at `time[k]`; the command in row k is held from `time[k]` to `time[k + 1]`.
Columns: `time`, `qpos.JOINT`, `qvel.JOINT` (optional), `ctrl.ACTUATOR`, `torque.JOINT` (optional);
ball and free joints add `.0 .1 ...`. SI units.
"""

import dataclasses
import itertools
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np

from garat_jax.diagnosis.columns import actuator_names, signals, torques
from garat_jax.diagnosis.continuous import (
    is_rotation,
    unwrapped,
    with_continuous_quaternions,
    wrapped_joints,
)
from garat_jax.diagnosis.filters import white_noise
from garat_jax.diagnosis.maps import ColumnMap, read_map
from garat_jax.diagnosis.model_card import Model, check_model
from garat_jax.diagnosis.oddities import oddities
from garat_jax.diagnosis.tables import FEWEST_SAMPLES, Table, check_samples, read_table
from garat_jax.diagnosis.velocity import estimate_velocity
from garat_jax.dynamics import native_model
from garat_jax.effects.elements import quaternions
from garat_jax.errors import UserError, nearest, unknown_name

GAP = 5.0
"""A step longer than this many median steps is a gap."""
_PURPOSES = {
    "time": "the time of each sample in seconds",
    "qpos": "the position of every joint is needed",
    "ctrl": "the command of every actuator is needed; write 0 where it was off",
    "qvel": "give the velocity of every joint, or of none and it is estimated",
}
"""What columns are for, or that all of them are needed, by what their names begin with."""


@dataclasses.dataclass(frozen=True)
class Recording:
    """One recording of the real machine.

    Attributes:
        name: What it is called: its file's name, unless another was given.
        time: Seconds, strictly increasing, [T].
        qpos: Positions, [T, nq].
        qvel: Velocities, [T, nv]; measured, or estimated from the positions.
        ctrl: Commands, [T, nu]; row k is held from `time[k]` to `time[k + 1]`.
        torque: Measured torques by joint (`NAME.0` and so on for ball and free joints), [T] each.
        velocity_measured: Whether `qvel` was measured.
        spans: Index ranges [start, stop) without gaps.
        warnings: What is odd but usable, one line each.
        quaternions: The first column of each quaternion in `qpos`.
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
    quaternions: tuple[int, ...] = ()

    @property
    def interval(self) -> float:
        """Seconds from a sample to the next, the median."""
        return float(np.median(np.concatenate([np.diff(self.time[a:b]) for a, b in self.spans])))

    def __repr__(self) -> str:
        seconds = self.time[-1] - self.time[0]
        return f"Recording({self.name!r}, {len(self.time)} samples in {seconds:.3g} s)"

    @classmethod
    def read(
        cls,
        path: str | Path,
        model: Model | mujoco.MjModel,
        column_map: ColumnMap | str | Path | None = None,
        name: str = "",
    ) -> "Recording":
        """Read and check a recording of a model.

        Args:
            path: CSV, Parquet or NPZ file.
            model: The model, which names the columns.
            column_map: How the file names its columns, and in which units: a map file, or what
                `read_map` made of one.
            name: What to call it; the file's name if that is empty.

        Raises:
            UserError: The file cannot be read or does not fit the model; one line says where and
                how to mend it.
        """
        if isinstance(model, Model):
            model = native_model(model.compile(engine="mujoco"))
        elif not isinstance(model, mujoco.MjModel):
            check_model(model)
        if isinstance(column_map, str | Path):
            column_map = read_map(column_map)
        if not model.nq:
            raise UserError("the model has no joints, so nothing of it can be measured")
        table = _read(path, model, column_map)
        velocity_measured = _check_columns(table, model)
        check_samples(table)
        columns = table.columns
        time = columns["time"]
        name = name or table.path.name
        spans, warnings = _split(table.path, name, time)
        names = signals(model)
        qpos = _stack(columns, [s.name for s in names[: model.nq]], len(time))
        qpos = with_continuous_quaternions(model, _unit_quaternions(table, model, qpos))
        wrapped = wrapped_joints(model, qpos, spans)
        qpos = unwrapped(model, qpos, wrapped)
        warnings += [_said_of_wrapped(name, model, joint) for joint in wrapped]
        if velocity_measured:
            qvel = _stack(columns, [s.name for s in names[model.nq :]], len(time))
        else:
            qvel = _estimate(model, time, qpos, spans)
        ctrl = _stack(columns, ["ctrl." + name for name in actuator_names(model)], len(time))
        recording = cls(
            name=name,
            time=time,
            qpos=qpos,
            qvel=qvel,
            ctrl=ctrl,
            torque={n[7:]: column for n, column in columns.items() if n.startswith("torque.")},
            velocity_measured=velocity_measured,
            spans=spans,
            warnings=(),
            quaternions=tuple(quaternions(model)),
        )
        return dataclasses.replace(
            recording, warnings=(*warnings, *oddities(recording, model, wrapped))
        )


def checked(recordings: Iterable[Recording], least: int = 1) -> tuple[Recording, ...]:
    """Return recordings if that is what they are, and at least so many.

    Raises:
        UserError: They are something else, as a path or a single recording is, or too few.
    """
    if isinstance(recordings, Recording | str | Path):
        raise UserError(f"expected a list of recordings, not {recordings!r} alone; write [...]")
    recordings = tuple(recordings)
    for recording in recordings:
        if not isinstance(recording, Recording):
            raise UserError(
                f"expected recordings, not {recording!r}; Recording.read(path, model) reads one"
            )
    if len(recordings) < least:
        raise UserError("there are no recordings; give at least one")
    return recordings


def _read(path: str | Path, model: mujoco.MjModel, column_map: ColumnMap | None) -> Table:
    if column_map is None:
        return read_table(path)
    column_map.check({"time": "s", **{s.name: s.unit for s in (*signals(model), *torques(model))}})
    raw = read_table(path, column_map.sources)
    return Table(raw.path, column_map.apply(raw.columns))


def between_gaps(time: np.ndarray) -> list[tuple[int, int]]:
    """Return the index ranges [start, stop) of samples at some times, [T], between gaps."""
    steps = np.diff(time)
    gaps = np.flatnonzero(steps > GAP * np.median(steps))
    return list(itertools.pairwise([0, *(int(gap) + 1 for gap in gaps), len(time)]))


def longest_span(recordings: Sequence[Recording]) -> float:
    """Return for how many seconds recordings last without a gap, at most."""
    return max(float(r.time[b - 1] - r.time[a]) for r in recordings for a, b in r.spans)


def noise(recording: Recording) -> np.ndarray:
    """Estimate the standard deviation of each signal's noise, [nq + nv]; see `white_noise`.

    The four parts of a quaternion have that of the noisiest: its length is 1, so that the noise of
    w is of second order near a turn of 0, and grows with the turn.
    """
    state = np.concatenate([recording.qpos, recording.qvel], axis=1)
    parts = [white_noise(recording.time[a:b], state[a:b]) for a, b in recording.spans]
    lengths = [b - a for a, b in recording.spans]
    sizes = np.sqrt(np.average(np.square(parts), axis=0, weights=lengths))
    for first in recording.quaternions:
        sizes[first : first + 4] = sizes[first : first + 4].max()
    return sizes


def _check_columns(table: Table, model: mujoco.MjModel) -> bool:
    """Refuse unknown and missing columns; say whether velocities were measured."""
    names = [s.name for s in signals(model)]
    positions, velocities = names[: model.nq], names[model.nq :]
    commands = ["ctrl." + name for name in actuator_names(model)]
    known = ["time", *positions, *velocities, *commands, *(s.name for s in torques(model))]
    _check_actuators(table, commands)
    measured = any(name in table.columns for name in velocities)
    wanted = ["time", *positions, *commands, *(velocities if measured else [])]
    missing = [name for name in wanted if name not in table.columns]
    for name in table.columns:
        if name not in known:
            raise _unknown(table, name, known, missing)
    if missing:
        raise _missing(table, missing[0], wanted)
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


def _unknown(table: Table, name: str, known: Collection[str], missing: list[str]) -> UserError:
    """Describe a column that is none of the model's, beside one that lacks."""
    way = "--map renames columns and leaves others out"
    if missing and not nearest(name, missing):
        lack = f"{missing[0]!r} is missing ({_PURPOSES[missing[0].partition('.')[0]]})"
        return UserError(f"{table.path}: unknown column {name!r}, and {lack}; {way}")
    return UserError(f"{table.path}: {unknown_name('column', name, missing or known)} ({way})")


def _missing(table: Table, name: str, wanted: Collection[str]) -> UserError:
    """Describe a column that lacks; of those `wanted`, none is another's misspelt name."""
    purpose = _PURPOSES[name.partition(".")[0]]
    close = nearest(name, [column for column in table.columns if column not in wanted])
    there = f"nearest is {close[0]}" if close else f"there are {', '.join(table.columns)}"
    return UserError(f"{table.path}: missing column {name!r} ({purpose}); {there}")


def _split(
    path: Path, name: str, time: np.ndarray
) -> tuple[tuple[tuple[int, int], ...], list[str]]:
    """Return the spans between gaps, and what to say about them."""
    parts, usual = between_gaps(time), float(np.median(np.diff(time)))
    gaps = [stop - 1 for _, stop in parts[:-1]]
    spans = tuple((a, b) for a, b in parts if b - a >= FEWEST_SAMPLES)
    if not gaps:
        return spans, []
    if not spans:
        raise UserError(
            f"{path}: {len(gaps)} gaps longer than {GAP:g} × the usual step of {usual:g} s leave "
            f"no {FEWEST_SAMPLES} samples in a row; record without interruptions"
        )
    where = ", ".join(f"{time[gap] - time[0]:.6g}" for gap in gaps[:5])
    where += ", ..." if len(gaps) > 5 else ""
    dropped = len(time) - sum(b - a for a, b in spans)
    into = f"{len(spans)} part{'s' if len(spans) > 1 else ''}"
    lost = f"; {dropped} samples in shorter parts are left out" if dropped else ""
    return spans, [
        f"{name}: {len(gaps)} gap{'s' if len(gaps) > 1 else ''} ({where} s after the start, "
        f"usual step {usual:g} s); split there into {into}{lost}"
    ]


def _stack(columns: Mapping[str, np.ndarray], names: list[str], length: int) -> np.ndarray:
    return np.stack([columns[name] for name in names], axis=1) if names else np.zeros((length, 0))


def _unit_quaternions(table: Table, model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    qpos = qpos.copy()
    for start in quaternions(model):
        norm = np.linalg.norm(qpos[:, start : start + 4], axis=1)
        bad = ~is_rotation(qpos[:, start : start + 4])
        if bad.any():
            first, last = (signals(model)[i].name for i in (start, start + 3))
            raise UserError(
                f"{table.path}: {first} to {last} are no unit quaternion (w x y z) "
                f"at {table.rows(bad)}: their norm is {norm[bad][0]:.3g}"
            )
        qpos[:, start : start + 4] /= norm[:, None]
    return qpos


def _said_of_wrapped(name: str, model: mujoco.MjModel, joint: int) -> str:
    position = signals(model)[model.jnt_qposadr[joint]].name
    return f"{name}: {position} jumps by a turn and is taken to go on turning"


def _estimate(model: mujoco.MjModel, time, qpos, spans) -> np.ndarray:
    qvel = np.zeros((len(time), model.nv))
    for a, b in spans:
        qvel[a:b] = estimate_velocity(model, time[a:b], qpos[a:b])
    return qvel
