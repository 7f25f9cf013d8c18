"""Effects between a motor and its joint: a gear that bends, a gear with play."""

from collections.abc import Mapping
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from garat_jax.effects.base import ModelView, Suggestion, parameter
from garat_jax.effects.motor_apart import MotorSide, Transmission, link_inertia

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
    needs: ClassVar[str] = f"{Transmission.needs}, nor under Euler eulerdamp"

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
    def fits(cls, host: mujoco.MjModel, element: str, name: str) -> bool:
        """Say whether the joint has such a motor, and the engine takes its damping implicitly."""
        is_euler = host.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
        is_off = bool(host.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
        return super().fits(host, element, name) and not (is_euler and is_off)

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

    def implicit_damping(self, host: mujoco.MjModel, stiffened) -> jax.Array:
        """Return what the gear's torque owes to the joint's speed after the substep, []."""
        step, slope = host.opt.timestep, self.slope(host)
        return slope * stiffened / (stiffened + step * slope)

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
