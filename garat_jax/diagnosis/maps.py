"""Map files: which column of a foreign log becomes which column of a recording, and in what unit.

A map (TOML, format "garat-map/1") has a table `[column]`: `"qpos.elbow" = { from = "angle",
unit = "deg", sign = -1, offset = 90 }`. The value is `(sign · scale · raw + offset) · unit`.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from garat_jax.diagnosis.units import UNITS, unit_of
from garat_jax.errors import UserError, unknown_name
from garat_jax.files import read_toml

FORMAT = "garat-map/1"
KEYS = ("format", "column", "clock")
COLUMN_KEYS = ("from", "unit", "sign", "scale", "offset")
CLOCKS = ("header", "log")
KINDS = ("time", "qpos", "qvel", "ctrl", "torque")


@dataclasses.dataclass(frozen=True)
class Column:
    """Where a column comes from, and how it turns into SI units.

    Attributes:
        source: Its name in the log.
        unit: Its unit there, a name in `UNITS`; None if it is in SI units.
        sign: 1, or -1 where it counts the other way.
        scale: Units a count; 1 where the log is in units.
        offset: Added after sign and scale, in `unit`.
    """

    source: str
    unit: str | None = None
    sign: float = 1.0
    scale: float = 1.0
    offset: float = 0.0

    def to_si(self, raw: np.ndarray) -> np.ndarray:
        """Turn raw values into SI units."""
        factor = UNITS[self.unit].factor if self.unit else 1.0
        return (self.sign * self.scale * raw + self.offset) * factor


@dataclasses.dataclass(frozen=True)
class ColumnMap:
    """A map file.

    Attributes:
        path: The file.
        columns: By their names in a recording.
        clock: Of a bag: `header` for the messages' own stamps, `log` for when they were recorded.
    """

    path: Path
    columns: Mapping[str, Column]
    clock: str = "header"

    def check(self, expected: Mapping[str, str]) -> None:
        """Check the units against those that a model's columns have.

        Args:
            expected: SI unit by column.

        Raises:
            UserError: A column cannot have its unit.
        """
        for name, column in self.columns.items():
            if column.unit and name in expected:
                with_path(self.path, unit_of, name, column.unit, expected[name])

    @property
    def sources(self) -> list[str]:
        """What is wanted of a log."""
        return [column.source for column in self.columns.values()]

    def apply(self, raw: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Rename the columns of a log and turn them into SI units."""
        return {name: c.to_si(np.asarray(raw[c.source])) for name, c in self.columns.items()}


def read_map(path: str | Path) -> ColumnMap:
    """Read a map file.

    Raises:
        UserError: It cannot be read, or says something that cannot be.
    """
    path = Path(path)
    content = read_toml(path, FORMAT, KEYS)
    clock = content.get("clock", CLOCKS[0])
    if clock not in CLOCKS:
        raise UserError(f"{path}: clock is {clock!r}; expected {' or '.join(CLOCKS)}")
    tables = content.get("column")
    if not isinstance(tables, dict) or not tables:
        raise UserError(f'{path}: no columns; write [column] and then "qpos.JOINT" = "NAME"')
    columns = {name: with_path(path, _column, name, table) for name, table in tables.items()}
    return ColumnMap(path, columns, clock)


def with_path(path: Path, function, *arguments):
    """Call a function and put a file's name before what it refuses."""
    try:
        return function(*arguments)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error


def _column(name: str, table: Any) -> Column:
    if name.partition(".")[0] not in KINDS or (name != "time" and not name.partition(".")[2]):
        raise UserError(
            f"[column] {name!r}: expected time, qpos.JOINT, qvel.JOINT, ctrl.ACTUATOR or "
            "torque.JOINT, in quotes"
        )
    if isinstance(table, str):
        return Column(table)
    if not isinstance(table, dict):
        raise UserError(
            f'[column] {name}: expected "NAME" or {{ from = "NAME", unit = "deg" }}; a name with a '
            "dot goes in quotes"
        )
    for key in table:
        if key not in COLUMN_KEYS:
            raise unknown_name(f"key of [column] {name}", key, COLUMN_KEYS)
    if not isinstance(table.get("from"), str):
        raise UserError(f'[column] {name} lacks from = "NAME"')
    numbers = {key: table[key] for key in ("sign", "scale", "offset") if key in table}
    for key, value in numbers.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise UserError(f"[column] {name} {key} = {value!r}; expected a finite number")
    if numbers.get("sign", 1) not in (1, -1):
        raise UserError(f"[column] {name} sign = {numbers['sign']}; expected 1 or -1")
    if numbers.get("scale", 1) == 0:
        raise UserError(f"[column] {name} scale = 0; expected another number")
    unit = str(table["unit"]) if "unit" in table else None
    if unit is not None:
        unit_of(name, unit)
    return Column(table["from"], unit, **{key: float(value) for key, value in numbers.items()})
