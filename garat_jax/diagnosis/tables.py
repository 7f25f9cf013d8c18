"""Read a file of columns: CSV, Parquet or NPZ, as arrays of numbers. Nothing is ever unpickled.

The variables of MAT files are read here too.
"""

import csv
import re
import warnings
import zipfile
import zlib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import io

from garat_jax.env import LARGEST
from garat_jax.errors import UserError, unknown_name

FEWEST_SAMPLES = 20
"""Samples that a recording must have, and each part of it between gaps."""
DAMAGED = (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error)
"""What the readers raise on files that are damaged."""
ROWS_NAMED = 5
"""How many bad rows a message names."""
SEPARATORS = (",", ";", "\t")
"""Of a foreign CSV file: the one that its first line has most of."""
_DECIMAL_COMMA = re.compile(r"\s*[+-]?\d*,\d+([eE][+-]?\d+)?\s*")
_ARRAY = re.compile(r"(?P<name>[^\[\]]+)(\[(?P<column>\d+)\])?")


class Table:
    """Named columns of equal length from one file.

    Attributes:
        path: The file.
        columns: Arrays [T] float64, by name.
    """

    def __init__(self, path: Path, columns: dict[str, np.ndarray]):
        """Check that there are columns and that they are of equal length."""
        self.path = path
        self.columns = columns
        lengths = {name: len(column) for name, column in columns.items()}
        if not lengths:
            raise UserError(f"{path}: no columns; expected time, qpos.JOINT, ctrl.ACTUATOR")
        if len(set(lengths.values())) > 1:
            short, long = (
                min(lengths, key=lengths.__getitem__),
                max(lengths, key=lengths.__getitem__),
            )
            raise UserError(
                f"{path}: array {short!r} has {lengths[short]} samples and {long!r} has "
                f"{lengths[long]}; expected one value a sample in each"
            )

    def rows(self, bad: np.ndarray) -> str:
        """Name the rows at which a mask [T] is true: lines of a CSV file, else rows from 0."""
        indices = np.flatnonzero(bad)
        word, first = ("line", 2) if self.path.suffix.lower() == ".csv" else ("row", 0)
        named = ", ".join(str(i + first) for i in indices[:ROWS_NAMED])
        more = f" and {len(indices) - ROWS_NAMED} more" if len(indices) > ROWS_NAMED else ""
        return f"{word}{'s' if len(indices) > 1 else ''} {named}{more}"


