"""Where a body's centre of mass is, in JAX, for laws that act there.

It reads a `ModelView`, so it serves both engines and follows what other effects change, and it
walks one chain of bodies alone, which is cheap enough for every substep.
"""

import jax
import jax.numpy as jnp
import mujoco

from garat_jax.effects.base import ModelView

IDENTITY = (1.0, 0.0, 0.0, 0.0)


def rotate(quat: jax.Array, vector: jax.Array) -> jax.Array:
    """Rotate a vector [3] by a unit quaternion [4], real part first."""
    w, axis = quat[0], quat[1:]
    twice = 2.0 * jnp.cross(axis, vector)
    return vector + w * twice + jnp.cross(axis, twice)


def multiply(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return the quaternion [4] of rotating by b and then by a."""
    real = a[0] * b[0] - a[1:] @ b[1:]
    return jnp.concatenate([real[None], a[0] * b[1:] + b[0] * a[1:] + jnp.cross(a[1:], b[1:])])


def centre_of_mass(
    model: ModelView, body: int, qpos: jax.Array, displacement: jax.Array
) -> jax.Array:
    """Return a body's centre of mass in the world [3] after a small displacement.

    Args:
        model: The model as the effects leave it.
        body: Index of the body.
        qpos: Positions, [nq].
        displacement: Of the degrees of freedom, [nv]; exact to first order at 0, which is what
            derivatives need.
    """
    host, chain = model.host, []
    while body:
        chain.append(body)
        body = int(host.body_parentid[body])
    pos, quat = jnp.zeros(3, qpos.dtype), jnp.asarray(IDENTITY, qpos.dtype)
    for body in reversed(chain):
        pos = pos + rotate(quat, model["body_pos"][body])
        quat = multiply(quat, model["body_quat"][body])
        start = host.body_jntadr[body]
        for joint in range(start, start + host.body_jntnum[body]):
            pos, quat = _past_joint(model, joint, pos, quat, qpos, displacement)
    return pos + rotate(quat, model["body_ipos"][chain[0]])


def _past_joint(model: ModelView, joint: int, pos, quat, qpos, displacement):
    """Return place [3] and orientation [4] behind a joint."""
    host, kinds = model.host, mujoco.mjtJoint
    kind, dof, address = host.jnt_type[joint], host.jnt_dofadr[joint], host.jnt_qposadr[joint]
    if kind == kinds.mjJNT_FREE:
        pos = qpos[address : address + 3] + displacement[dof : dof + 3]
        return pos, _turned(qpos[address + 3 : address + 7], displacement[dof + 3 : dof + 6])
    axis, anchor = model["jnt_axis"][joint], model["jnt_pos"][joint]
    if kind == kinds.mjJNT_BALL:
        turn = _turned(qpos[address : address + 4], displacement[dof : dof + 3])
    else:
        travel = qpos[address] - model["qpos0"][address] + displacement[dof]
        if kind == kinds.mjJNT_SLIDE:
            return pos + rotate(quat, axis) * travel, quat
        turn = jnp.concatenate([jnp.cos(travel / 2)[None], jnp.sin(travel / 2) * axis])
    after = multiply(quat, turn)
    return pos + rotate(quat, anchor) - rotate(after, anchor), after


def _turned(quat: jax.Array, rotation: jax.Array) -> jax.Array:
    """Return a unit quaternion [4] turned by a small rotation vector [3] in its own frame."""
    quat = quat / jnp.linalg.norm(quat)
    return quat + 0.5 * multiply(quat, jnp.concatenate([jnp.zeros(1, quat.dtype), rotation]))
