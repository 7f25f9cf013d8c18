"""Effects at an actuator's output: gain, limit, back-EMF and the motor's curve.

Torques are those at the joint, behind the actuator's gear: MuJoCo's actuator force times `gear`.
At a site, or a joint of several dofs, it is the force or torque along the gear's direction.
"""

from collections.abc import Mapping
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from garat_jax.effects.at_joint import BIASES, GAINS, clamps
from garat_jax.effects.base import Effect, ModelView, Suggestion, parameter
from garat_jax.effects.elements import element_id
from garat_jax.effects.gear import gear_in, gear_of
from garat_jax.errors import UserError

UNLIMITED = 1e9
"""Torque [N m] that stands for "no limit"."""
PARTS_OF_RANGE = (0.9, 0.7, 0.5, 0.3)
"""Parts of an actuator's largest torque at which laws with a threshold are tried."""
TIMES_BELOW = (0.3, 0.6, 0.85, 0.97)
"""Parts of the recordings in which the model's torque stays below a limit that is tried."""
FELT = 0.9
"""A limit that is tried, of the torque that it is to cut: one at a held torque is not felt."""
ALIKE = 1.1
"""Ratio of two sizes within which a fit goes from one to the other by itself."""
A_MOTOR = "an actuator whose force is its gain times the command"
MINITAUR_CURVE = (
    (0.0, 0.0),
    (1.0, 1.0),
    (2.0, 1.9),
    (3.0, 2.45),
    (4.0, 3.0),
    (5.0, 3.25),
    (6.0, 3.5),
)
"""Minitaur's motor: torque if it were linear in the current (0.1 N m/A), and torque, N m.

Tan et al. 2018 (arXiv 1804.10332); the table is that of PyBullet's minitaur motor model, for
currents of 0, 10 .. 60 A.
"""


def clamped(host: mujoco.MjModel, ctrl: jax.Array) -> jax.Array:
    """Return the command [nu] within the actuators' ctrlrange, as the engine would take it."""
    limited = clamps(host)
    low = np.where(limited, host.actuator_ctrlrange[:, 0], -np.inf)
    high = np.where(limited, host.actuator_ctrlrange[:, 1], np.inf)
    return jnp.clip(ctrl, jnp.asarray(low, ctrl.dtype), jnp.asarray(high, ctrl.dtype))


def largest_command(host: mujoco.MjModel, actuator: str) -> float:
    """Return the largest command that ctrlrange allows; 1 without one."""
    index = element_id(host, "actuator", actuator)
    if not host.actuator_ctrllimited[index]:
        return 1.0
    return float(np.abs(host.actuator_ctrlrange[index]).max())


def largest_torque(host: mujoco.MjModel, actuator: str) -> float:
    """Return the torque [N m] at the joint under the largest command, as the model has it."""
    index = element_id(host, "actuator", actuator)
    force = abs(float(host.actuator_gainprm[index, 0])) * largest_command(host, actuator)
    if host.actuator_forcelimited[index]:
        force = min(force, float(np.abs(host.actuator_forcerange[index]).max()))
    return force * abs(gear_of(host, index))


def limits_within(torque: np.ndarray) -> tuple[float, ...]:
    """Return limits [N m], none alike, that cut a torque [M] in several parts of the time."""
    limits: list[float] = []
    for size in FELT * np.quantile(np.abs(torque), TIMES_BELOW):
        if size > ALIKE * (limits[-1] if limits else 0.0):
            limits.append(float(size))
    return tuple(limits)


def is_motor(host: mujoco.MjModel, actuator: str) -> bool:
    """Say whether an actuator's force is its gain times the command: no servo, muscle or filter."""
    index = element_id(host, "actuator", actuator)
    plain = host.actuator_gaintype[index] == mujoco.mjtGain.mjGAIN_FIXED
    free = host.actuator_biastype[index] == mujoco.mjtBias.mjBIAS_NONE
    servo = np.any(host.actuator_biasprm[index, :2])
    affine = host.actuator_biastype[index] == mujoco.mjtBias.mjBIAS_AFFINE
    memoryless = host.actuator_dyntype[index] == mujoco.mjtDyn.mjDYN_NONE
    return bool(plain and memoryless and (free or (affine and not servo)))


