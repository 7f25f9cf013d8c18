"""Velocities from measured positions, of every kind of joint."""

import mujoco
import numpy as np

from garat_jax.diagnosis.continuous import with_continuous_quaternions
from garat_jax.diagnosis.filters import local_slope
from garat_jax.effects.elements import DOFS_OF_JOINT


def estimate_velocity(model: mujoco.MjModel, time: np.ndarray, qpos: np.ndarray) -> np.ndarray:
    """Estimate velocities from positions, by `filters.local_slope`.

    Apply it to simulated positions too wherever estimated velocities are compared.

    Args:
        model: The model, for ball and free joints: their angular velocity is in the body's frame.
        time: Seconds, increasing, [T].
        qpos: Positions, [T, nq].

    Returns:
        Velocities, [T, nv].
    """
    qpos = with_continuous_quaternions(model, qpos)
    slope = local_slope(time, qpos)
    velocity = np.zeros((len(time), model.nv))
    for joint in range(model.njnt):
        position, dof = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
        dofs = DOFS_OF_JOINT[int(model.jnt_type[joint])]
        straight = dofs - 3 if dofs > 1 else 1
        velocity[:, dof : dof + straight] = slope[:, position : position + straight]
        if dofs > 1:
            at = slice(position + straight, position + straight + 4)
            velocity[:, dof + straight : dof + dofs] = _angular_velocity(qpos[:, at], slope[:, at])
    return velocity


def _angular_velocity(quaternion: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Return twice the vector part of conj(q) dq/dt, [T, 3]."""
    w, x, y, z = quaternion.T
    rows = np.stack([[-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]])
    return 2 * np.einsum("ijt,tj->ti", rows, slope)
