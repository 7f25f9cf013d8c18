"""A motor apart from its joint, as what the effects between the two are made of.

The motor is a body of its own, which the engine does not know. Its inertia is the joint's
armature, which leaves the joint; its angle and speed relative to the joint are memory. The joint's
actuators act on it, and servos see its angle and speed; the actuators' torque at the joint is
taken away again. Friction, damping and limits stay at the joint, and so does the armature that
`rotor_inertia` adds; actuators with an armature or a damping of their own, which belong to the
motor, are refused.
"""

import abc
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from garat_jax.effects.at_joint import (
    Drive,
    at_dof,
    drive,
    drivers,
    feedback,
    has_limit,
    is_driven,
)
from garat_jax.effects.base import Effect, ModelView
from garat_jax.effects.elements import element_id
from garat_jax.effects.motor_body import add_gear, add_motor

NOWHERE = 1e9
"""Joint angle [rad] before the first substep: one that no joint has."""
STABLE = 4.0
"""Bound of h²·ω² + 2·h·c, below which steps of h of a spring and damper are stable."""
MARGIN = 0.5
"""Part of the longest stable timestep that is safe: a link may be lighter than at its reference."""
IMPLICIT = (
    int(mujoco.mjtIntegrator.mjINT_IMPLICIT),
    int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST),
)


class Motor(NamedTuple):
    """The motor relative to its joint.

    Attributes:
        deflection: Motor angle minus joint angle at the start of the substep, rad.
        slip: Motor speed minus joint speed at the start of the substep, rad/s.
        own: What the motor's speed after the substep owes to the motor alone, rad/s.
        apart: How much of the joint's speed after the substep it does not take on, 0 to 1.
        angle: Joint angle at the start of the substep, rad.
    """

    deflection: jax.Array
    slip: jax.Array
    own: jax.Array
    apart: jax.Array
    angle: jax.Array


class MotorSide(NamedTuple):
    """The motor and its joint at the start of a substep.

    Attributes:
        joint: The joint's index.
        inertia: Of the motor, at the joint, kg m².
        stiffened: The same, with what the servo's feedback adds within a substep, unless its
            force is at its limit.
        deflection: Motor angle minus joint angle, rad.
        slip: Motor speed minus joint speed, rad/s.
        speed: Of the joint, rad/s.
        torque: On the motor, its servo's pull at the present speed left out, N m.
    """

    joint: int
    inertia: float
    stiffened: jax.Array
    deflection: jax.Array
    slip: jax.Array
    speed: jax.Array
    torque: jax.Array


class _Place(NamedTuple):
    """Angle and speed of a joint, and its motor's deflection and slip."""

    angle: jax.Array
    speed: jax.Array
    deflection: jax.Array
    slip: jax.Array


def link_inertia(host: mujoco.MjModel, dof: int) -> float:
    """Return the inertia at a dof without the motor's, at the reference pose, kg m²."""
    motor = float(host.dof_armature[dof])
    return max(1.0 / float(host.dof_invweight0[dof]) - motor, 1e-3 * motor)


