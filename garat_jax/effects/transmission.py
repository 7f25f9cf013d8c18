"""Effects between a motor and its joint: a gear that bends, a gear with play.

The motor is a body of its own, which the engine does not know. Its inertia is the joint's
armature, which leaves the joint; its angle and speed relative to the joint are memory. The joint's
actuators act on it, and servos see its angle and speed; the actuators' torque at the joint is
taken away again. Friction, damping and limits stay at the joint, and so does the armature that
`rotor_inertia` adds.
"""

import abc
from collections.abc import Mapping
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from garat_jax.effects.at_joint import actuator_torque, at_dof, feedback, is_driven
from garat_jax.effects.base import Effect, ModelView, Suggestion, parameter
from garat_jax.effects.elements import element_id
from garat_jax.effects.motor_body import add_gear, add_motor

RIGID = 1e9
"""Stiffness [N m/rad] that stands for "does not bend"."""
RESONANCES = (3.0, 8.0, 20.0, 50.0)
"""Frequencies [Hz] of motor against link at which a flexible joint is tried."""
DAMPED = 0.05
"""Damping there, relative to the critical one; without any it would ring through whole segments."""
CONTACT = 0.5
"""Impulse per speed of contact in a substep, relative to the reduced inertia."""
SPRING_SHARE = 0.25
"""Part of the contact's impulse per speed that is its spring's; the rest is damping."""
PARTS_OF_TRAVEL = (0.01, 0.1)
"""Parts of the way that a joint goes along the recordings at which play is tried."""
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
        stiffened: The same, with what the servo's feedback adds within a substep.
        deflection: Motor angle minus joint angle, rad.
        slip: Motor speed minus joint speed, rad/s.
        speed: Of the joint, rad/s.
        torque: On the motor, its servo's pull at the present speed left out, N m.
    """

    joint: int
    inertia: float
    stiffened: float
    deflection: jax.Array
    slip: jax.Array
    speed: jax.Array
    torque: jax.Array


def link_inertia(host: mujoco.MjModel, dof: int) -> float:
    """Return the inertia at a dof without the motor's, at the reference pose, kg m²."""
    motor = float(host.dof_armature[dof])
    return max(1.0 / float(host.dof_invweight0[dof]) - motor, 1e-3 * motor)


