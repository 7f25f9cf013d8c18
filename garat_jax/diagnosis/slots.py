"""The parameters of candidate effects, in the order of `theta`."""

from collections.abc import Sequence
from typing import NamedTuple

from garat_jax.effects import Parameter


class Slot(NamedTuple):
    """One parameter of one candidate effect.

    Attributes:
        effect: Index among the candidate effects.
        parameter: Its declaration.
        base: The value to begin with: "no effect" here, or what the effect has already.
    """

    effect: int
    parameter: Parameter
    base: float


def columns_of(slots: Sequence[Slot], effect: int) -> dict[str, int]:
    """Return where one candidate's parameters stand in `theta`, by their names."""
    return {slot.parameter.name: j for j, slot in enumerate(slots) if slot.effect == effect}
