"""Minitaur's motors as they were measured: torque falls behind current."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from garat_jax.effects.base import Effect, ModelView
from garat_jax.envs.minitaur import MOTORS

TORQUE_CONSTANT = 0.0954
"""Torque over current [N m/A] of the motor without saturation."""
CURRENTS = np.asarray([0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0])
"""Motor currents [A] at which the torque was measured."""
TORQUES = np.asarray([0.0, 1.0, 1.9, 2.45, 3.0, 3.25, 3.5])
"""Measured torques [N m]."""


@struct.dataclass
class SaturatedMotors(Effect):
    """The torque of all of Minitaur's motors follows the measured curve of the current.

    The catalogue's `motor_curve` for motors under position control, whose current depends on angle
    and rate. The torque that the model's sensors show stays the linear one, as in PyBullet, whose
    `motor.py` has the table. Beyond 60 A the torque stays 3.5 N m.
    """

    kind: ClassVar[str] = "saturated_motors"
    elements: ClassVar[tuple[str, ...]] = ("all",)
    law: ClassVar[str] = "τ = f(I), I = τ_model / k"
    identified_by: ClassVar[str] = "slow motion under known loads"
    acts: ClassVar[bool] = True
    reads_state: ClassVar[bool] = True

    def apply(self, model: ModelView, state, ctrl: jax.Array, memory):
        """Add what the curve's torque lacks of the linear one."""
        host = model.host
        bias = jnp.asarray(host.actuator_biasprm, ctrl.dtype)
        angle, rate = state.qpos[7 + MOTORS], state.qvel[6 + MOTORS]
        linear = model["actuator_gainprm"][:, 0] * ctrl + bias[:, 0]
        linear = linear + bias[:, 1] * angle + bias[:, 2] * rate
        low, high = jnp.asarray(host.actuator_forcerange, ctrl.dtype).T
        linear = jnp.clip(linear, low, high)
        torque = jnp.sign(linear) * torque_of(jnp.abs(linear) / TORQUE_CONSTANT)
        force = jnp.zeros(host.nv, ctrl.dtype).at[6 + MOTORS].set(torque - linear)
        return ctrl, force, memory


def torque_of(current: jax.Array) -> jax.Array:
    """Return the measured torque [N m] at a current [A] of 0 or more."""
    return jnp.interp(current, jnp.asarray(CURRENTS), jnp.asarray(TORQUES))
