"""Effects at a body: a payload, a centre of mass that is elsewhere, and the air's drag."""

from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from garat_jax.effects.base import Effect, ModelView, parameter
from garat_jax.effects.elements import element_id, element_names, free_name
from garat_jax.effects.kinematics import centre_of_mass_jacobian
from garat_jax.errors import UserError

SMALLEST_MASS = 1e-9
"""Mass [kg] and inertia [kg m²] of the payload's body when the model is compiled."""
PAYLOADS = (0.1, 0.5)
"""Payloads that are tried, relative to the mass that the body carries, its own included."""
BALANCED = 0.2
"""Distance of a centre of mass from a hinge's axis, relative to the body's radius of gyration,
below which a payload is tried beside it, too."""
ACROSS = 0.5
"""Cosine of the angle between a hinge and an axis of its body from which that axis is along it."""


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
    needs: ClassVar[str] = "a body that moves"

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
        """The name of the payload's own body, which no exported model has."""
        return f"payload of {self.name}"

    @classmethod
    def fits(cls, host: mujoco.MjModel, element: str, name: str) -> bool:
        """Say whether the body moves."""
        return bool(name) and moves(host, name)

    def check(self, host: mujoco.MjModel) -> None:
        """Check also that the body carries no other.

        Raises:
            UserError: As `Effect.check`, or there is a payload at the body already.
        """
        super().check(host)
        if self.payload in element_names(host, "body"):
            raise UserError(
                f"there is a payload_mass at {self.target} already; one point mass stands for all "
                "that the body carries: change that one"
            )

    @classmethod
    def at(cls, host: mujoco.MjModel, target: str) -> Mapping[str, float]:
        """Hang the payload at the body's centre of mass until its place is fitted."""
        place = (float(value) for value in host.body(target.partition("/")[2]).ipos)
        return {"mass": 0.0, **dict(zip("xyz", place, strict=True))}

    @classmethod
    def starts(cls, host: mujoco.MjModel, target: str) -> tuple[Mapping[str, float], ...]:
        """Try a light and a heavy payload: the response to a heavy one is no multiple.

        Of a body that turns about its centre of mass a payload there would not show.
        """
        body = host.body(target.partition("/")[2])
        mass, *axes = cls.parameters()
        carried = max(float(host.body_subtreemass[body.id]), SMALLEST_MASS)
        light, heavy = (min(share * carried, mass.high) for share in PAYLOADS)
        beside = [
            {mass.name: light, p.name: float(np.clip(body.ipos[i] + way, p.low, p.high))}
            for i, p in enumerate(axes)
            for way in _ways_off_axis(host, body.id, i)
        ]
        return ({mass.name: light}, {mass.name: heavy}, *beside)

    def unlock(self, spec: mujoco.MjSpec) -> None:
        """Keep the compiler from taking the centre of mass for the body's origin."""
        spec.body(self.name).simple = False

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Weld a body of negligible mass to the target, which the compiler may not fuse."""
        self._add_body(spec, self.payload, [0.0, 0.0, 0.0], SMALLEST_MASS).fuse = False

    def fields(self, model: ModelView) -> dict[str, jax.Array]:
        """Give the payload's body its mass and place, whatever bounds the compiler set."""
        index = element_id(model.host, "body", self.payload)
        return {
            "body_mass": model["body_mass"].at[index].set(self.mass),
            "body_inertia": model["body_inertia"].at[index].set(0.0),
            "body_pos": model["body_pos"].at[index].set(_vector(self)),
        }

    def export(self, spec: mujoco.MjSpec) -> str:
        """Add the payload as a body with an inertial of its own."""
        if float(self.mass) > 0:
            write_inertials(spec)
            name = free_name(f"{self.name}_payload", spec.body)
            self._add_body(spec, name, [float(v) for v in _vector(self)], float(self.mass))
        return ""

    def _add_body(self, spec: mujoco.MjSpec, name: str, place: list[float], mass: float) -> Any:
        return spec.body(self.name).add_body(
            name=name,
            pos=place,
            ipos=[0.0, 0.0, 0.0],
            explicitinertial=True,
            mass=mass,
            inertia=[SMALLEST_MASS] * 3,
        )


def _ways_off_axis(host: mujoco.MjModel, body: int, axis: int) -> tuple[float, ...]:
    """Return both ways [m] along an axis of a body from its centre of mass, off its hinge's axis.

    As far as the radius of gyration; none if the centre of mass is not on the hinge's axis, or the
    way is along it.
    """
    joint, mass = int(host.body_jntadr[body]), float(host.body_mass[body])
    if joint < 0 or host.jnt_type[joint] != mujoco.mjtJoint.mjJNT_HINGE or not mass:
        return ()
    reach = float(np.sqrt(host.body_inertia[body].max() / mass))
    hinge = host.jnt_axis[joint]
    lever = np.linalg.norm(np.cross(hinge, host.body_ipos[body] - host.jnt_pos[joint]))
    is_balanced, is_across = lever < BALANCED * reach, abs(hinge[axis]) < ACROSS
    return (reach, -reach) if is_balanced and is_across else ()