@struct.dataclass
class MotorGain(Effect):
    """The actuator gives another force than commanded, in proportion; its limit moves with it.

    Shows as a response that is too large or too small by the same factor everywhere. It cannot be
    told from inertia without a run under a known load. Typical: 0.7 to 1.3.
    """

    kind: ClassVar[str] = "motor_gain"
    elements: ClassVar[tuple[str, ...]] = ("actuator",)
    needs: ClassVar[str] = "an actuator whose gain and bias are fixed or affine, as no muscle's are"
    law: ClassVar[str] = "τ = s·τ_model(u, q, q̇)"
    identified_by: ClassVar[str] = "commands of several sizes, with and without a known payload"

    scale: jax.Array = parameter(
        1.0,
        unit="1",
        low=0.1,
        high=3.0,
        scale=0.05,
        source="A motor that gives a tenth or three times its rated torque is another motor",
    )

    @classmethod
    def fits(cls, host: mujoco.MjModel, element: str, name: str) -> bool:
        """Say whether the actuator's force is in proportion to the numbers of its gain and bias."""
        if not super().fits(host, element, name):
            return False
        index = element_id(host, "actuator", name)
        is_plain = host.actuator_gaintype[index] in GAINS
        return bool(is_plain and host.actuator_biastype[index] in BIASES)

    def fields(self, model: ModelView) -> dict[str, jax.Array]:
        """Scale the actuator's whole gain and bias, and the range of its force."""
        index = element_id(model.host, "actuator", self.name)
        return {
            name: model[name].at[index].multiply(self.scale)
            for name in ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange")
        }

    def export(self, spec: mujoco.MjSpec) -> str:
        """Scale the actuator's gain, bias and range of force."""
        actuator = spec.actuator(self.name)
        actuator.gainprm = actuator.gainprm * float(self.scale)
        actuator.biasprm = actuator.biasprm * float(self.scale)
        actuator.forcerange = actuator.forcerange * float(self.scale)
        return ""


@struct.dataclass
class TorqueSaturation(Effect):
    """The actuator gives no more than a limit: |τ| ≤ limit at the joint (gear·force).

    Shows as a response to large commands that is the same whatever their size, while small ones
    are followed. The model's own forcerange stays where it is tighter. Typical: the driver's
    current limit, 0.3 to 1 of the peak torque in the data sheet.
    """

    kind: ClassVar[str] = "torque_saturation"
    elements: ClassVar[tuple[str, ...]] = ("actuator",)
    law: ClassVar[str] = "τ ← clip(τ, −τ_max, τ_max)"
    identified_by: ClassVar[str] = "steps of growing size up to the largest command"

    limit: jax.Array = parameter(
        UNLIMITED,
        unit="N m",
        low=1e-3,
        high=UNLIMITED,
        scale=0.1,
        source="From a micro servo to no limit at all",
    )

    @classmethod
    def starts(cls, host: mujoco.MjModel, target: str) -> tuple[Mapping[str, float], ...]:
        """Try parts of the model's largest torque: above it the limit is never felt."""
        largest = largest_torque(host, target.partition("/")[2])
        return tuple({"limit": part * largest} for part in PARTS_OF_RANGE)

    @classmethod
    def suggested_by_commands(cls, command: np.ndarray, torque: np.ndarray) -> Suggestion | None:
        """Try limits that the model goes beyond for several parts of the time."""
        del command
        limits = limits_within(torque)
        return Suggestion(tuple({"limit": limit} for limit in limits), len(limits))

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Switch the limit of the force on, where the model has none at infinity."""
        actuator = spec.actuator(self.name)
        if not is_limited(actuator.forcelimited, actuator.forcerange):
            actuator.forcerange = np.array([-UNLIMITED, UNLIMITED])
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE

    def fields(self, model: ModelView) -> dict[str, jax.Array]:
        """Narrow the range of the actuator's force."""
        index = element_id(model.host, "actuator", self.name)
        gear = abs(gear_of(model.host, index))
        limit = jnp.where(jnp.asarray(self.limit) < UNLIMITED, self.limit / gear, jnp.inf)
        ranges = model["actuator_forcerange"]
        low, high = jnp.maximum(ranges[index, 0], -limit), jnp.minimum(ranges[index, 1], limit)
        return {"actuator_forcerange": ranges.at[index].set(jnp.stack([low, high]))}

    def export(self, spec: mujoco.MjSpec) -> str:
        """Narrow the range of the actuator's force."""
        actuator = spec.actuator(self.name)
        limit = float(self.limit) / abs(gear_in(spec, actuator))
        low, high = (
            actuator.forcerange
            if is_limited(actuator.forcelimited, actuator.forcerange)
            else (-limit, limit)
        )
        actuator.forcerange = np.array([max(low, -limit), min(high, limit)])
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        return ""


