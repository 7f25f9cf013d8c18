"""Effects on a command before it becomes force: a dead band, a lag, a delay."""

from collections.abc import Mapping
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from garat_jax.effects.actuator import A_MOTOR, clamped, is_motor, largest_command
from garat_jax.effects.base import Effect, ModelView, Suggestion, parameter
from garat_jax.effects.elements import element_id

PARTS_OF_COMMAND = (0.01, 0.05, 0.2)
"""Parts of the largest command at which a dead band is tried."""


def _one_or_all(effect: Effect, host: mujoco.MjModel, ctrl: jax.Array, changed: jax.Array):
    """Return the changed command [nu] at the effect's actuator, or at all of them."""
    if effect.target == "all":
        return changed.astype(ctrl.dtype)
    index = element_id(host, "actuator", effect.name)
    return ctrl.at[index].set(changed[index].astype(ctrl.dtype))


@struct.dataclass
class MotorDeadband(Effect):
    """Commands within a band around 0 give nothing, larger ones lose its width.

    u ← sign(u)·max(|u| − width, 0). Shows as a joint that ignores small commands of either sign,
    and as torque that lacks the same amount whenever it is commanded. Typical: 1 to 5 % of the
    range for a PWM driver with dead time or a proportional valve.
    """

    kind: ClassVar[str] = "motor_deadband"
    elements: ClassVar[tuple[str, ...]] = ("actuator",)
    needs: ClassVar[str] = A_MOTOR
    law: ClassVar[str] = "u ← sign(u)·max(|u| − w, 0)"
    identified_by: ClassVar[str] = "slow command ramps through 0; small steps of both signs"
    acts: ClassVar[bool] = True

    width: jax.Array = parameter(
        0.0,
        unit="ctrl unit",
        low=0.0,
        high=1e3,
        scale=1e-2,
        source="Within the range of commands, whose unit is the model's",
    )

    @classmethod
    def fits(cls, host: mujoco.MjModel, element: str, name: str) -> bool:
        """Say whether the command is a torque or speed: a servo's 0 is a place like any other."""
        return super().fits(host, element, name) and is_motor(host, name)

    @classmethod
    def starts(cls, host: mujoco.MjModel, target: str) -> tuple[Mapping[str, float], ...]:
        """Try parts of the largest command: a band below the commands' sizes is a constant loss."""
        largest = largest_command(host, target.partition("/")[2])
        return tuple({"width": part * largest} for part in PARTS_OF_COMMAND)

    @classmethod
    def suggested_by_commands(cls, command: np.ndarray, torque: np.ndarray) -> Suggestion | None:
        """Try the same parts of the largest command that was given."""
        del torque
        largest = float(np.abs(command).max())
        starts = tuple({"width": part * largest} for part in PARTS_OF_COMMAND if largest > 0)
        return Suggestion(starts, len(starts))

    def apply(self, model: ModelView, state, ctrl: jax.Array, memory):
        """Take the band out of the command."""
        del state
        command = clamped(model.host, ctrl)
        rest = jnp.sign(command) * jnp.maximum(jnp.abs(command) - self.width, 0.0)
        return _one_or_all(self, model.host, ctrl, rest), None, memory