def read_table(path: str | Path, wanted: Collection[str] | None = None) -> Table:
    """Read the columns of a CSV, Parquet or NPZ file.

    Args:
        path: The file.
        wanted: Leave out all other columns of a foreign file, whose separator may then be a
            semicolon or a tab too, and its arrays of any shape, as in `columns_of_arrays`; None
            reads every column.

    Raises:
        UserError: The file is missing, empty, of another kind, damaged, or holds anything but
            numbers.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    if path.stat().st_size == 0:
        raise UserError(f"{path}: the file is empty; expected a recording")
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise UserError(
            f"{path}: unknown kind of file {path.suffix!r}; expected {', '.join(_READERS)}"
        )
    try:
        return Table(path, reader(path, wanted))
    except UserError:
        raise
    except DAMAGED as error:
        raise damaged(path, path.suffix[1:].upper(), error) from error


def damaged(path: Path, kind: str, error: Exception) -> UserError:
    """Describe in one line a file that is not of its kind, or no longer."""
    detail = " ".join(str(error).split()) or type(error).__name__
    return UserError(f"{path}: cannot be read as {kind}: {detail}")


def check_samples(table: Table) -> None:
    """Refuse a recording without enough samples, or with values that cannot be right.

    Raises:
        UserError: There are too few samples, one is not finite, or time does not increase.
    """
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
        huge = np.abs(column) > LARGEST
        if huge.any() and name != "time":
            raise UserError(
                f"{table.path}: {name} is {column[huge][0]:g} at {table.rows(huge)}; nothing was "
                f"measured that is beyond {LARGEST:g}: leave such samples out"
            )
    late = np.concatenate([[False], np.diff(time) <= 0])
    if late.any():
        raise UserError(
            f"{table.path}: time does not increase at {table.rows(late)}; "
            "sort the samples, leave double ones out, and give each recording its own file"
        )


def _read_csv(path: Path, wanted: Collection[str] | None) -> dict[str, np.ndarray]:
    try:
        return _columns_of_text(path, wanted)
    except UnicodeError as error:
        raise UserError(
            f"{path}: cannot be read as CSV: not UTF-8 text; save it as UTF-8, and unpack it "
            "first if it is compressed"
        ) from error


def _columns_of_text(path: Path, wanted: Collection[str] | None) -> dict[str, np.ndarray]:
    separator = ","
    with path.open(newline="", encoding="utf-8-sig") as file:
        first = file.readline()
    if "\0" in first:
        raise UnicodeError("zero bytes, as of UTF-16")
    if wanted is not None:
        separator = max(SEPARATORS, key=first.count)
    header = [name.strip() for name in next(csv.reader([first], delimiter=separator), [])]
    if len(header) == 1 and (";" in header[0] or "\t" in header[0]):
        mark = "';'" if ";" in header[0] else "tabs"
        raise UserError(
            f"{path}: columns are separated by {mark}; expected commas, or a map file: "
            "--map MAP.toml, and garat convert, read these too"
        )
    if all(_is_number(name) for name in header):
        holds = "holds numbers" if header else "is empty"
        raise UserError(
            f"{path}: line 1 {holds}; expected the columns' names, such as time,qpos.JOINT"
        )
    twice = [name for name in header if header.count(name) > 1]
    if twice:
        raise UserError(f"{path}: column {twice[0]!r} is there {header.count(twice[0])} times")
    frame = _rows_below(path, header, separator)
    filled = np.flatnonzero(frame.notna().any(axis=1))
    return _numbers(path, _only(path, frame.iloc[: filled[-1] + 1 if len(filled) else 0], wanted))


def _rows_below(path: Path, header: list[str], separator: str) -> pd.DataFrame:
    """Read what is below line 1 of a CSV file; a separator may end each row.

    Raises:
        UserError: The rows have more fields than line 1, so none is known to be its column's.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error", pd.errors.ParserWarning)
        try:
            return pd.read_csv(
                path,
                header=None,
                names=header,
                index_col=False,
                skiprows=1,
                skip_blank_lines=False,
                encoding="utf-8-sig",
                on_bad_lines="error",
                low_memory=False,
                sep=separator,
            )
        except pd.errors.ParserWarning as error:
            raise UserError(
                f"{path}: rows have more fields than line 1 names ({len(header)}); expected as "
                "many: name each column, or leave row names out (in R: row.names = FALSE)"
            ) from error


def _read_parquet(path: Path, wanted: Collection[str] | None) -> dict[str, np.ndarray]:
    """Read columns by name; an index of the name that lacks is one of them."""
    frame = pd.read_parquet(path)
    frame.columns = frame.columns.map(str)
    lacking = {"time", *(wanted or ())}.difference(frame.columns)
    frame = frame.reset_index([name for name in frame.index.names if name in lacking])
    return _numbers(path, _only(path, frame, wanted))


def _only(path: Path, frame: pd.DataFrame, wanted: Collection[str] | None) -> pd.DataFrame:
    """Leave out columns that nobody wants."""
    if wanted is None:
        return frame
    check_wanted(path, wanted, list(map(str, frame.columns)))
    return frame.drop(columns=[name for name in frame.columns if name not in wanted])


def check_wanted(
    path: Path, wanted: Collection[str], there: Collection[str], what: str = "column"
) -> None:
    """Refuse a file that lacks a column, or what else it holds, that a map file asks for.

    Raises:
        UserError: It does; the message has the nearest names.
    """
    for name in wanted:
        if name not in there:
            raise UserError(f"{path}: {unknown_name(what, name, there)}")


def _read_npz(path: Path, wanted: Collection[str] | None) -> dict[str, np.ndarray]:
    if not zipfile.is_zipfile(path):
        raise UserError(f"{path}: not an NPZ archive; write it with numpy.savez")
    with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
        if wanted is not None:
            return columns_of_arrays(path, wanted, archive)
        columns = {name: _numbers_of(path, archive, name) for name in archive.files}
    for name, column in columns.items():
        if column.ndim != 1:
            raise UserError(
                f"{path}: array {name!r} has shape {column.shape}; expected one number a sample, "
                f"or a map file that names one of its columns {name}[0]"
            )
    return columns


