"""Friction at a joint: laws of speed, direction and load.

Dry friction is MuJoCo's constraint row (frictionloss), which holds at rest, takes energy away and
is stable at any timestep. Where a law depends on the motion, the row has another size in each
substep. With MuJoCo's default softness (solreffriction) a row changes sign some 10 ms before the
speed does, so where the smaller of two frictions is fitted to a sharp one it may be a tenth off.
"""

import abc
from collections.abc import Mapping
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco
from flax import struct

from garat_jax.effects.at_joint import (
    actuator_torque,
    at_dof,
    drag,
    is_driven,
    small_torque,
)
from garat_jax.effects.base import Effect, ModelView, parameter
from garat_jax.effects.elements import element_id

SMALLEST_FRICTION = 1e-9
"""Friction loss [N m] that makes MuJoCo reserve a constraint row without being felt."""
PEAK = 1.5
"""Friction at rest, relative to that in motion, at which a peak is tried."""


def reserve_row(spec: mujoco.MjSpec, joint: str) -> None:
    """Make the compiler reserve a joint's friction constraint."""
    element = spec.joint(joint)
    element.frictionloss = max(element.frictionloss, SMALLEST_FRICTION)


def _more_friction(model: ModelView, joint: str, torque: jax.Array) -> dict[str, jax.Array]:
    """Return the friction losses with more [N m] at one joint."""
    return {"dof_frictionloss": model["dof_frictionloss"].at[_dof(model.host, joint)].add(torque)}


def _dof(host: mujoco.MjModel, joint: str) -> int:
    return int(host.jnt_dofadr[element_id(host, "joint", joint)])


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

    def export(self, spec: mujoco.MjSpec) -> str:
        """Add to the joint's damping."""
        spec.joint(self.name).damping[0] += float(self.coefficient)
        return ""


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
        reserve_row(spec, self.name)

    def fields(self, model: ModelView) -> dict[str, jax.Array]:
        """Add to the joint's native friction loss."""
        return _more_friction(model, self.name, self.torque)

    def export(self, spec: mujoco.MjSpec) -> str:
        """Add to the joint's friction loss."""
        spec.joint(self.name).frictionloss += float(self.torque)
        return ""


@struct.dataclass
class VaryingFriction(Effect):
    """Dry friction whose size follows the motion: a row of that size in each substep."""

    elements: ClassVar[tuple[str, ...]] = ("joint",)
    reads_state: ClassVar[bool] = True
    tunes: ClassVar[bool] = True

    @abc.abstractmethod
    def friction(self, model: ModelView, state, ctrl: jax.Array) -> jax.Array:
        """Return the dry friction now [N m], []."""

    def steady(self) -> jax.Array:
        """Return the part of the dry friction [N m] that does not change much, []."""
        return jnp.zeros(())

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Make the compiler reserve the friction constraint's row."""
        reserve_row(spec, self.name)

    def tune(self, model: ModelView, state, ctrl: jax.Array) -> dict[str, jax.Array]:
        """Add the dry friction of this moment to the joint's friction loss."""
        return _more_friction(model, self.name, self.friction(model, state, ctrl))

    def along_path(self) -> Effect:
        """Return a row of the steady part, and a force for the rest."""
        return _FrictionAlongPath(self.target, self)


@struct.dataclass
class _FrictionAlongPath(Effect):
    """A varying friction where the path is given, so that a force against it cannot overshoot."""

    kind: ClassVar[str] = "friction_along_path"
    acts: ClassVar[bool] = True
    reads_state: ClassVar[bool] = True

    varying: VaryingFriction

    def fields(self, model: ModelView) -> dict[str, jax.Array]:
        """Add the steady part to what the law itself replaces."""
        native = self.varying.fields(model)
        model = model.replace(native)
        return native | _more_friction(model, self.name, self.varying.steady())

    def apply(self, model: ModelView, state, ctrl: jax.Array, memory):
        """Add the rest against the motion to what the law itself does."""
        joint, dof = element_id(model.host, "joint", self.name), _dof(model.host, self.name)
        more = self.varying.friction(model, state, ctrl) - self.varying.steady()
        ctrl, force, memory = self.varying.apply(model, state, ctrl, memory)
        against = at_dof(model.host, joint, -more * jnp.sign(state.qvel[dof]), ctrl.dtype)
        return ctrl, against if force is None else force + against, memory