@struct.dataclass
class Transmission(Effect, abc.ABC):
    """A motor that is not rigidly at its joint; one such effect at a joint."""

    elements: ClassVar[tuple[str, ...]] = ("joint",)
    needs: ClassVar[str] = (
        "a joint with motors or servos without dynamics, armature or damping of their own, an "
        "armature above 0 of the joint (the motor's inertia), an integrator other than RK4, and "
        "no flag that disables damper"
    )
    acts: ClassVar[bool] = True
    reads_state: ClassVar[bool] = True
    tunes: ClassVar[bool] = True

    minds_limits: bool = struct.field(pytree_node=False, default=True, kw_only=True)
    """Whether servos at the limit of their force pull back no more; along a path they always do."""

    @classmethod
    def fits(cls, host: mujoco.MjModel, element: str, name: str) -> bool:
        """Say whether the joint has a motor with inertia, and an integrator that is implicit."""
        if not super().fits(host, element, name) or not is_driven(host, name):
            return False
        at = drivers(host, element_id(host, "joint", name))
        own = (host.actuator_armature[at], host.actuator_damping[at], host.actuator_dampingpoly[at])
        if any(np.any(values) for values in own):
            return False
        moving = host.dof_armature[host.joint(name).dofadr[0]] > 0
        damps = not host.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_DAMPER
        return bool(moving) and damps and host.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4

    def excludes(self, other: Effect) -> bool:
        """Say whether both are between one motor and its joint: each takes the motor off."""
        return isinstance(other, Transmission) and other.target == self.target

    @property
    @abc.abstractmethod
    def active(self) -> jax.Array:
        """Whether the motor is apart from its joint, []."""

    @abc.abstractmethod
    def couple(self, model: ModelView, side: MotorSide) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return the torque on the joint, and `own` and `apart` of the `Motor` after it."""

    def inertia(self, host: mujoco.MjModel) -> float:
        """Return the motor's inertia at the joint, kg m²."""
        return float(host.dof_armature[host.joint(self.name).dofadr[0]])

    def init(self, host: mujoco.MjModel) -> Motor:
        """Return a motor at rest relative to its joint."""
        del host
        nothing = jnp.zeros(())
        return Motor(nothing, nothing, nothing, nothing, jnp.full((), NOWHERE))

    def fields(self, model: ModelView) -> dict[str, jax.Array]:
        """Take the motor's inertia, and its servo's implicit damping, off the joint."""
        host = model.host
        dof = host.joint(self.name).dofadr[0]
        gone = jnp.where(self.active, self.inertia(host), 0.0)
        pull = feedback(model, element_id(host, "joint", self.name))
        damping = self._damping(host, pull, pull[1])
        return {
            "dof_armature": model["dof_armature"].at[dof].add(-gone),
            "dof_damping": model["dof_damping"].at[dof].add(damping),
        }

    def tune(self, model: ModelView, state, ctrl: jax.Array) -> dict[str, jax.Array]:
        """Let servos that are at the limit of their force damp no more."""
        host, joint = model.host, element_id(model.host, "joint", self.name)
        if not (self.minds_limits and has_limit(host, joint)):
            return {}
        place = self._place(host, state, state.memory)
        pull = feedback(model, joint)
        motor, native = self._drives(model, place, ctrl)
        change = self._damping(host, motor[1:], native.per_speed)
        change = change - self._damping(host, pull, pull[1])
        dof = host.jnt_dofadr[joint]
        return {"dof_damping": model["dof_damping"].at[dof].add(change)}

    def along_path(self) -> Effect:
        """Return the same with servos that pull back at their limits, too."""
        return self.replace(minds_limits=False)

    def implicit_damping(self, host: mujoco.MjModel, stiffened) -> jax.Array:
        """Return the damping [N m s/rad] at the joint that the engine takes implicitly, []."""
        del host, stiffened
        return jnp.zeros(())

    def apply(self, model: ModelView, state, ctrl: jax.Array, memory: Motor):
        """Turn the motor, and couple it to the joint."""
        host = model.host
        joint = element_id(host, "joint", self.name)
        place = self._place(host, state, memory)
        motor, native = self._drives(model, place, ctrl)
        speed, turning = place.speed, place.speed + place.slip
        side = MotorSide(
            joint=joint,
            inertia=self.inertia(host),
            stiffened=self._stiffened(host, motor[1:]),
            deflection=place.deflection,
            slip=place.slip,
            speed=speed,
            torque=motor.torque + motor.per_speed * turning,
        )
        torque, own, apart = self.couple(model, side)
        taken = native.torque
        if host.opt.integrator in IMPLICIT:
            taken = taken + native.per_speed * speed
        torque = jnp.where(self.active, torque - taken, 0.0)
        after = Motor(place.deflection, place.slip, own, apart, place.angle)
        kept = jax.tree.map(lambda new, old: new.astype(old.dtype), after, memory)
        return ctrl, at_dof(host, joint, torque, ctrl.dtype), kept

    def _place(self, host: mujoco.MjModel, state, memory: Motor) -> "_Place":
        """Return where motor and joint are."""
        joint = element_id(host, "joint", self.name)
        angle, speed = state.qpos[host.jnt_qposadr[joint]], state.qvel[host.jnt_dofadr[joint]]
        return _Place(angle, speed, *_finish(memory, angle, speed, host.opt.timestep))

    def _drives(self, model: ModelView, place: "_Place", ctrl: jax.Array) -> tuple[Drive, Drive]:
        """Return what the actuators do at the motor, and what the engine has them do at the joint.

        MJX takes their feedback implicitly at their limits, too.
        """
        joint = element_id(model.host, "joint", self.name)
        angle, speed = place.angle + place.deflection, place.speed + place.slip
        motor = drive(model, joint, angle, speed, ctrl)
        native = drive(model, joint, place.angle, place.speed, ctrl)
        pull = tuple(value.astype(ctrl.dtype) for value in feedback(model, joint))
        if not self.minds_limits:
            motor = Drive(motor.torque, *pull)
        if not self.minds_limits or model.engine == "mjx":
            native = Drive(native.torque, *pull)
        return motor, native

    def _stiffened(self, host: mujoco.MjModel, pull):
        """Return the motor's inertia and what feedback [2] adds in a substep, kg m², []."""
        step, (per_angle, per_speed) = host.opt.timestep, pull
        return self.inertia(host) + step * (per_speed + step * per_angle)

    def _damping(self, host: mujoco.MjModel, pull, native_per_speed) -> jax.Array:
        """Return what the joint's damping changes by, N m s/rad, []."""
        damping = self.implicit_damping(host, self._stiffened(host, pull))
        if host.opt.integrator in IMPLICIT:
            damping = damping - native_per_speed
        return jnp.where(self.active, damping, 0.0)

    @abc.abstractmethod
    def tie(self, tendon: mujoco.MjsTendon, timestep: float) -> str:
        """Let a tendon, whose length is motor less joint, act as the gear; say how in words."""

    @abc.abstractmethod
    def rates(self, host: mujoco.MjModel) -> tuple[float, float]:
        """Return how fast the exported gear turns motor against link back, 1/s², and damps, 1/s."""

    def export(self, spec: mujoco.MjSpec) -> str:
        """Make the motor a body of its own, beside the link, and the gear a tendon between them.

        The joint keeps its place, its friction, its limits and its sensors.
        """
        if not bool(self.active):
            return ""
        host = spec.copy().compile()
        motor = add_motor(spec, host, self.name, self.inertia(host))
        gear = add_gear(spec, self.name, motor)
        how = self.tie(gear, spec.option.timestep)
        said = (
            f"{self.kind} at {self.target} as a force; instead {motor} is a body with the motor's "
            f"inertia and actuators, and the tendon {gear.name} {how}"
        )
        model = ModelView(host, lambda name: jnp.asarray(getattr(host, name)))
        pull = feedback(model, element_id(host, "joint", self.name))
        per_angle, per_speed = (
            rate + float(servo) / self.inertia(host)
            for rate, servo in zip(self.rates(host), pull, strict=True)
        )
        limit = STABLE / (per_speed + np.sqrt(per_speed**2 + STABLE * per_angle) + 1e-12)
        if spec.option.timestep > (longest := MARGIN * limit):
            said += f"; MuJoCo steps it explicitly, which needs a timestep below {longest:.2g} s"
        return said


def _finish(motor: Motor, angle: jax.Array, speed: jax.Array, step: float):
    """Return deflection and slip after the last substep, whose joint speed is known by now.

    Where the joint was put elsewhere meanwhile, the motor is put there with it.
    """
    epsilon = float(jnp.finfo(jnp.asarray(angle).dtype).eps)
    moved = jnp.abs(angle - (motor.angle + step * speed))
    went_on = moved <= 16.0 * epsilon * (1.0 + jnp.abs(angle))
    slip = jnp.where(went_on, motor.own - motor.apart * speed, motor.slip)
    deflection = motor.deflection + jnp.where(went_on, step * slip, 0.0)
    return deflection, slip
