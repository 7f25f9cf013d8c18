"""Constants that MuJoCo derives from a model's masses and inertias, in JAX.

MuJoCo's compiler scales constraints by inverse weights at the reference pose; a mass that
is changed on the MJX model leaves them stale. `set_const` recomputes those that MJX 3.17 reads, as
`mj_setConst` does. It reads neither `dof_M0` nor `stat.meaninertia`: these stay as compiled.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from garat_jax._mjx import mjx

CONSTANT_INPUTS = frozenset(
    {"body_mass", "body_inertia", "body_ipos", "body_iquat", "body_pos", "body_quat"}
    | {"dof_armature"}
)
"""Fields whose change calls for `set_const`."""


def set_const(model: mjx.Model, host: mujoco.MjModel) -> mjx.Model:
    """Return the model with subtree masses, inverse weights and muscles that fit its masses.

    Args:
        model: The MJX model with changed fields.
        host: The compiled model it came from: sizes and addresses.
    """
    data = mjx.make_data(host).replace(qpos=model.qpos0)
    data = mjx.kinematics(model, data)
    data = mjx.com_pos(model, data)
    data = mjx.tendon(model, data)
    data = mjx.crb(model, data)
    data = mjx.tendon_armature(model, data)
    inverse = jnp.linalg.inv(mjx.full_m(model, data)) if host.nv else jnp.zeros((0, 0))
    return model.replace(
        body_subtreemass=_subtree_mass(model.body_mass, host),
        dof_invweight0=_average(jnp.diagonal(inverse), host),
        body_invweight0=_body_inverse_weight(model, data, inverse, host),
        tendon_invweight0=_tendon_inverse_weight(data, inverse),
        actuator_acc0=_actuator_acceleration(model, data, inverse),
    )


def _subtree_mass(mass: jax.Array, host: mujoco.MjModel) -> jax.Array:
    below = np.eye(host.nbody)
    for body in range(host.nbody - 1, 0, -1):
        below[host.body_parentid[body]] += below[body]
    return jnp.asarray(below, mass.dtype) @ mass


def _average(diagonal: jax.Array, host: mujoco.MjModel) -> jax.Array:
    """Average over a ball joint's three dofs, and a free joint's translations and rotations."""
    average = np.eye(host.nv)
    for joint in range(host.njnt):
        start = host.jnt_dofadr[joint]
        if host.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            blocks = (start, start + 3)
        elif host.jnt_type[joint] == mujoco.mjtJoint.mjJNT_BALL:
            blocks = (start,)
        else:
            blocks = ()
        for first in blocks:
            average[first : first + 3, first : first + 3] = 1 / 3
    return jnp.asarray(average, diagonal.dtype) @ diagonal


def _body_inverse_weight(model, data, inverse: jax.Array, host: mujoco.MjModel) -> jax.Array:
    """Return the mean of diag(J M^-1 J^T) for translation and rotation, [nbody, 2]."""

    def weights(point: jax.Array, body: jax.Array) -> jax.Array:
        translation, rotation = mjx.jac(model, data, point, body)
        return jnp.stack([jnp.trace(J.T @ inverse @ J) / 3 for J in (translation, rotation)])

    moving = jnp.asarray(host.body_weldid > 0)
    all_weights = jax.vmap(weights)(data.xipos, jnp.arange(host.nbody))
    return jnp.where(moving[:, None], all_weights, 0.0)


def _tendon_inverse_weight(data, inverse: jax.Array) -> jax.Array:
    """Return J M^-1 J^T of each tendon, [ntendon]."""
    J = data._impl.ten_J
    return jnp.einsum("ti,ij,tj->t", J, inverse, J)


def _actuator_acceleration(model, data, inverse: jax.Array) -> jax.Array:
    """Return the acceleration of a unit force of each actuator, which scales muscles, [nu]."""
    moment = mjx.transmission(model, data)._impl.actuator_moment
    return jnp.linalg.norm(moment @ inverse, axis=1)
