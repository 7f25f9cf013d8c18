"""The command `garat convert`: a log of another kind becomes a recording, as a map file says."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io.matlab import mat_struct

from garat_jax.diagnosis.bags import Series, is_bag, read_bag
from garat_jax.diagnosis.continuous import JUMP, TURN, is_rotation, with_one_sign
from garat_jax.diagnosis.convert import write_csv
from garat_jax.diagnosis.maps import ColumnMap, read_map
from garat_jax.diagnosis.measurements import GAP
from garat_jax.diagnosis.tables import (
    Table,
    check_samples,
    columns_of_arrays,
    read_mat,
    read_table,
)
from garat_jax.errors import UserError

TABLES = (".csv", ".parquet", ".npz")
KINDS = "a bag (folder, .bag, .mcap, .db3), .csv, .parquet, .npz or .mat"


def convert_log(log: Path, map_file: Path, out: Path) -> str:
    """Turn a log into a CSV recording.

    Time starts at 0. A bag's topics come at times of their own: the samples are then those of
    `time` (or, without it, of the first column); states are interpolated, but not across gaps,
    commands are held.

    Args:
        log: The log.
        map_file: Which of its numbers becomes which column.
        out: The recording to write.

    Returns:
        What was written, in one line.

    Raises:
        UserError: The log or the map cannot be read, they do not fit each other, or what the log
            holds is no recording.
    """
    column_map = read_map(map_file)
    suffix = log.suffix.lower()
    if log.is_file() and log.stat().st_size == 0:
        raise UserError(f"{log}: the file is empty; expected {KINDS}")
    if is_bag(log):
        columns = _from_bag(log, column_map)
    elif suffix in TABLES:
        columns = column_map.apply(read_table(log, column_map.sources).columns)
    elif suffix == ".mat":
        columns = columns_of_arrays(log, column_map.sources, _mat(log))
        columns = column_map.apply(Table(log, columns).columns)
    else:
        raise UserError(f"{log}: unknown kind of log; expected {KINDS}")
    if "time" not in columns:
        raise UserError(f'{map_file}: the samples have no time; add time = "NAME"')
    check_samples(Table(log, columns))
    columns = {"time": columns["time"] - columns["time"][0], **_without_time(columns)}
    write_csv(out, columns)
    seconds, num = float(columns["time"][-1]), len(columns["time"])
    return f"recording: {out} ({num} samples over {seconds:.4g} s: {', '.join(columns)})"


def _without_time(columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: column for name, column in columns.items() if name != "time"}


def _from_bag(log: Path, column_map: ColumnMap) -> dict[str, np.ndarray]:
    sources = {name: column.source for name, column in column_map.columns.items()}
    series = read_bag(log, list(dict.fromkeys(sources.values())), column_map.clock)
    if "time" in sources:
        time = column_map.columns["time"].to_si(series[sources["time"]].values)
        stamps = series[sources["time"]].time
    else:
        stamps = time = next(iter(series.values())).time
    moving = [series[s] for name, s in sources.items() if not name.startswith("ctrl.")]
    covered = stamps >= max(s.time[0] for s in series.values())
    covered &= stamps <= min((s.time[-1] for s in moving), default=np.inf)
    in_gap = np.any([_in_gap(one.time, stamps) for one in moving], axis=0) if moving else False
    kept = np.concatenate([[True], np.diff(stamps) > 0]) & covered
    if not kept.any():
        raise UserError(f"{log}: the topics in {column_map.path} do not overlap in time")
    kept &= ~in_gap
    if not kept.any():
        raise UserError(f"{log}: all samples lie in gaps of the topics in {column_map.path}")
    measured = {
        name: Series(series[source].time, column_map.columns[name].to_si(series[source].values))
        for name, source in sources.items()
        if name != "time"
    }
    _make_quaternions_continuous(measured)
    return {"time": time[kept]} | {
        name: _at(one, stamps[kept], name.partition(".")[0]) for name, one in measured.items()
    }


def _in_gap(time: np.ndarray, stamps: np.ndarray) -> np.ndarray:
    """Say which stamps [T] lie in a gap between two of the times of messages, [M].

    Messages may come in bursts, and samples seldom: what is usual is the longest of a step of the
    messages, the median and the mean, and of the samples.
    """
    if len(time) < 2:
        return np.zeros(len(stamps), bool)
    steps = np.diff(time)
    usual = max(_usual(time), _usual(stamps), float(np.mean(steps)))
    after = np.clip(np.searchsorted(time, stamps), 1, len(steps))
    is_gap = steps[after - 1] > GAP * usual
    return is_gap & (stamps > time[after - 1]) & (stamps < time[after])


def _usual(time: np.ndarray) -> float:
    """Return the median of the steps between different times, 0 without any."""
    steps = np.diff(time)
    return float(np.median(steps[steps > 0])) if np.any(steps > 0) else 0.0


def _at(series: Series, stamps: np.ndarray, kind: str) -> np.ndarray:
    """Return a series at other times: the last value of a command, else interpolated.

    Where an angle begins anew after a turn, the nearest value: none lies between.
    """
    after = np.searchsorted(series.time, stamps, side="right")
    if kind == "ctrl":
        return series.values[after - 1]
    between = np.interp(stamps, series.time, series.values)
    if kind != "qpos":
        return between
    after = np.minimum(after, len(series.time) - 1)
    before = np.maximum(after - 1, 0)
    is_near = stamps - series.time[before] < series.time[after] - stamps
    nearest = np.where(is_near, series.values[before], series.values[after])
    jumps = np.abs(series.values[after] - series.values[before]) > JUMP * TURN
    return np.where(jumps, nearest, between)


def _make_quaternions_continuous(measured: dict[str, Series]) -> None:
    """Give the parts of each quaternion that are logged together one sign throughout.

    They are all that a ball joint has, or the last four of a free one, and make a rotation: hinges
    may have numbers in their names, too.
    """
    parts: dict[str, list[int]] = {}
    for name in measured:
        joint, _, number = name.rpartition(".")
        if joint.startswith("qpos.") and number.isdecimal():
            parts.setdefault(joint, []).append(int(number))
    for joint, numbers in parts.items():
        if sorted(numbers) not in ([*range(4)], [*range(7)]):
            continue
        names = [f"{joint}.{number}" for number in sorted(numbers)[-4:]]
        times = [measured[name].time for name in names]
        if all(np.array_equal(time, times[0]) for time in times):
            values = np.stack([measured[name].values for name in names], axis=1)
            if np.mean(is_rotation(values)) > 0.5:  # a driver may begin with zeros
                for name, time, column in zip(names, times, with_one_sign(values).T, strict=True):
                    measured[name] = Series(time, column)


def _mat(log: Path) -> dict[str, np.ndarray]:
    """Read the arrays of numbers in a MAT file.

    Fields of a structure are named `a.b`; cells, and the elements of an array of structures, `a.0`,
    `a.1` and so on. One cell alone is named as if it were none.
    """
    return _flatten(read_mat(log, squeeze=True))


def _flatten(content: Mapping[str, Any], prefix: str = "") -> dict[str, np.ndarray]:
    flat: dict[str, np.ndarray] = {}
    for name, value in content.items():
        if isinstance(value, mat_struct):
            fields = {field: getattr(value, field) for field in value._fieldnames}
            flat |= _flatten(fields, f"{prefix}{name}.")
        elif isinstance(value, np.ndarray) and value.dtype == object:
            cells = {str(i): cell for i, cell in enumerate(value.flat)}
            flat |= _flatten(cells, f"{prefix}{name}.")
        elif np.asarray(value).dtype.kind in "fiub":
            flat[prefix + name] = np.asarray(value, float)
    return flat
