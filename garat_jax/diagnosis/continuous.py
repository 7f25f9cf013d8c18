"""Measured rotations without the jumps of how they are written: ±q of a quaternion, ±π of an angle.

A quaternion and its negative are one rotation, and loggers that keep w ≥ 0 change its sign on the
way. Encoders of a joint that turns round and round begin anew after a turn.
"""

from collections.abc import Sequence

import mujoco
import numpy as np

from garat_jax.effects.elements import quaternions

TURN = 2 * np.pi
WRITTEN_OVER = 1.05
"""Turns that a wrapped angle is written over, at most: one, and noise."""
JUMP = 0.75
"""Turns that it jumps between two samples, at least."""
NOT_UNIT = 0.01
"""Difference of a norm from 1 beyond which four numbers are no rotation."""


def with_continuous_quaternions(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Return positions [T, nq] with each quaternion's sign as in the sample before."""
    qpos = qpos.copy()
    for start in quaternions(model):
        there = slice(start, start + 4)
        qpos[:, there] = with_one_sign(qpos[:, there])
    return qpos


def is_rotation(quaternion: np.ndarray) -> np.ndarray:
    """Say of each of some quaternions, [T, 4], whether it is one of a rotation, [T] bool."""
    return np.abs(np.linalg.norm(quaternion, axis=1) - 1) <= NOT_UNIT


def with_one_sign(quaternion: np.ndarray) -> np.ndarray:
    """Return a quaternion over time, [T, 4], with its sign as in the sample before."""
    flips = np.sum(quaternion[1:] * quaternion[:-1], axis=1) < 0
    signs = np.cumprod(np.where(flips, -1.0, 1.0))
    return quaternion * np.concatenate([[1.0], signs])[:, None]


def wrapped_joints(
    model: mujoco.MjModel, qpos: np.ndarray, spans: Sequence[tuple[int, int]]
) -> list[int]:
    """List the hinges whose angle is written within one turn and jumps by most of it.

    Of those that can turn that far: a joint whose range is a turn or less does not wrap.

    Args:
        model: The model.
        qpos: Positions, [T, nq].
        spans: Index ranges [start, stop) without gaps, across which nothing jumps.
    """
    found = []
    for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE):
        low, high = model.jnt_range[joint]
        angle = qpos[:, model.jnt_qposadr[joint]]
        can_turn = not model.jnt_limited[joint] or high - low > TURN
        if can_turn and np.ptp(angle) <= WRITTEN_OVER * TURN:
            jumps = max(np.abs(np.diff(angle[a:b])).max() for a, b in spans)
            if jumps > JUMP * TURN:
                found.append(int(joint))
    return found


def unwrapped(model: mujoco.MjModel, qpos: np.ndarray, joints: Sequence[int]) -> np.ndarray:
    """Return positions [T, nq] in which the angles of some hinges count turns."""
    qpos = qpos.copy()
    places = model.jnt_qposadr[list(joints)]
    qpos[:, places] = np.unwrap(qpos[:, places], discont=JUMP * TURN, axis=0)
    return qpos