@struct.dataclass
class ActuatorLag(Effect):
    """A command takes effect gradually: current loop, hydraulics, a filter in the driver.

    First order: T·ẏ = u − y. The filter is solved exactly for the held command and its mean over
    each substep acts, so that the law does not depend on the timestep. It starts at the first
    command. Shows as a response that is rounded at steps and late by T at low frequency. Typical:
    1 to 20 ms for electric drives (Hwangbo et al. 2019), up to 0.1 s for pneumatics.
    """

    kind: ClassVar[str] = "actuator_lag"
    elements: ClassVar[tuple[str, ...]] = ("actuator", "all")
    law: ClassVar[str] = "T·ẏ = u − y, y acts in place of u"
    identified_by: ClassVar[str] = "step trains and chirps in the command, up to 1/T"
    acts: ClassVar[bool] = True

    time_constant: jax.Array = parameter(
        0.0,
        unit="s",
        low=0.0,
        high=0.5,
        scale=5e-3,
        source="From current loops (under 1 ms) to pneumatic muscles (a few tenths of a second)",
    )

    @classmethod
    def starts(cls, host: mujoco.MjModel, target: str) -> tuple[Mapping[str, float], ...]:
        """Try a fast and a slow actuator."""
        del host, target
        return ({"time_constant": 5e-3}, {"time_constant": 5e-2})

    def init(self, host: mujoco.MjModel):
        """Return the filter's output [nu] and whether any command came."""
        return jnp.zeros(host.nu), jnp.zeros((), bool)

    def apply(self, model: ModelView, state, ctrl: jax.Array, memory):
        """Filter the command and return its mean over the substep."""
        del state
        output, started = memory
        command = clamped(model.host, ctrl)
        gap = jnp.where(started, output - command, 0.0)
        lags = jnp.asarray(self.time_constant) > 0
        time_constant = jnp.where(lags, self.time_constant, 1.0)
        substeps = model.host.opt.timestep / time_constant
        left = jnp.where(lags, jnp.exp(-substeps), 0.0)
        mean = jnp.where(lags, -jnp.expm1(-substeps) / substeps, 0.0)
        acts = jnp.where(lags, command + gap * mean, ctrl)
        after = (command + gap * left).astype(output.dtype)
        return _one_or_all(self, model.host, ctrl, acts), None, (after, jnp.ones((), bool))

    def export(self, spec: mujoco.MjSpec) -> str:
        """Give the actuators MuJoCo's exact first-order filter."""
        late = []
        for actuator in spec.actuators:
            if self.target not in ("all", f"actuator/{actuator.name}"):
                continue
            if actuator.dyntype != mujoco.mjtDyn.mjDYN_NONE:
                late.append(actuator.name)
                continue
            actuator.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
            actuator.dynprm[0] = float(self.time_constant)
        filtered = f"; {', '.join(late)} has dynamics already and stays as it is" if late else ""
        return f"MuJoCo's filter is a state that starts at 0, not at the first command{filtered}"


@struct.dataclass
class ActuatorDelay(Effect):
    """A command acts only after a delay: bus, driver and controller cycle.

    Between substeps the delayed command is interpolated, which is its mean over a substep because
    commands are held; the law is therefore continuous in the delay. Before the first command the
    delayed command is the first one. Typical: 1 to 40 ms (Hwangbo et al. 2019, Tan et al. 2018).
    """

    kind: ClassVar[str] = "actuator_delay"
    elements: ClassVar[tuple[str, ...]] = ("actuator", "all")
    law: ClassVar[str] = "u(t) ← u(t − d)"
    identified_by: ClassVar[str] = "step trains and chirps in the command"
    acts: ClassVar[bool] = True

    delay: jax.Array = parameter(
        0.0,
        unit="s",
        low=0.0,
        high=0.1,
        scale=5e-3,
        source="Tan et al. 2018 (arXiv 1804.10332): latencies of 0 to 40 ms, with room to spare",
    )

    def _actuators(self, host: mujoco.MjModel) -> np.ndarray:
        """Return the indices of the actuators that are late."""
        if self.target == "all":
            return np.arange(host.nu)
        return np.asarray([element_id(host, "actuator", self.name)])

    def init(self, host: mujoco.MjModel):
        """Return a ring of past commands and how many came.

        The ring is [substeps that the longest delay spans, late actuators]; the command of substep
        k is in row k modulo its length.
        """
        substeps = int(np.ceil(self.parameters()[0].high / host.opt.timestep)) + 2
        return jnp.zeros((substeps, len(self._actuators(host)))), jnp.zeros((), jnp.int32)

    def apply(self, model: ModelView, state, ctrl: jax.Array, memory):
        """Put the command into the ring and read the one from `delay` seconds ago."""
        past, count = memory
        late = self._actuators(model.host)
        length = past.shape[0]
        command = clamped(model.host, ctrl)[late]
        past = past.at[count % length].set(command.astype(past.dtype))
        substeps = jnp.clip(self.delay / model.host.opt.timestep, 0, length - 2)
        whole = jnp.floor(substeps).astype(jnp.int32)
        fraction = (substeps - whole).astype(ctrl.dtype)
        ago, before = (jnp.maximum(count - whole - i, 0) % length for i in (0, 1))
        delayed = (1 - fraction) * past[ago] + fraction * past[before]
        return ctrl.at[late].set(delayed.astype(ctrl.dtype)), None, (past, count + 1)

    def export(self, spec: mujoco.MjSpec) -> str:
        """Add to the actuators' delay of MuJoCo's own, with a buffer that is long enough."""
        for actuator in spec.actuators:
            if float(self.delay) > 0 and self.target in ("all", f"actuator/{actuator.name}"):
                actuator.delay += float(self.delay)
                actuator.nsample = int(np.ceil(actuator.delay / spec.option.timestep)) + 2
                actuator.interp = 1
        return "MuJoCo's delay holds 0 before the first command, and MJX does not step it"
