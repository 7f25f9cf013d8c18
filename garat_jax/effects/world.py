"""Effects of the world: how strong gravity is, and where it points."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
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

    def export(self, spec: mujoco.MjSpec) -> str:
        """Scale the spec's gravity."""
        spec.option.gravity = spec.option.gravity * float(self.scale)
        return ""


@struct.dataclass
class GravityTilt(Effect):
    """The world is not level: gravity is turned by roll about x, then by pitch about y.

    Shows as rest poses and drifts that are shifted in one direction of the world, the more the
    heavier the link. One joint's offset is told from it by other joints and poses. Typical: 0.005
    to 0.05 rad for a base that was levelled by eye, more for a floor or a mount that slopes.
    """

    kind: ClassVar[str] = "gravity_tilt"
    elements: ClassVar[tuple[str, ...]] = ("world",)
    law: ClassVar[str] = "g ← R_y(pitch)·R_x(roll)·g"
    identified_by: ClassVar[str] = "rest poses all around; drift of what rolls freely"
    independent: ClassVar[bool] = True

    roll: jax.Array = parameter(
        0.0, unit="rad", low=-3.2, high=3.2, scale=0.01, source="Any mounting of the base"
    )
    pitch: jax.Array = parameter(
        0.0, unit="rad", low=-3.2, high=3.2, scale=0.01, source="Any mounting of the base"
    )

    def fields(self, model: ModelView) -> dict[str, jax.Array]:
        """Turn the model's gravity vector."""
        x, y, z = model["opt.gravity"]
        roll, pitch = jnp.asarray(self.roll), jnp.asarray(self.pitch)
        y, z = y * jnp.cos(roll) - z * jnp.sin(roll), y * jnp.sin(roll) + z * jnp.cos(roll)
        x, z = x * jnp.cos(pitch) + z * jnp.sin(pitch), z * jnp.cos(pitch) - x * jnp.sin(pitch)
        return {"opt.gravity": jnp.stack([x, y, z])}

    def export(self, spec: mujoco.MjSpec) -> str:
        """Turn the spec's gravity."""
        gravity = ModelView(spec.copy().compile(), lambda name: jnp.asarray(spec.option.gravity))
        spec.option.gravity = np.asarray(self.fields(gravity)["opt.gravity"], float)
        return ""
