"""How a body's centre of mass moves, in JAX, for laws that act there.

It reads a `ModelView`, so it serves both engines and follows what other effects change, and it
walks one chain of bodies alone, which is cheap enough for every substep.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from garat_jax.effects.base import ModelView

CROSS = np.zeros((3, 3, 3))
CROSS[[0, 1, 2], [1, 2, 0], [2, 0, 1]] = -1.0
CROSS[[0, 1, 2], [2, 0, 1], [1, 2, 0]] = 1.0
"""`CROSS @ v` is the matrix of the cross product with v, seen from the left."""


def centre_of_mass_jacobian(model: ModelView, body: int, qpos: jax.Array) -> jax.Array:
    """Return the Jacobian of a body's centre of mass, [3, nv].

    Args:
        model: The model as the effects leave it.
        body: Index of the body.
        qpos: Positions, [nq].
    """
    host, chain = model.host, []
    while body:
        chain.append(body)
        body = int(host.body_parentid[body])
    pos, frame = jnp.zeros(3, qpos.dtype), jnp.eye(3, dtype=qpos.dtype)
    turns, jacobian = [], jnp.zeros((3, host.nv), qpos.dtype)
    for body in reversed(chain):
        pos = pos + frame @ model["body_pos"][body]
        frame = frame @ rotation(model["body_quat"][body])
        start = host.body_jntadr[body]
        for joint in range(start, start + host.body_jntnum[body]):
            kind, dof = host.jnt_type[joint], int(host.jnt_dofadr[joint])
            if kind == mujoco.mjtJoint.mjJNT_FREE:
                jacobian = jacobian.at[:, dof : dof + 3].set(jnp.eye(3))
            elif kind == mujoco.mjtJoint.mjJNT_SLIDE:
                jacobian = jacobian.at[:, dof].set(frame @ model["jnt_axis"][joint])
            anchor, pos, frame = _past_joint(model, joint, pos, frame, qpos)
            turns += [(*turn, anchor) for turn in _turns(model, joint, frame)]
    if not turns:
        return jacobian
    dofs, axes, anchors = zip(*turns, strict=True)
    arms = pos + frame @ model["body_ipos"][chain[0]] - jnp.stack(anchors)
    return jacobian.at[:, list(dofs)].set(jnp.cross(jnp.stack(axes), arms).T)


def rotation(quat: jax.Array) -> jax.Array:
    """Return the matrix [3, 3] of a unit quaternion [4], real part first."""
    real, v = quat[0], quat[1:]
    return (real**2 - v @ v) * jnp.eye(3) + 2.0 * (jnp.outer(v, v) + real * (CROSS @ v))


def _past_joint(model: ModelView, joint: int, pos, frame, qpos):
    """Return a joint's anchor [3], and place [3] and orientation [3, 3] behind it."""
    host, kinds = model.host, mujoco.mjtJoint
    kind, address = host.jnt_type[joint], host.jnt_qposadr[joint]
    if kind == kinds.mjJNT_FREE:
        pos = qpos[address : address + 3]
        return pos, pos, rotation(_unit(qpos[address + 3 : address + 7]))
    axis, place = model["jnt_axis"][joint], model["jnt_pos"][joint]
    anchor = pos + frame @ place
    if kind == kinds.mjJNT_BALL:
        after = frame @ rotation(_unit(qpos[address : address + 4]))
    else:
        travel = qpos[address] - model["qpos0"][address]
        if kind == kinds.mjJNT_SLIDE:
            return anchor, pos + frame @ axis * travel, frame
        half = travel / 2
        turn = jnp.concatenate([jnp.cos(half)[None], jnp.sin(half) * axis])
        after = frame @ rotation(turn)
    return anchor, anchor - after @ place, after


def _turns(model: ModelView, joint: int, frame: jax.Array) -> list[tuple[int, jax.Array]]:
    """Return the dofs of a joint that turn what is behind it, with their axes in the world [3].

    Those of ball and free joints are the axes of the body's own frame.
    """
    kind, dof = model.host.jnt_type[joint], int(model.host.jnt_dofadr[joint])
    if kind == mujoco.mjtJoint.mjJNT_SLIDE:
        return []
    if kind == mujoco.mjtJoint.mjJNT_HINGE:
        return [(dof, frame @ model["jnt_axis"][joint])]
    first = dof + 3 if kind == mujoco.mjtJoint.mjJNT_FREE else dof
    return [(first + i, frame[:, i]) for i in range(3)]


def _unit(quat: jax.Array) -> jax.Array:
    return quat / jnp.linalg.norm(quat)
