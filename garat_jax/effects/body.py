"""Effects at a body: a payload that the model does not know."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco
from flax import struct

from garat_jax.effects.base import Effect, ModelView, element_id, parameter

SMALLEST_MASS = 1e-9
"""Mass [kg] and inertia [kg m²] of the payload's body when the model is compiled."""


@struct.dataclass
class PayloadMass(Effect):
    """A point mass fixed to a body: a tool, a battery, a cable.

    It is a body of its own, welded to the target, so that both engines compose the inertia. Shows
    as gravity torque and inertia that are wrong together. Typical: up to the rated payload.
    """

    kind: ClassVar[str] = "payload_mass"
    elements: ClassVar[tuple[str, ...]] = ("body",)
    law: ClassVar[str] = "point mass m at (x, y, z) in the body's frame"
    identified_by: ClassVar[str] = "motion against gravity in several poses"

    mass: jax.Array = parameter(
        0.0,
        unit="kg",
        low=0.0,
        high=50.0,
        scale=1e-2,
        source="Payloads of industrial arms and quadrupeds",
    )
    x: jax.Array = parameter(
        0.0, unit="m", low=-1.0, high=1.0, scale=0.01, source="Within reach of the body"
    )
    y: jax.Array = parameter(
        0.0, unit="m", low=-1.0, high=1.0, scale=0.01, source="Within reach of the body"
    )
    z: jax.Array = parameter(
        0.0, unit="m", low=-1.0, high=1.0, scale=0.01, source="Within reach of the body"
    )

    @property
    def payload(self) -> str:
        """The name of the payload's own body."""
        return f"{self.name}_payload"

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Weld a body of negligible mass to the target."""
        spec.body(self.name).add_body(
            name=self.payload,
            ipos=[0.0, 0.0, 0.0],
            explicitinertial=True,
            mass=SMALLEST_MASS,
            inertia=[SMALLEST_MASS] * 3,
        )

    def fields(self, model: ModelView) -> dict[str, jax.Array]:
        """Give the payload's body its mass and place."""
        index = element_id(model.host, "body", self.payload)
        place = jnp.stack([jnp.asarray(v) for v in (self.x, self.y, self.z)])
        return {
            "body_mass": model["body_mass"].at[index].set(self.mass),
            "body_pos": model["body_pos"].at[index].set(place),
        }