def is_limited(limited: mujoco.mjtLimited, bounds: np.ndarray) -> bool:
    """Say whether MuJoCo's compiler takes a spec's bounds [2] for limits."""
    if limited == mujoco.mjtLimited.mjLIMITED_AUTO:
        return bool(bounds[0] < bounds[1])
    return limited == mujoco.mjtLimited.mjLIMITED_TRUE


@struct.dataclass
class BackEmf(Effect):
    """The motor's own voltage lowers its torque as it turns: τ = τ_model − c·q̇ at the joint.

    Shows as torque that is missing at speed, but only while the driver's limit leaves room: the
    limit of the force cuts the sum. Without such a limit it is viscous damping by another name,
    and no recording tells the two apart. Typical: c = k_t²·N²/R, 0.01 to 1 N m s/rad for a geared
    robot joint under voltage control (Spong, Hutchinson and Vidyasagar 2006).
    """

    kind: ClassVar[str] = "back_emf"
    elements: ClassVar[tuple[str, ...]] = ("actuator",)
    needs: ClassVar[str] = "an actuator with an affine bias or none"
    law: ClassVar[str] = "τ = τ_model(u, q, q̇) − c·q̇ (MuJoCo's affine bias)"
    identified_by: ClassVar[str] = "full command at speed, beside a free decay with the motor off"

    coefficient: jax.Array = parameter(
        0.0,
        unit="N m s/rad",
        low=0.0,
        high=100.0,
        scale=1e-3,
        source="As viscous damping: MuJoCo Menagerie's servos have velocity gains up to 100",
    )

    @classmethod
    def fits(cls, host: mujoco.MjModel, element: str, name: str) -> bool:
        """Say whether the actuator's bias is affine or can be made so."""
        if not super().fits(host, element, name):
            return False
        return host.actuator_biastype[element_id(host, "actuator", name)] in BIASES

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Give the actuator an affine bias, of zero where it had none."""
        make_affine(spec.actuator(self.name))

    def fields(self, model: ModelView) -> dict[str, jax.Array]:
        """Lower the bias by the coefficient over gear squared: bias is in actuator coordinates."""
        index = element_id(model.host, "actuator", self.name)
        gear = gear_of(model.host, index)
        bias = model["actuator_biasprm"]
        return {"actuator_biasprm": bias.at[index, 2].add(-self.coefficient / gear**2)}

    def export(self, spec: mujoco.MjSpec) -> str:
        """Lower the bias by the coefficient over gear squared."""
        actuator = spec.actuator(self.name)
        make_affine(actuator)
        actuator.biasprm[2] -= float(self.coefficient) / gear_in(spec, actuator) ** 2
        return ""


def can_bias(actuator: mujoco.MjsActuator) -> bool:
    """Say whether an actuator's bias can add to its force unchecked."""
    return actuator.biastype in BIASES and not is_limited(
        actuator.forcelimited, actuator.forcerange
    )


def make_affine(actuator: mujoco.MjsActuator) -> None:
    """Give an actuator without bias one that is affine and zero."""
    if actuator.biastype == mujoco.mjtBias.mjBIAS_NONE:
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        actuator.biasprm = np.zeros_like(actuator.biasprm)


