"""Ant: walk forward on four legs."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from garat_jax.dynamics import PhysicsState
from garat_jax.env import Task
from garat_jax.envs.rotation import roll_pitch_yaw

HEIGHT = 0.6
"""Initial height of the torso [m], at which the feet are just above the ground."""
LOWEST = 0.26
"""Torso height [m] below which the robot counts as fallen; the ball's radius is 0.25 m."""
HIP, ANKLE = (-40.0, 40.0), (30.0, 100.0)
RANGES = np.radians([HIP, ANKLE, HIP, (-100.0, -30.0), HIP, (-100.0, -30.0), HIP, ANKLE])
"""Ranges of the joints, as in the model, [8, 2]."""
BENT = np.asarray([0.0, 1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0])
"""Joint angles [rad] around which an episode starts."""
RESET_NOISE = 0.1
POWER_COST, EFFORT_COST, LIMIT_COST = 2.0, 0.1, 0.1
FARTHEST = 5.0
"""Bound of every observation."""


@dataclasses.dataclass(frozen=True)
class Ant(Task):
    """Walk along x on four legs, in the spirit of PyBullet's AntBulletEnv; see SOURCES.md.

    Observation, [28], within ±5: height above the initial one, sine and cosine of the angle to the
    target, velocity in the torso's heading (times 0.3), roll and pitch; then for hip and ankle of
    each leg the angle in units of its range (±1) and the rate (times 0.1); then which feet touch
    the ground. Action: torques at hip and ankle of the legs front left, front right, back left and
    back right in units of 150 N m, -1 to 1. Reward: 1, or -1 for a fall, + speed along x [m/s] -
    2 mean|a·0.1·rate| - 0.1 mean a² - 0.1 for each joint at its limit. An episode ends when the
    torso is below 0.26 m. A control step is 0.0165 s.
    """

    mjcf: Path = Path(__file__).parent / "assets" / "ant.xml"
    num_substeps: int = 4
    control_seconds: float = 0.0165
    episode_length: int = 1000
    solved_return: float = 2500.0  # see SOURCES.md

    def initial(self, host: mujoco.MjModel, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Draw joint angles around the bent pose, uniformly; all else is at rest."""
        noise = jax.random.uniform(key, BENT.shape, minval=-RESET_NOISE, maxval=RESET_NOISE)
        root = jnp.asarray([0.0, 0.0, HEIGHT, 1.0, 0.0, 0.0, 0.0], noise.dtype)
        return jnp.concatenate([root, BENT + noise]), jnp.zeros(host.nv, noise.dtype)

    def observe(self, state: PhysicsState) -> jax.Array:
        """Return pose, joints and contacts, [28]."""
        roll, pitch, yaw = roll_pitch_yaw(state.qpos[3:7])
        vx, vy, vz = state.qvel[:3]
        cosine, sine = jnp.cos(yaw), jnp.sin(yaw)
        speed = 0.3 * jnp.stack([cosine * vx + sine * vy, cosine * vy - sine * vx, vz])
        pose = jnp.stack([state.qpos[2] - HEIGHT, -sine, cosine, *speed, roll, pitch])
        joints = jnp.stack([_relative(state), 0.1 * state.qvel[6:]], axis=1).ravel()
        contacts = (state.sensordata > 0).astype(pose.dtype)
        return jnp.clip(jnp.concatenate([pose, joints, contacts]), -FARTHEST, FARTHEST)

    def reward(self, before: PhysicsState, action: jax.Array, after: PhysicsState) -> jax.Array:
        """Return progress and the reward for being alive, less the costs of the motors."""
        progress = (after.qpos[0] - before.qpos[0]) / self.control_seconds
        alive = jnp.where(after.qpos[2] > LOWEST, 1.0, -1.0)
        power = jnp.abs(action * 0.1 * after.qvel[6:]).mean()
        at_limit = (jnp.abs(_relative(after)) > 0.99).sum()
        cost = POWER_COST * power + EFFORT_COST * jnp.square(action).mean() + LIMIT_COST * at_limit
        return alive + progress - cost

    def terminated(self, after: PhysicsState) -> jax.Array:
        """Say whether the robot has fallen; a state that is not finite has."""
        finite = jnp.isfinite(after.qpos).all() & jnp.isfinite(after.qvel).all()
        return ~(finite & (after.qpos[2] > LOWEST))


def _relative(state: PhysicsState) -> jax.Array:
    """Return the joint angles in units of their ranges: ±1 at the limits, [8]."""
    middle, half = RANGES.mean(axis=1), np.diff(RANGES, axis=1)[:, 0] / 2
    return (state.qpos[7:] - middle) / half