@struct.dataclass
class AsymmetricFriction(VaryingFriction):
    """Dry and viscous friction that differ between the directions of motion.

    τ = −(τ₊ + c₊·q̇) for q̇ > 0 and τ₋ − c₋·q̇ for q̇ < 0; at rest anything between −τ₊ and τ₋. The
    smaller damping is native; what the larger has more is taken semi-implicitly. Shows as torque
    against speed that is not odd, which a constant torque imitates at one speed. Typical: 10 to
    30 % between the directions of worm and harmonic drives and preloaded gears (Armstrong-Hélouvry,
    Dupont and Canudas de Wit 1994).
    """

    kind: ClassVar[str] = "asymmetric_friction"
    refines: ClassVar[tuple[str, ...]] = ("coulomb_friction", "viscous_damping")
    independent: ClassVar[bool] = True
    law: ClassVar[str] = "τ = −(τ₊ + c₊·q̇) for q̇ > 0, τ₋ − c₋·q̇ for q̇ < 0"
    identified_by: ClassVar[str] = "constant-speed runs in both directions, and rests between them"
    acts: ClassVar[bool] = True

    coulomb_positive: jax.Array = parameter(
        0.0, unit="N m", low=0.0, high=50.0, scale=1e-3, source="As coulomb_friction"
    )
    coulomb_negative: jax.Array = parameter(
        0.0, unit="N m", low=0.0, high=50.0, scale=1e-3, source="As coulomb_friction"
    )
    viscous_positive: jax.Array = parameter(
        0.0,
        unit="N m s/rad",
        low=0.0,
        high=100.0,
        scale=1e-3,
        source="As viscous_damping",
    )
    viscous_negative: jax.Array = parameter(
        0.0,
        unit="N m s/rad",
        low=0.0,
        high=100.0,
        scale=1e-3,
        source="As viscous_damping",
    )

    @classmethod
    def refined_from(cls, simpler: Effect) -> Mapping[str, float]:
        """Begin with the same friction in both directions, dry or viscous as it is."""
        (first,) = simpler.parameters()
        size = float(getattr(simpler, first.name))
        part = "coulomb" if simpler.kind == "coulomb_friction" else "viscous"
        return {f"{part}_positive": size, f"{part}_negative": size}

    def steady(self) -> jax.Array:
        """Return the mean of both directions."""
        return 0.5 * (self.coulomb_positive + self.coulomb_negative)

    def friction(self, model: ModelView, state, ctrl: jax.Array) -> jax.Array:
        """Return that of the direction of motion."""
        del ctrl
        positive = state.qvel[_dof(model.host, self.name)] > 0
        return jnp.where(positive, self.coulomb_positive, self.coulomb_negative)

    def fields(self, model: ModelView) -> dict[str, jax.Array]:
        """Add the smaller damping of both directions."""
        viscous = jnp.minimum(self.viscous_positive, self.viscous_negative)
        dof = _dof(model.host, self.name)
        return {"dof_damping": model["dof_damping"].at[dof].add(viscous)}

    def apply(self, model: ModelView, state, ctrl: jax.Array, memory):
        """Take what the larger damping has more."""
        joint = element_id(model.host, "joint", self.name)
        dof = _dof(model.host, self.name)
        speed = state.qvel[dof]
        there = jnp.where(speed > 0, self.viscous_positive, self.viscous_negative)
        more = there - jnp.minimum(self.viscous_positive, self.viscous_negative)
        torque = -drag(model, dof, speed, more)
        return ctrl, at_dof(model.host, joint, torque, ctrl.dtype), memory

    def export(self, spec: mujoco.MjSpec) -> str:
        """Write the mean of both directions."""
        joint = spec.joint(self.name)
        dry = float(self.coulomb_positive) + float(self.coulomb_negative)
        viscous = float(self.viscous_positive) + float(self.viscous_negative)
        joint.frictionloss += 0.5 * dry
        joint.damping[0] += 0.5 * viscous
        return f"MJCF has one friction for both directions; {self.target} has their mean"