@struct.dataclass
class Transmission(Effect, abc.ABC):
    """A motor that is not rigidly at its joint; one such effect at a joint."""

    elements: ClassVar[tuple[str, ...]] = ("joint",)
    needs: ClassVar[str] = (
        "a joint with motors or servos without dynamics, an armature above 0 (the motor's "
        "inertia), and an integrator other than RK4"
    )
    acts: ClassVar[bool] = True
    reads_state: ClassVar[bool] = True

    @classmethod
    def fits(cls, host: mujoco.MjModel, element: str, name: str) -> bool:
        """Say whether the joint has a motor with inertia, and an integrator that is implicit."""
        if not super().fits(host, element, name) or not is_driven(host, name):
            return False
        moving = host.dof_armature[host.joint(name).dofadr[0]] > 0
        return bool(moving) and host.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4

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

    def stiffened(self, host: mujoco.MjModel) -> float:
        """Return the motor's inertia and what servo feedback adds in a substep, kg m²."""
        step = host.opt.timestep
        per_angle, per_speed = feedback(host, element_id(host, "joint", self.name))
        return self.inertia(host) + step * (per_speed + step * per_angle)

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
        damping = self.implicit_damping(host)
        if host.opt.integrator in IMPLICIT:
            damping = damping - feedback(host, element_id(host, "joint", self.name))[1]
        return {
            "dof_armature": model["dof_armature"].at[dof].add(-gone),
            "dof_damping": model["dof_damping"].at[dof].add(jnp.where(self.active, damping, 0.0)),
        }

    def implicit_damping(self, host: mujoco.MjModel) -> jax.Array:
        """Return the damping [N m s/rad] at the joint that the engine takes implicitly, []."""
        del host
        return jnp.zeros(())

    def apply(self, model: ModelView, state, ctrl: jax.Array, memory: Motor):
        """Turn the motor, and couple it to the joint."""
        host = model.host
        joint = element_id(host, "joint", self.name)
        angle, speed = state.qpos[host.jnt_qposadr[joint]], state.qvel[host.jnt_dofadr[joint]]
        deflection, slip = _finish(memory, angle, speed, host.opt.timestep)
        per_speed = feedback(host, joint)[1]
        motor = actuator_torque(model, joint, angle + deflection, speed + slip, ctrl)
        side = MotorSide(
            joint=joint,
            inertia=self.inertia(host),
            stiffened=self.stiffened(host),
            deflection=deflection,
            slip=slip,
            speed=speed,
            torque=motor + per_speed * (speed + slip),
        )
        torque, own, apart = self.couple(model, side)
        native = actuator_torque(model, joint, angle, speed, ctrl)
        if host.opt.integrator in IMPLICIT:
            native = native + per_speed * speed
        torque = jnp.where(self.active, torque - native, 0.0)
        after = Motor(deflection, slip, own, apart, angle)
        kept = jax.tree.map(lambda new, old: new.astype(old.dtype), after, memory)
        return ctrl, at_dof(host, joint, torque, ctrl.dtype), kept

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
        per_angle, per_speed = (
            rate + servo / self.inertia(host)
            for rate, servo in zip(
                self.rates(host), feedback(host, element_id(host, "joint", self.name)), strict=True
            )
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


@struct.dataclass
class JointFlexibility(Transmission):
    """The gear between motor and link bends: harmonic drives, belts, long shafts.

    Motor J·θ̈ = τ_a − τ, link torque τ = k·(θ − q) + d·(θ̇ − q̇) (Spong 1987). The spring is taken
    implicitly on both sides as far as its stiffness needs it (see `slope`), so that any is stable
    at any timestep. Shows as a resonance of link against motor after fast commands, and as
    servos that hold their motor but not their link. Typical: 1e3 to 5e4 N m/rad for harmonic
    drives of arms (Albu-Schäffer, Ott and Hirzinger 2007), 10 to 100 for table-top robots.
    """

    kind: ClassVar[str] = "joint_flexibility"
    law: ClassVar[str] = "τ = k·(θ_m − q) + d·(θ̇_m − q̇), J·θ̈_m = τ_a − τ"
    identified_by: ClassVar[str] = "steps and chirps through the resonance; a load against a servo"

    stiffness: jax.Array = parameter(
        RIGID,
        unit="N m/rad",
        low=1e-2,
        high=RIGID,
        scale=1.0,
        source="From a rubber coupling to a rigid shaft",
    )
    damping: jax.Array = parameter(
        0.0,
        unit="N m s/rad",
        low=0.0,
        high=1e3,
        scale=1e-2,
        source="As viscous_damping; gears lose a few per cent of critical damping",
    )

    @classmethod
    def starts(cls, host: mujoco.MjModel, target: str) -> tuple[Mapping[str, float], ...]:
        """Try springs that put the resonance of motor against link at several frequencies."""
        dof = int(host.joint(target.partition("/")[2]).dofadr[0])
        motor, link = float(host.dof_armature[dof]), link_inertia(host, dof)
        reduced = motor * link / (motor + link)
        rates, lost = 2 * np.pi * np.asarray(RESONANCES), 2 * DAMPED * reduced
        return tuple({"stiffness": reduced * w**2, "damping": lost * w} for w in rates)

    @property
    def active(self) -> jax.Array:
        """Whether the joint bends at all, []."""
        return jnp.asarray(self.stiffness) < RIGID

    def tie(self, tendon: mujoco.MjsTendon, timestep: float) -> str:
        """Make the tendon a spring and a damper."""
        del timestep
        tendon.stiffness[0], tendon.damping[0] = float(self.stiffness), float(self.damping)
        return "is its spring and damper"

    def rates(self, host: mujoco.MjModel) -> tuple[float, float]:
        """Return what the spring and the damper do to motor against link."""
        link = link_inertia(host, host.joint(self.name).dofadr[0])
        mobility = 1.0 / self.inertia(host) + 1.0 / link
        return float(self.stiffness) * mobility, float(self.damping) * mobility

    def slope(self, host: mujoco.MjModel) -> jax.Array:
        """Return the torque [N m s/rad] that the slip at the end of a substep gives, [].

        The spring at the start alone is stable up to (ω·h)² = 4 and takes no energy; at the end it
        is stable at any stiffness, and damps. The part from the end grows with x = (ω·h)² as
        x/(x + 2), with a margin for links that are lighter than at the reference pose.
        """
        step, motor = host.opt.timestep, self.inertia(host)
        link = link_inertia(host, int(host.joint(self.name).dofadr[0]))
        x = step**2 * self.stiffness * (motor + link) / (motor * link)
        return step * self.stiffness * x / (x + 2.0) + self.damping

    def implicit_damping(self, host: mujoco.MjModel) -> jax.Array:
        """Return what the gear's torque owes to the joint's speed after the substep, []."""
        step, whole, slope = host.opt.timestep, self.stiffened(host), self.slope(host)
        return slope * whole / (whole + step * slope)

    def couple(self, model: ModelView, side: MotorSide) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Solve the motor with the gear at the end of the substep."""
        step, slope = model.host.opt.timestep, self.slope(model.host)
        spring = self.stiffness * side.deflection
        whole = side.stiffened + step * slope
        momentum = side.inertia * (side.speed + side.slip)
        own = (momentum + step * (side.torque - spring)) / whole
        return spring + slope * own, own, side.stiffened / whole


@struct.dataclass
class Backlash(Transmission):
    """The gear has play: within `gap` motor and link turn freely, then they strike.

    The motor is within ±gap/2 of the link or pushes it. Contact is a spring and damper as stiff as
    is stable at the timestep h: it yields by about 4·τ·h²/μ under a torque τ, with μ the reduced
    inertia of motor and link (1 mrad for 100 rad/s² at 2 ms; a quarter of it at half the timestep).
    Shows as a pause and a jump at each reversal of the torque, and as a limit cycle of servos.
    Typical: 1 to 20 mrad for spur gears and hobby servos, under 1 mrad for harmonic drives (Nordin
    and Gutman 2002).
    """

    kind: ClassVar[str] = "backlash"
    law: ClassVar[str] = "τ = 0 while |θ_m − q| < gap/2, else contact; J·θ̈_m = τ_a − τ"
    identified_by: ClassVar[str] = "torque that reverses slowly and quickly, at several sizes"

    gap: jax.Array = parameter(
        0.0,
        unit="rad",
        low=0.0,
        high=0.5,
        scale=5e-3,
        source="Nordin and Gutman 2002; worn gears and loose couplings have a few degrees",
    )

    @classmethod
    def starts(cls, host: mujoco.MjModel, target: str) -> tuple[Mapping[str, float], ...]:
        """Try a new gear's play, a worn one's, and a loose one's."""
        del host, target
        return tuple({"gap": gap} for gap in (0.003, 0.015, 0.06))

    @classmethod
    def suggested(
        cls, position: np.ndarray, torque: np.ndarray, rests: np.ndarray
    ) -> Suggestion | None:
        """Try parts of the joint's travel: a gap beyond it is never crossed, and a slide has m."""
        del torque, rests
        travel, most = float(np.ptp(position)), cls.parameters()[0].high
        gaps = [part * travel for part in PARTS_OF_TRAVEL if 0 < part * travel < most]
        return Suggestion(tuple({"gap": gap} for gap in gaps), len(gaps))

    @property
    def active(self) -> jax.Array:
        """Whether there is any play, []."""
        return jnp.asarray(self.gap) > 0.0

    def tie(self, tendon: mujoco.MjsTendon, timestep: float) -> str:
        """Limit the tendon to the play, as stiffly as MuJoCo's limits can be."""
        tendon.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        tendon.range = 0.5 * float(self.gap) * np.asarray([-1.0, 1.0])
        tendon.solref_limit = [2.0 * timestep, 1.0]
        return f"lets both turn {float(self.gap):.4g} rad freely; its ends yield a little"

    def rates(self, host: mujoco.MjModel) -> tuple[float, float]:
        """Return zeros: limits are stable at any timestep."""
        del host
        return 0.0, 0.0

    def couple(self, model: ModelView, side: MotorSide) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Solve the motor against the link's present speed where they touch."""
        step = model.host.opt.timestep
        link = link_inertia(model.host, int(model.host.jnt_dofadr[side.joint]))
        reduced = side.inertia * link / (side.inertia + link)
        slope = CONTACT * reduced / step * side.stiffened / (side.stiffened - CONTACT * reduced)
        half = 0.5 * self.gap
        pressed = side.deflection - jnp.clip(side.deflection, -half, half)
        spring = SPRING_SHARE * slope / step * pressed
        momentum = side.inertia * (side.speed + side.slip) + step * side.torque
        reached = (momentum - step * (spring - slope * side.speed)) / (
            side.stiffened + step * slope
        )
        force = spring + slope * (reached - side.speed)
        pushes = (pressed != 0.0) & (force * pressed > 0.0)
        force = jnp.where(pushes, force, 0.0)
        return force, (momentum - step * force) / side.stiffened, jnp.ones_like(force)