def columns_of_arrays(
    path: Path, wanted: Collection[str], arrays: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Return columns of arrays of any shape, each named `ARRAY` or `ARRAY[COLUMN]`.

    Args:
        path: The file that the arrays are in.
        wanted: The columns.
        arrays: Its arrays by name.

    Raises:
        UserError: An array is not there, has no such column, or holds anything but numbers.
    """
    places = {source: _place(source, arrays) for source in wanted}
    check_wanted(path, [name for name, _ in places.values()], arrays, "array")
    return {
        source: _one_column(path, _numbers_of(path, arrays, name), source, column)
        for source, (name, column) in places.items()
    }


def _place(source: str, there: Collection[str]) -> tuple[str, str | None]:
    """Split `NAME[COLUMN]`; anything else is a name, and what an array is named."""
    match = _ARRAY.fullmatch(source)
    return (match["name"], match["column"]) if match and source not in there else (source, None)


def _one_column(path: Path, array: np.ndarray, source: str, column: str | None) -> np.ndarray:
    array = np.atleast_1d(np.squeeze(array))
    if array.ndim > 2:
        raise UserError(
            f"{path}: {source} is of an array of shape {array.shape}; expected one or two "
            "dimensions, samples first"
        )
    if array.ndim == 1:
        if column is not None:
            raise UserError(
                f"{path}: {source}: the array has one column only; leave [{column}] out"
            )
        return array
    if column is None:
        raise UserError(
            f"{path}: {source} has shape {array.shape}; name one column, such as {source}[0]"
        )
    array = array if array.shape[0] >= array.shape[1] else array.T  # samples come first
    if int(column) >= array.shape[1]:
        raise UserError(f"{path}: {source} is not there; it has {array.shape[1]} columns")
    return array[:, int(column)]


def read_mat(path: Path, squeeze: bool) -> dict[str, Any]:
    """Read the variables of a MAT file.

    Args:
        path: The file.
        squeeze: Leave out dimensions of length 1, so that one structure or cell is no array.

    Returns:
        Numbers and text as arrays, structures as `scipy.io.matlab.mat_struct`; cells and arrays of
        structures as arrays of objects.

    Raises:
        UserError: The file is damaged, or of MATLAB's version 7.3.
    """
    try:
        content = io.loadmat(path, squeeze_me=squeeze, struct_as_record=False)
    except NotImplementedError as error:
        raise UserError(f"{path}: saved by MATLAB with -v7.3; save it again with -v7") from error
    except Exception as error:  # what scipy raises on damaged files is not documented
        raise damaged(path, "MAT", error) from error
    return {name: value for name, value in content.items() if not name.startswith("__")}


def _numbers_of(path: Path, arrays: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    """Return an array of a file; what an NPZ archive has pickled stays unread.

    Raises:
        UserError: It holds something else than plain numbers.
    """
    try:
        values = arrays[name]
    except ValueError as error:
        raise UserError(
            f"{path}: array {name!r} holds pickled Python objects, which are never loaded; "
            "save it as plain numbers"
        ) from error
    if values.dtype.kind not in "fiub":
        raise UserError(f"{path}: array {name!r} is of type {values.dtype}; expected numbers")
    return values.astype(float)


_READERS = {".csv": _read_csv, ".parquet": _read_parquet, ".npz": _read_npz}


def _numbers(path: Path, frame: pd.DataFrame) -> dict[str, np.ndarray]:
    """Return a frame's columns as numbers.

    Raises:
        UserError: A field holds something else; the message says where.
    """
    columns = {}
    for name in map(str, frame.columns):
        values = frame[name]
        if not values.notna().to_numpy().any():
            columns[name] = np.full(len(values), np.nan)
            continue
        if pd.api.types.is_numeric_dtype(values) and not pd.api.types.is_bool_dtype(values):
            columns[name] = np.asarray(values.astype("float64"))
            continue
        numbers = np.asarray(pd.to_numeric(values.astype(str), errors="coerce"), float)
        bad = np.isnan(numbers) & values.notna().to_numpy()
        if not bad.any():
            bad = values.notna().to_numpy()
        where = Table(path, {name: numbers}).rows(bad)
        first = str(values.iloc[int(np.flatnonzero(bad)[0])])
        point = " with a decimal point, not a comma" if _DECIMAL_COMMA.fullmatch(first) else ""
        raise UserError(f"{path}: {name} holds {first!r} at {where}; expected numbers{point}")
    return columns


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
