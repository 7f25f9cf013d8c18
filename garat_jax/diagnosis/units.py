"""Units that a map file may name, as factors to SI units, and how a unit follows a number."""

import math
from typing import NamedTuple

from garat_jax.errors import UserError, choose


def after_number(unit: str) -> str:
    """Return a unit as it follows a number; nothing where it is none."""
    return f" {unit}" if unit not in ("", "1") else ""


class Unit(NamedTuple):
    """A unit: the SI unit that it turns into, and its size in that."""

    si: str
    factor: float


UNITS: dict[str, Unit] = {
    "1": Unit("1", 1.0),
    "%": Unit("1", 0.01),
    "s": Unit("s", 1.0),
    "ms": Unit("s", 1e-3),
    "us": Unit("s", 1e-6),
    "ns": Unit("s", 1e-9),
    "min": Unit("s", 60.0),
    "rad": Unit("rad", 1.0),
    "mrad": Unit("rad", 1e-3),
    "deg": Unit("rad", math.pi / 180),
    "turn": Unit("rad", 2 * math.pi),
    "rad/s": Unit("rad/s", 1.0),
    "deg/s": Unit("rad/s", math.pi / 180),
    "turn/s": Unit("rad/s", 2 * math.pi),
    "rpm": Unit("rad/s", 2 * math.pi / 60),
    "m": Unit("m", 1.0),
    "cm": Unit("m", 1e-2),
    "mm": Unit("m", 1e-3),
    "um": Unit("m", 1e-6),
    "in": Unit("m", 0.0254),
    "m/s": Unit("m/s", 1.0),
    "cm/s": Unit("m/s", 1e-2),
    "mm/s": Unit("m/s", 1e-3),
    "km/h": Unit("m/s", 1 / 3.6),
    "m/s²": Unit("m/s²", 1.0),
    "g": Unit("m/s²", 9.80665),  # standard gravity; a gram is no unit of any column
    "N": Unit("N", 1.0),
    "mN": Unit("N", 1e-3),
    "kN": Unit("N", 1e3),
    "kgf": Unit("N", 9.80665),
    "N m": Unit("N m", 1.0),
    "mN m": Unit("N m", 1e-3),
    "N cm": Unit("N m", 1e-2),
    "N mm": Unit("N m", 1e-3),
    "kgf cm": Unit("N m", 0.0980665),
    "V": Unit("V", 1.0),
    "mV": Unit("V", 1e-3),
    "A": Unit("A", 1.0),
    "mA": Unit("A", 1e-3),
}
"""By the name that a map file uses."""
ALLOWED: dict[str, tuple[str, ...]] = {
    "time": ("s",),
    "qpos": ("rad", "m", "1"),
    "qvel": ("rad/s", "m/s"),
    "torque": ("N m", "N"),
}
"""SI units that a kind of column may have; a command may have any."""


def unit_of(column: str, name: str, expected: str | None = None) -> Unit:
    """Return the unit of a column.

    Args:
        column: The column's name in a recording.
        name: The unit's name in the map file.
        expected: The SI unit that the model wants there, if it is known.

    Raises:
        UserError: There is no such unit, or the column cannot have it.
    """
    kind = column.partition(".")[0]
    allowed = (expected,) if expected is not None else ALLOWED.get(kind)
    fitting = {known: u for known, u in UNITS.items() if not allowed or u.si in allowed}
    if name in UNITS and name not in fitting:
        raise UserError(f"{column} cannot be in {name!r}; expected one of {', '.join(fitting)}")
    return choose(f"unit of {column}", name, fitting)
