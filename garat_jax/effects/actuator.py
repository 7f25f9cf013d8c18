"""Effects at an actuator: its gain, and the time a command takes to arrive."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from garat_jax.effects.base import Effect, ModelView, element_id, parameter


@struct.dataclass
class MotorGain(Effect):
    """The actuator gives another force than commanded, in proportion.

    Shows as a response that is too large or too small by the same factor everywhere. It cannot be
    told from inertia without a run under a known load. Typical: 0.7 to 1.3.
    """

    kind: ClassVar[str] = "motor_gain"
    elements: ClassVar[tuple[str, ...]] = ("actuator",)
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

    def fields(self, model: ModelView) -> dict[str, jax.Array]:
        """Scale the actuator's whole gain and bias."""
        index = element_id(model.host, "actuator", self.name)
        return {
            name: model[name].at[index].multiply(self.scale)
            for name in ("actuator_gainprm", "actuator_biasprm")
        }


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

    def init(self, host: mujoco.MjModel):
        """Return past commands [substeps that the longest delay spans, nu] and whether any came."""
        substeps = int(np.ceil(self.parameters()[0].high / host.opt.timestep)) + 2
        return jnp.zeros((substeps, host.nu)), jnp.zeros((), bool)

    def apply(self, model: ModelView, state, ctrl: jax.Array, memory):
        """Push the command and read the one from `delay` seconds ago."""
        past, started = memory
        past = jnp.where(started, jnp.roll(past, 1, axis=0).at[0].set(ctrl), ctrl)
        substeps = jnp.clip(self.delay / model.host.opt.timestep, 0, past.shape[0] - 1)
        whole = jnp.floor(substeps).astype(int)
        later = jnp.minimum(whole + 1, past.shape[0] - 1)
        fraction = (substeps - whole).astype(ctrl.dtype)
        delayed = (1 - fraction) * past[whole] + fraction * past[later]
        if self.target != "all":
            index = element_id(model.host, "actuator", self.name)
            delayed = ctrl.at[index].set(delayed[index])
        return delayed.astype(ctrl.dtype), None, (past, jnp.ones((), bool))
