"""Minitaur: a quadruped with eight direct-drive motors and five-bar legs, to walk forward."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from garat_jax.dynamics import PhysicsState
from garat_jax.env import Task
from garat_jax.envs.rotation import uprightness

ENERGY_COST = 0.001
"""Metres that a joule costs: 0.005 for the energy of one of the five physics steps."""
LOWEST = 0.13
"""Height of the base [m] below which the robot counts as fallen."""
LEAST_UPRIGHT = 0.85
"""Cosine of the base's lean below which the robot counts as fallen."""
UPPER_LEG, LOWER_LEG = 0.115, 0.2
"""Lengths [m] between the joints of a leg."""
SPLAY = np.pi / 2
"""Angle [rad] of both motors of a leg in the reference pose, from straight up."""
RESET_NOISE = 0.1
"""Half-width [rad] of a leg's initial extension and swing."""
MOTORS = np.arange(8) * 2
"""Where the motors are among the hinges; each is followed by its knee."""


@dataclasses.dataclass(frozen=True)
class Minitaur(Task):
    """Walk along x on four five-bar legs; PyBullet's MinitaurBulletEnv, see SOURCES.md.

    Observation, [28]: angle [rad], rate [rad/s] and torque [N m] of each motor, and the base's
    orientation as a quaternion w, x, y, z. Action: the motors' desired angles, -1 to 1 for 5π/8 ∓
    π/4 rad from straight up, growing towards the ground; for the legs front left, back left, front
    right and back right, each first the link that points ahead, then the one that points behind.
    Reward: distance along x [m] less 0.001 times the energy [J] that the motors give or take. An
    episode ends when the base is below 0.13 m or leans by more than 32°. A control step is 0.01 s.
    """

    mjcf: Path = Path(__file__).parent / "assets" / "minitaur.xml"
    num_substeps: int = 5
    control_seconds: float = 0.01
    episode_length: int = 1000
    solved_return: float = 5.0  # see SOURCES.md

    def initial(self, host: mujoco.MjModel, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Draw each leg's extension and swing around the reference pose, with the legs closed."""
        shape, noise = (2, 4), RESET_NOISE
        extension, swing = jax.random.uniform(key, shape, minval=-noise, maxval=noise)
        ahead, behind = SPLAY + extension + swing, SPLAY + extension - swing
        knee = knee_angle(SPLAY + extension)
        legs = jnp.stack([ahead, knee, behind, knee], axis=1).ravel()
        return jnp.concatenate([jnp.asarray(host.qpos0[:7], legs.dtype), legs]), jnp.zeros(host.nv)

    def observe(self, state: PhysicsState) -> jax.Array:
        """Return the motors' state and the base's orientation, [28]."""
        motors = [state.qpos[7 + MOTORS], state.qvel[6 + MOTORS], state.sensordata]
        return jnp.concatenate([*motors, state.qpos[3:7]])

    def reward(self, before: PhysicsState, action: jax.Array, after: PhysicsState) -> jax.Array:
        """Return the distance along x, less the cost of the energy."""
        del action
        power = jnp.abs(jnp.dot(after.sensordata, after.qvel[6 + MOTORS]))
        distance = after.qpos[0] - before.qpos[0]
        return distance - ENERGY_COST * power * self.control_seconds

    def terminated(self, after: PhysicsState) -> jax.Array:
        """Say whether the robot has fallen; a state that is not finite has."""
        finite = jnp.isfinite(after.qpos).all() & jnp.isfinite(after.qvel).all()
        upright = uprightness(after.qpos[3:7]) >= LEAST_UPRIGHT
        return ~(finite & upright & (after.qpos[2] >= LOWEST))


def knee_angle(extension: jax.Array) -> jax.Array:
    """Return the angle [rad] of both knees that closes a leg, 0 in the reference pose.

    Both upper legs lean `extension` rad from the leg's axis, and the foot is on that axis: the sine
    of a lower leg's lean is that of the upper's times the ratio of their lengths.
    """

    def angle(upper: jax.Array) -> jax.Array:
        return jnp.arcsin(UPPER_LEG / LOWER_LEG * jnp.sin(upper)) - upper

    return angle(extension) - angle(jnp.asarray(SPLAY))