@struct.dataclass
class ComOffset(Effect):
    """A body's centre of mass is elsewhere in the body; its mass and inertia about it stay.

    Shows as gravity torque that is wrong with a shifted phase while fast motion is nearly right.
    Typical: millimetres to a few centimetres, from batteries, cables and hollow parts that CAD
    fills (domain randomisation of legged robots uses up to 5 cm).
    """

    kind: ClassVar[str] = "com_offset"
    elements: ClassVar[tuple[str, ...]] = ("body",)
    law: ClassVar[str] = "p_com ← p_com + (x, y, z) in the body's frame"
    identified_by: ClassVar[str] = "static poses all around; slow motion against gravity"
    needs: ClassVar[str] = "a body that moves and has mass"
    independent: ClassVar[bool] = True

    x: jax.Array = parameter(
        0.0, unit="m", low=-0.5, high=0.5, scale=5e-3, source="Within the link of a robot"
    )
    y: jax.Array = parameter(
        0.0, unit="m", low=-0.5, high=0.5, scale=5e-3, source="Within the link of a robot"
    )
    z: jax.Array = parameter(
        0.0, unit="m", low=-0.5, high=0.5, scale=5e-3, source="Within the link of a robot"
    )

    @classmethod
    def fits(cls, host: mujoco.MjModel, element: str, name: str) -> bool:
        """Say whether the body moves and has mass."""
        return bool(name) and moves(host, name) and host.body(name).mass[0] > 0

    def unlock(self, spec: mujoco.MjSpec) -> None:
        """Keep the compiler from taking the centre of mass for the body's origin."""
        spec.body(self.name).simple = False

    def fields(self, model: ModelView) -> dict[str, jax.Array]:
        """Move the body's inertial frame."""
        index = element_id(model.host, "body", self.name)
        return {"body_ipos": model["body_ipos"].at[index].add(_vector(self))}

    def export(self, spec: mujoco.MjSpec) -> str:
        """Write the body's inertial out, which the compiler may have made of geoms, and move it."""
        write_inertials(spec, self.name)
        body = spec.body(self.name)
        body.ipos = body.ipos + np.asarray(_vector(self), float)
        return ""


@struct.dataclass
class AirDrag(Effect):
    """Drag of the air at a body's centre of mass: F = -c * |v| * v, the air standing still.

    Shows as decay that is fast at large speeds and dies out with them, so that a swing never
    seems to stop. Identified by motion at two amplitudes. Typical: half of density (1.2 kg/m³)
    times drag coefficient (0.5 to 1.2) times area: 0.004 for a hand, 0.05 for a quadrotor.
    """

    kind: ClassVar[str] = "air_drag"
    elements: ClassVar[tuple[str, ...]] = ("body",)
    law: ClassVar[str] = "F = −c·|v|·v at the centre of mass"
    identified_by: ClassVar[str] = "free decay or constant-speed runs at two amplitudes"
    needs: ClassVar[str] = "a body that moves and has mass"
    acts: ClassVar[bool] = True
    reads_state: ClassVar[bool] = True

    coefficient: jax.Array = parameter(
        0.0,
        unit="N s²/m²",
        low=0.0,
        high=10.0,
        scale=5e-3,
        source="0.5 * 1.2 kg/m³ * C_d * A, with areas of up to 10 m²",
    )

    @classmethod
    def fits(cls, host: mujoco.MjModel, element: str, name: str) -> bool:
        """Say whether the body moves and has mass."""
        return ComOffset.fits(host, element, name)

    def apply(self, model: ModelView, state: Any, ctrl: jax.Array, memory: Any):
        """Map the force at the centre of mass onto the degrees of freedom."""
        index = element_id(model.host, "body", self.name)
        jacobian = centre_of_mass_jacobian(model, index, state.qpos)
        velocity = jacobian @ state.qvel
        squared = velocity @ velocity
        speed = jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1.0)), 0.0)
        return ctrl, jacobian.T @ (-self.coefficient * speed * velocity), memory


def moves(host: mujoco.MjModel, body: str) -> bool:
    """Say whether joints move a body, or what it is fixed to: not one that mocap leads."""
    return bool(host.body_dofnum[host.body(body).weldid[0]] > 0)


def write_inertials(spec: mujoco.MjSpec, name: str = "") -> None:
    """Make a body's compiled inertial explicit; every body's, where the compiler overrules masses.

    What overrules them is lifted: inertials from geoms, a total mass, least masses and inertias.
    """
    rules = spec.compiler
    if rules.fusestatic:
        spec.compile()  # fuses the spec's bodies, too
        rules.fusestatic = False
    copy = spec.copy()
    host = copy.compile()
    from_geoms = mujoco.mjtInertiaFromGeom
    is_overruled = rules.inertiafromgeom == from_geoms.mjINERTIAFROMGEOM_TRUE
    is_overruled |= max(rules.settotalmass, rules.boundmass, rules.boundinertia) > 0
    rules.inertiafromgeom = from_geoms.mjINERTIAFROMGEOM_AUTO
    rules.settotalmass, rules.boundmass, rules.boundinertia = -1.0, 0.0, 0.0
    for body, copied in zip(spec.bodies, copy.bodies, strict=True):
        compiled = host.body(copied.id)
        if compiled.mass[0] > 0 and (is_overruled or body.name == name):
            body.explicitinertial = True
            body.mass, body.ipos = compiled.mass[0], compiled.ipos
            body.iquat, body.inertia = compiled.iquat, compiled.inertia
            body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
            body.fullinertia = [float("nan")] * 6


def _vector(effect: PayloadMass | ComOffset) -> jax.Array:
    return jnp.stack([jnp.asarray(value) for value in (effect.x, effect.y, effect.z)])
