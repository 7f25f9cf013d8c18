"""Effects at a joint: friction, rotor inertia, constant torque."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco
from flax import struct

from garat_jax.effects.base import Effect, ModelView, element_id, parameter

SMALLEST_FRICTION = 1e-9
"""Friction loss [N m] that makes MuJoCo reserve a constraint row without being felt."""


@struct.dataclass
class ViscousDamping(Effect):
    """Torque against the motion, in proportion to the speed: tau = -coefficient * qvel.

    Shows as an oscillation whose amplitude decays exponentially. Typical: 1e-4 N m s/rad for a ball
    bearing, 0.01 to 1 for a geared robot joint (MuJoCo Menagerie's arms have 0.1 to 10).
    """

    kind: ClassVar[str] = "viscous_damping"
    elements: ClassVar[tuple[str, ...]] = ("joint",)
    law: ClassVar[str] = "τ = −c·q̇"
    identified_by: ClassVar[str] = "free decay at several amplitudes; constant-speed runs"

    coefficient: jax.Array = parameter(
        0.0,
        unit="N m s/rad",
        low=0.0,
        high=100.0,
        scale=1e-3,
        source="MuJoCo Menagerie: joint damping of published robots is at most 100",
    )

    def fields(self, model: ModelView) -> dict[str, jax.Array]:
        """Add to the joint's native damping."""
        dofs = model.dofs(self.name)
        return {"dof_damping": model["dof_damping"].at[dofs].add(self.coefficient)}


@struct.dataclass
class CoulombFriction(Effect):
    """Torque against the motion whatever the speed: |tau| <= torque.

    Shows as an oscillation whose amplitude decays by the same step each swing and that stops
    away from equilibrium. Typical: 1 to 10 % of a geared actuator's rated torque.
    """

    kind: ClassVar[str] = "coulomb_friction"
    elements: ClassVar[tuple[str, ...]] = ("joint",)
    law: ClassVar[str] = "|τ| ≤ τ_c, against the motion (MuJoCo's frictionloss)"
    identified_by: ClassVar[str] = "slow motion with reversals; the last swings of a free decay"

    torque: jax.Array = parameter(
        0.0,
        unit="N m",
        low=0.0,
        high=50.0,
        scale=1e-3,
        source="MuJoCo Menagerie: frictionloss of published robots is at most a few tens",
    )

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Make the compiler reserve the friction constraint's row."""
        joint = spec.joint(self.name)
        joint.frictionloss = max(joint.frictionloss, SMALLEST_FRICTION)

    def fields(self, model: ModelView) -> dict[str, jax.Array]:
        """Add to the joint's native friction loss."""
        dofs = model.dofs(self.name)
        return {"dof_frictionloss": model["dof_frictionloss"].at[dofs].add(self.torque)}


@struct.dataclass
class RotorInertia(Effect):
    """Inertia of the rotor as felt behind the gear: it adds to the joint's inertia.

    Shows as a response that is slower in both directions, in proportion to acceleration.
    Typical: gear ratio squared times 1e-6 to 1e-4 kg m².
    """

    kind: ClassVar[str] = "rotor_inertia"
    elements: ClassVar[tuple[str, ...]] = ("joint",)
    law: ClassVar[str] = "M_jj ← M_jj + I (MuJoCo's armature)"
    identified_by: ClassVar[str] = "fast reversals; chirps"

    inertia: jax.Array = parameter(
        0.0,
        unit="kg m²",
        low=0.0,
        high=10.0,
        scale=1e-3,
        source="MuJoCo Menagerie: armature of published robots is 0 to a few kg m²",
    )

    def fields(self, model: ModelView) -> dict[str, jax.Array]:
        """Add to the joint's native armature."""
        dofs = model.dofs(self.name)
        return {"dof_armature": model["dof_armature"].at[dofs].add(self.inertia)}


@struct.dataclass
class TorqueOffset(Effect):
    """A constant torque at a joint: a spring balancer, a cable, a motor driver's bias.

    Shows as an equilibrium that is shifted, the same for both directions of motion.
    """

    kind: ClassVar[str] = "torque_offset"
    elements: ClassVar[tuple[str, ...]] = ("joint",)
    law: ClassVar[str] = "τ = τ₀"
    identified_by: ClassVar[str] = "rest poses; the mean of slow motion in both directions"
    acts: ClassVar[bool] = True

    torque: jax.Array = parameter(
        0.0,
        unit="N m",
        low=-100.0,
        high=100.0,
        scale=1e-2,
        source="Within the rated torque of table-top and legged robots' joints",
    )

    def apply(self, model: ModelView, state, ctrl: jax.Array, memory):
        """Add the torque as a generalised force."""
        force = jnp.zeros(model.host.nv, ctrl.dtype)
        index = model.host.jnt_dofadr[element_id(model.host, "joint", self.name)]
        return ctrl, force.at[index].set(self.torque), memory
