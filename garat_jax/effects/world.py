"""Effects of the world: gravity."""

from typing import ClassVar

import jax
from flax import struct

from garat_jax.effects.base import Effect, ModelView, parameter


@struct.dataclass
class GravityScale(Effect):
    """Gravity is another than the model's, in proportion.

    Shows as every load being too heavy or too light at once. Typical: buoyancy, a wrong unit,
    a balancer on the whole robot.
    """

    kind: ClassVar[str] = "gravity_scale"
    elements: ClassVar[tuple[str, ...]] = ("world",)
    law: ClassVar[str] = "g ← s·g"
    identified_by: ClassVar[str] = "static poses with known torques"

    scale: jax.Array = parameter(
        1.0,
        unit="1",
        low=0.0,
        high=3.0,
        scale=0.02,
        source="From weightless to Jupiter's surface gravity (2.5 g)",
    )

    def fields(self, model: ModelView) -> dict[str, jax.Array]:
        """Scale the model's gravity vector."""
        return {"opt.gravity": model["opt.gravity"] * self.scale}
