"""What a torque at one joint feels, and what the actuators there give."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from garat_jax.effects.base import ModelView
from garat_jax.effects.elements import element_id

AT_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
GAINS = (int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE))
BIASES = (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))
NOTICED = 0.1
"""Acceleration [rad/s², m/s²] that a recording shows."""


def small_torque(host: mujoco.MjModel, name: str, least: float) -> float:
    """Return a torque [N m] or force [N] that is small at a joint, but shows there.

    Args:
        host: The compiled model.
        name: The joint.
        least: As much as that, at least.
    """
    dof = int(host.joint(name).dofadr[0])
    return max(least, NOTICED / float(host.dof_invweight0[dof]))


def at_dof(host: mujoco.MjModel, joint: int, torque: jax.Array, dtype) -> jax.Array:
    """Return a generalised force [nv] that is a torque at a one-dof joint, by the joint's index."""
    return jnp.zeros(host.nv, dtype).at[host.jnt_dofadr[joint]].set(torque)


def felt_inertia(model: ModelView, dof: int) -> jax.Array:
    """Return the inertia [kg m²] that a torque at a dof feels at the reference pose, [].

    It is the compiled model's, with the armature that effects have added or taken away.
    """
    host = model.host
    return 1.0 / host.dof_invweight0[dof] + model["dof_armature"][dof] - host.dof_armature[dof]


def drivers(host: mujoco.MjModel, joint: int) -> list[int]:
    """List the actuators that act on a joint."""
    return [
        i
        for i in range(host.nu)
        if host.actuator_trntype[i] in AT_JOINT and host.actuator_trnid[i, 0] == joint
    ]


def is_driven(host: mujoco.MjModel, name: str) -> bool:
    """Say whether a joint has actuators, all of kinds that `actuator_torque` knows."""
    found = drivers(host, element_id(host, "joint", name))
    return bool(found) and all(
        host.actuator_gaintype[i] in GAINS
        and host.actuator_biastype[i] in BIASES
        and host.actuator_dyntype[i] == mujoco.mjtDyn.mjDYN_NONE
        for i in found
    )


def actuator_torque(
    model: ModelView, joint: int, angle: jax.Array, speed: jax.Array, ctrl: jax.Array
) -> jax.Array:
    """Return the torque [N m] of a joint's actuators as MuJoCo computes it, [].

    Args:
        model: The model's gains, biases and limits.
        joint: The joint's index.
        angle: Where the actuators are, in the joint's coordinate, [].
        speed: How fast they turn, [].
        ctrl: Command, [nu].
    """
    host = model.host
    total = jnp.zeros((), ctrl.dtype)
    for i in drivers(host, joint):
        gear = float(host.actuator_gear[i, 0])
        command = ctrl[i]
        if host.actuator_ctrllimited[i]:
            command = jnp.clip(command, *(float(v) for v in host.actuator_ctrlrange[i]))
        length, velocity = gear * angle, gear * speed
        gain, bias = model["actuator_gainprm"][i], model["actuator_biasprm"][i]
        force = gain[0] * command
        if host.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_AFFINE:
            force = force + (gain[1] * length + gain[2] * velocity) * command
        if host.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE:
            force = force + bias[0] + bias[1] * length + bias[2] * velocity
        if host.actuator_forcelimited[i]:
            low, high = model["actuator_forcerange"][i]
            force = jnp.clip(force, low, high)
        total = total + gear * force
    if host.jnt_actfrclimited[joint]:
        total = jnp.clip(total, *(float(v) for v in host.jnt_actfrcrange[joint]))
    return total.astype(ctrl.dtype)


def feedback(host: mujoco.MjModel, joint: int) -> tuple[float, float]:
    """Return how much a joint's servos pull back per angle and per speed, N m/rad, N m s/rad."""
    found = drivers(host, joint)
    bias = np.where(
        host.actuator_biastype[found][:, None] == mujoco.mjtBias.mjBIAS_AFFINE,
        host.actuator_biasprm[found],
        0.0,
    )
    pull = -bias[:, 1:3] * host.actuator_gear[found][:, :1] ** 2
    per_angle, per_speed = np.maximum(pull.sum(axis=0), 0.0)
    return float(per_angle), float(per_speed)
