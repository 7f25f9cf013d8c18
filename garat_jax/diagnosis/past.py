"""What came before a segment: commands, and the motion that led to its start."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from garat_jax.diagnosis.segments import Grid
from garat_jax.effects import Effect

LEAD_IN = 1.0
"""Seconds of the motion before each segment that memories of it get."""


class Past(NamedTuple):
    """What came before segments.

    Attributes:
        ctrl: Command of every simulated step of all recordings, [R, T, nu].
        qvel: Measured velocity in the middle of each, [R, T, nv].
        act: Activation at the beginning of each, without candidates, [R, T, na].
        recording: Index of each segment's recording, [S].
        num_steps: How many of its steps came before the segment, [S].
    """

    ctrl: np.ndarray
    qvel: np.ndarray
    act: np.ndarray
    recording: np.ndarray
    num_steps: np.ndarray


def has_memory_of_motion(effects: Sequence[Effect], host: mujoco.MjModel) -> bool:
    """Say whether an effect has a memory of the motion, and not of commands alone."""
    return any(
        effect.notes or (effect.reads_state and bool(jax.tree.leaves(effect.init(host))))
        for effect in effects
    )


def activation_before(past: Past, num_before: int) -> jax.Array:
    """Return the activation so many steps before a segment, or where its recording begins, [na]."""
    return jnp.asarray(past.act)[past.recording, jnp.maximum(past.num_steps - num_before, 0)]


def lead_steps(grid: Grid) -> int:
    """Return the control steps of `LEAD_IN`."""
    return int(np.ceil(LEAD_IN / grid.interval))


def way_to(
    start: jax.Array, past: Past, host: mujoco.MjModel, grid: Grid, substeps: int
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return how a segment's start was reached, by control steps and their substeps.

    Before the recording, and where a joint has several dofs, the mechanism stays.

    Args:
        start: The state at the segment's start, [nq + nv].
        past: What came before it, of this segment alone.
        host: The compiled model.
        grid: The simulated steps.
        substeps: Substeps of a control step.

    Returns:
        Commands [n, nu], positions [n, substeps, nq] and velocities [n, substeps, nv] over
        `LEAD_IN`. Velocities are the measured ones, positions those that lead to the start at them.
    """
    num_steps = lead_steps(grid)
    steps = past.num_steps - np.arange(num_steps, 0, -1)
    rows = jnp.maximum(steps, 0)
    qvel = jnp.where(steps[:, None] >= 0, past.qvel[past.recording, rows], 0.0)
    qvel = jnp.repeat(qvel, substeps, axis=0).at[-1].set(start[host.nq :])
    goes = jnp.repeat(steps > 0, substeps)  # the recording's first velocity is no jump
    moves = jnp.where(goes[:, None], qvel * grid.interval / substeps, 0.0)
    ahead = jnp.cumsum(moves[::-1], axis=0)[::-1] - moves
    of_one_dof = host.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE)
    at, dof = host.jnt_qposadr[of_one_dof], host.jnt_dofadr[of_one_dof]
    qpos = jnp.broadcast_to(start[: host.nq], (len(moves), host.nq))
    qpos = qpos.at[:, at].add(-ahead[:, dof])
    shape = (num_steps, substeps, -1)
    ctrl = jnp.asarray(past.ctrl)[past.recording, rows]
    return ctrl, qpos.reshape(shape), qvel.reshape(shape)