@struct.dataclass
class MotorCurve(Effect):
    """Torque falls behind current as the motor's iron saturates.

    The model's torque stands for current times torque constant. Up to `linear` it is given in
    full; beyond, it approaches `saturation` along an exponential that leaves without a kink:
    τ = l + (s − l)·(1 − exp(−(τ_model − l)/(s − l))). A known motor's `table` of (linear torque,
    torque) is read first. Shows as a gain that falls with the size of the command, at any speed.
    Typical: linear to half of the peak current (Tan et al. 2018 on Minitaur, `MINITAUR_CURVE`).

    Attributes:
        table: Pairs of linear torque and torque, N m, from (0, 0) on; the same for both signs.
    """

    kind: ClassVar[str] = "motor_curve"
    elements: ClassVar[tuple[str, ...]] = ("actuator",)
    needs: ClassVar[str] = A_MOTOR
    law: ClassVar[str] = "τ = f(τ_model): linear, then an exponential towards τ_s; or a table"
    identified_by: ClassVar[str] = "commands of several sizes, slow and under a known load"
    acts: ClassVar[bool] = True
    tables: ClassVar[tuple[str, ...]] = ("table",)

    saturation: jax.Array = parameter(
        UNLIMITED,
        unit="N m",
        low=1e-3,
        high=UNLIMITED,
        scale=0.1,
        source="From a micro servo to no saturation at all",
    )
    linear: jax.Array = parameter(
        0.0,
        unit="N m",
        low=0.0,
        high=1e3,
        scale=0.05,
        source="From a curve that bends at once to one that is straight up to a large motor's peak",
    )
    table: tuple[tuple[float, float], ...] = struct.field(pytree_node=False, default=())

    @classmethod
    def fits(cls, host: mujoco.MjModel, element: str, name: str) -> bool:
        """Say whether the actuator is a plain motor."""
        return super().fits(host, element, name) and is_motor(host, name)

    def check(self, host: mujoco.MjModel) -> None:
        """Check the table, too.

        Raises:
            UserError: As `Effect.check`, or the table is no curve from (0, 0) on.
        """
        super().check(host)
        rows = np.reshape(self.table, (-1, 2))
        if len(rows) and (np.any(rows[0]) or np.any(np.diff(rows[:, 0]) <= 0) or rows.min() < 0):
            raise UserError(
                f"{self.kind} table at {self.target}: expected [linear torque, torque] from [0, 0] "
                f"on, the first rising and neither below 0, not {rows.tolist()}"
            )

    @classmethod
    def starts(cls, host: mujoco.MjModel, target: str) -> tuple[Mapping[str, float], ...]:
        """Try saturations from above the model's largest torque down to part of it."""
        largest = largest_torque(host, target.partition("/")[2])
        return tuple(
            {"saturation": part * largest, "linear": 0.3 * part * largest}
            for part in (1.5, *PARTS_OF_RANGE)
        )

    @classmethod
    def suggested_by_commands(cls, command: np.ndarray, torque: np.ndarray) -> Suggestion | None:
        """Try saturations that the model goes beyond for several parts of the time."""
        del command
        limits = limits_within(torque)
        starts = ({"saturation": limit, "linear": 0.3 * limit} for limit in limits)
        return Suggestion(tuple(starts), len(limits))

    def apply(self, model: ModelView, state, ctrl: jax.Array, memory):
        """Command what gives the curve's torque under the model's linear law."""
        del state
        host = model.host
        index = element_id(host, "actuator", self.name)
        slope = float(host.actuator_gainprm[index, 0]) * gear_of(host, index)
        command = clamped(host, ctrl)[index]
        torque = self._curve(command * slope)
        return ctrl.at[index].set((torque / slope).astype(ctrl.dtype)), None, memory

    def _curve(self, torque: jax.Array) -> jax.Array:
        """Return the motor's torque for a linear one, both N m."""
        size = jnp.abs(torque)
        if self.table:
            given, got = (
                jnp.asarray(column, torque.dtype) for column in zip(*self.table, strict=True)
            )
            size = jnp.interp(size, given, got)
        saturates = jnp.asarray(self.saturation) < UNLIMITED
        linear = jnp.minimum(self.linear, self.saturation)
        room = jnp.where(saturates, jnp.maximum(self.saturation - linear, 1e-9), 1.0)
        beyond = jnp.maximum(size - linear, 0.0)
        bent = jnp.minimum(size, linear) - room * jnp.expm1(-beyond / room)
        return jnp.sign(torque) * jnp.where(saturates, bent, size)