@struct.dataclass
class StribeckFriction(VaryingFriction):
    """Dry friction that is larger at rest than in motion.

    |τ| = τ_c + (τ_s − τ_c)·exp(−(q̇/v_s)²), against the motion; `static` below `coulomb` counts as
    equal to it. Shows as stick-slip in slow motion and a jump at breakaway. Typical: τ_s = 1.2 to
    2 τ_c and v_s = 0.01 to 0.1 rad/s (Armstrong-Hélouvry, Dupont and Canudas de Wit 1994).
    """

    kind: ClassVar[str] = "stribeck_friction"
    refines: ClassVar[tuple[str, ...]] = ("coulomb_friction",)
    law: ClassVar[str] = "|τ| = τ_c + (τ_s − τ_c)·exp(−(q̇/v_s)²), against the motion"
    identified_by: ClassVar[str] = "constant-speed runs from below v_s up; slow ramps from rest"

    coulomb: jax.Array = parameter(
        0.0, unit="N m", low=0.0, high=50.0, scale=1e-3, source="As coulomb_friction"
    )
    static: jax.Array = parameter(
        0.0,
        unit="N m",
        low=0.0,
        high=100.0,
        scale=2e-3,
        source="Twice coulomb_friction (Armstrong-Hélouvry et al. 1994: ratios of 1 to 2)",
    )
    velocity: jax.Array = parameter(
        0.05,
        unit="rad/s",
        low=1e-3,
        high=10.0,
        scale=0.01,
        source="Armstrong-Hélouvry et al. 1994, from boundary to full fluid lubrication, with room",
    )

    @classmethod
    def starts(cls, host: mujoco.MjModel, target: str) -> tuple[Mapping[str, float], ...]:
        """Try a peak at several speeds: it is felt only below them."""
        size = small_torque(host, target.partition("/")[2], cls.parameters()[0].scale)
        return tuple(
            {"coulomb": size, "static": 2.0 * size, "velocity": speed} for speed in (0.02, 0.1, 0.5)
        )

    @classmethod
    def beside(cls, start: Mapping[str, float], given: Mapping[str, float]) -> Mapping[str, float]:
        """Keep the peak above a friction in motion that is given: below, it is not felt."""
        return {**start, "static": max(start["static"], PEAK * given.get("coulomb", 0.0)), **given}

    @classmethod
    def refined_from(cls, simpler: Effect) -> Mapping[str, float]:
        """Begin with a peak of half the friction in motion."""
        size = float(getattr(simpler, simpler.parameters()[0].name))
        return {"coulomb": size, "static": PEAK * size, "velocity": 0.1}

    def steady(self) -> jax.Array:
        """Return the Coulomb friction."""
        return jnp.asarray(self.coulomb)

    def friction(self, model: ModelView, state, ctrl: jax.Array) -> jax.Array:
        """Return the friction at the present speed."""
        del ctrl
        share = jnp.exp(-((state.qvel[_dof(model.host, self.name)] / self.velocity) ** 2))
        return self.coulomb + jnp.maximum(jnp.asarray(self.static) - self.coulomb, 0.0) * share

    def export(self, spec: mujoco.MjSpec) -> str:
        """Write the friction in motion."""
        spec.joint(self.name).frictionloss += float(self.coulomb)
        return f"MJCF has no peak of friction at rest; {self.target} has its Coulomb friction"


