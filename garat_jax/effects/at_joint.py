"""What a torque at one joint feels, and what the actuators there give."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from garat_jax.effects.base import ModelView
from garat_jax.effects.elements import element_id, num_actuators

AT_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
GAINS = (int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE))
BIASES = (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))
NUM_GROUPS = 31
"""Groups of actuators, from 0 on, that `actuatorgroupdisable` can name."""
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


def drag(model: ModelView, dof: int, speed: jax.Array, slope: jax.Array) -> jax.Array:
    """Return slope·speed [N m], no more than what stops the felt inertia in a substep, []."""
    stopping = model.host.opt.timestep * slope / felt_inertia(model, dof)
    return slope * speed / (1.0 + stopping)


def clamps(host: mujoco.MjModel) -> np.ndarray:
    """Say of which actuators the engine clamps the command to its range, [nu] bool."""
    if host.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL:
        return np.zeros(host.nu, bool)
    return host.actuator_ctrllimited.astype(bool)


def off_by_group(host: mujoco.MjModel) -> np.ndarray:
    """Say which actuators are in a group that the model disables, [actuators] bool."""
    group = host.actuator_group
    has_bit = (group >= 0) & (group < NUM_GROUPS)
    return has_bit & (host.opt.disableactuator >> np.where(has_bit, group, 0) & 1).astype(bool)


def drivers(host: mujoco.MjModel, joint: int) -> list[int]:
    """List the actuators that act on a joint, without those that are switched off.

    Raises:
        UserError: As `num_actuators`.
    """
    if host.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_ACTUATION:
        return []
    off = off_by_group(host)
    return [
        i
        for i in range(num_actuators(host))
        if host.actuator_trntype[i] in AT_JOINT
        and host.actuator_trnid[i, 0] == joint
        and not off[i]
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
    """Return the torque [N m] of a joint's actuators as MuJoCo computes it, []; see `drive`."""
    return drive(model, joint, angle, speed, ctrl).torque


class Drive(NamedTuple):
    """What a joint's actuators do there.

    Attributes:
        torque: What they give, N m.
        per_angle: How much of it they take back per angle, N m/rad, those at their limit nothing.
        per_speed: The same per speed, N m s/rad.
    """

    torque: jax.Array
    per_angle: jax.Array
    per_speed: jax.Array


def drive(
    model: ModelView, joint: int, angle: jax.Array, speed: jax.Array, ctrl: jax.Array
) -> Drive:
    """Compute a joint's actuators as MuJoCo does.

    Args:
        model: The model's gains, biases and limits.
        joint: The joint's index.
        angle: Where the actuators are, in the joint's coordinate, [].
        speed: How fast they turn, [].
        ctrl: Command, [nu].
    """
    host = model.host
    total, pull = jnp.zeros((), ctrl.dtype), jnp.zeros(2, ctrl.dtype)
    for i in drivers(host, joint):
        gear = float(host.actuator_gear[i, 0])
        command = ctrl[i]
        if clamps(host)[i]:
            command = jnp.clip(command, *(float(v) for v in host.actuator_ctrlrange[i]))
        length, velocity = gear * angle, gear * speed
        gain, bias = model["actuator_gainprm"][i], model["actuator_biasprm"][i]
        force = gain[0] * command
        if host.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_AFFINE:
            force = force + (gain[1] * length + gain[2] * velocity) * command
        if host.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE:
            force = force + bias[0] + bias[1] * length + bias[2] * velocity
        own = _pull(model, i).astype(ctrl.dtype)
        if host.actuator_forcelimited[i]:
            low, high = model["actuator_forcerange"][i]
            own = jnp.where((low < force) & (force < high), own, 0.0)
            force = jnp.clip(force, low, high)
        total, pull = total + gear * force, pull + own
    if host.jnt_actfrclimited[joint]:
        low, high = (float(v) for v in host.jnt_actfrcrange[joint])
        pull = jnp.where((low < total) & (total < high), pull, 0.0)
        total = jnp.clip(total, low, high)
    return Drive(total.astype(ctrl.dtype), *jnp.maximum(pull, 0.0))


def feedback(model: ModelView, joint: int) -> tuple[jax.Array, jax.Array]:
    """Return how much a joint's servos pull back per angle and per speed, N m/rad, N m s/rad."""
    pull = sum((_pull(model, i) for i in drivers(model.host, joint)), jnp.zeros(2))
    per_angle, per_speed = jnp.maximum(pull, 0.0)
    return per_angle, per_speed


def has_limit(host: mujoco.MjModel, joint: int) -> bool:
    """Say whether the force of a joint's actuators has limits."""
    limited = host.actuator_forcelimited[drivers(host, joint)]
    return bool(np.any(limited) or host.jnt_actfrclimited[joint])


def _pull(model: ModelView, actuator: int) -> jax.Array:
    """Return how much an actuator pulls back per angle and per speed of its joint, [2]."""
    if model.host.actuator_biastype[actuator] != mujoco.mjtBias.mjBIAS_AFFINE:
        return jnp.zeros(2)
    gear = float(model.host.actuator_gear[actuator, 0])
    return -model["actuator_biasprm"][actuator, 1:3] * gear**2
