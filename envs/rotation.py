"""Orientations as MuJoCo gives them: unit quaternions w, x, y, z."""

import jax
import jax.numpy as jnp


def roll_pitch_yaw(quaternion: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the angles [rad] about the fixed x, y and z axes that a quaternion [4] turns by."""
    w, x, y, z = quaternion
    roll = jnp.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = jnp.arcsin(jnp.clip(2 * (w * y - z * x), -1, 1))
    yaw = jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return roll, pitch, yaw


def uprightness(quaternion: jax.Array) -> jax.Array:
    """Return the cosine [] of the angle between a body's z axis and the world's."""
    _, x, y, _ = quaternion
    return 1 - 2 * (x * x + y * y)