@struct.dataclass
class LoadFriction(VaryingFriction):
    """Dry friction in proportion to the torque that the joint's actuators transmit.

    |τ| ≤ μ·|τ_a|, against the motion, with τ_a the actuators' torque at the joint as the model has
    it. A gear gives (1 − μ) of the torque when it drives and (1 + μ) when it is driven back.
    Commands are seen as they reach the motor. Shows as friction that grows with load, at every
    speed. Typical: 1 minus a gear's efficiency: 0.02 for spur gears, 0.1 to 0.3 for harmonic
    drives, above 0.5 for worm gears; Duclusaud et al. 2024 (arXiv 2410.08650) have the law among
    their friction models of servos.
    """

    kind: ClassVar[str] = "load_friction"
    needs: ClassVar[str] = "a joint whose actuators are motors or servos without dynamics"
    law: ClassVar[str] = "|τ| ≤ μ·|τ_a(u, q, q̇)|, against the motion"
    identified_by: ClassVar[str] = "lifting and lowering the same load at several weights"

    ratio: jax.Array = parameter(
        0.0,
        unit="1",
        low=0.0,
        high=2.0,
        scale=0.02,
        source="At 1 a gear is self-locking; worm gears may exceed it",
    )

    @classmethod
    def fits(cls, host: mujoco.MjModel, element: str, name: str) -> bool:
        """Say whether the joint has actuators, of kinds whose torque is known."""
        return super().fits(host, element, name) and is_driven(host, name)

    def friction(self, model: ModelView, state, ctrl: jax.Array) -> jax.Array:
        """Return the friction under the present torque."""
        host = model.host
        joint = element_id(host, "joint", self.name)
        angle, speed = state.qpos[host.jnt_qposadr[joint]], state.qvel[_dof(host, self.name)]
        return self.ratio * jnp.abs(actuator_torque(model, joint, angle, speed, ctrl))


@struct.dataclass
class QuadraticDrag(Effect):
    """Torque against the motion with the square of the speed: a paddle, a fan, churned oil.

    τ = −c·|q̇|·q̇. It is taken semi-implicitly, −c·|q̇|·q̇/(1 + h·c·|q̇|/I) with the inertia I that is
    felt at the joint, which cannot overshoot. Shows as a decay that is fast at large and slow at
    small amplitudes. Typical: 1e-4 to 0.1 N m s²/rad² for a plate of some cm² to dm² at 0.5 m.
    """

    kind: ClassVar[str] = "quadratic_drag"
    elements: ClassVar[tuple[str, ...]] = ("joint",)
    law: ClassVar[str] = "τ = −c·|q̇|·q̇"
    identified_by: ClassVar[str] = "free decay and constant-speed runs at two speeds or more"
    acts: ClassVar[bool] = True
    reads_state: ClassVar[bool] = True

    coefficient: jax.Array = parameter(
        0.0,
        unit="N m s²/rad²",
        low=0.0,
        high=10.0,
        scale=1e-3,
        source="½·ρ·c_w·A·r³: air and a plate of 1 m² at 2 m give about 10",
    )

    def apply(self, model: ModelView, state, ctrl: jax.Array, memory):
        """Add the drag at the present speed."""
        joint, dof = element_id(model.host, "joint", self.name), _dof(model.host, self.name)
        speed = state.qvel[dof]
        torque = -drag(model, dof, speed, self.coefficient * jnp.abs(speed))
        return ctrl, at_dof(model.host, joint, torque, ctrl.dtype), memory

    def export(self, spec: mujoco.MjSpec) -> str:
        """Write it as the second coefficient of the joint's polynomial damping."""
        spec.joint(self.name).damping[1] += float(self.coefficient)
        return "said by polynomial damping, which C MuJoCo steps and MJX does not"
