"""Hopper: hop forward on one leg."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp

from garat_jax.dynamics import PhysicsState
from garat_jax.envs.planar import ASSETS, PlanarRunner

LOWEST = 0.7
"""Torso height [m] below which the robot counts as fallen."""
STEEPEST = 0.2
"""Torso pitch [rad] beyond which the robot counts as fallen."""
LARGEST = 100.0
"""Bound of every position but x and of every velocity."""


@dataclasses.dataclass(frozen=True)
class Hopper(PlanarRunner):
    """Hop forward on one leg; Gymnasium's Hopper-v4.

    Observation: see `PlanarRunner`, [11]. Action: torques at hip, knee and ankle in units of
    200 N m, -1 to 1. Reward: forward speed [m/s] + 1 - 0.001 |a|². An episode ends when the torso
    is below 0.7 m or leans by more than 0.2 rad. A control step is 0.008 s.
    """

    mjcf: Path = ASSETS / "hopper.xml"
    num_substeps: int = 4
    control_seconds: float = 0.008
    solved_return: float = 2500.0  # see SOURCES.md
    reset_noise: float = 5e-3
    alive_reward: float = 1.0
    effort_cost: float = 1e-3
    fastest: float = 10.0

    def terminated(self, after: PhysicsState) -> jax.Array:
        """Say whether the robot has fallen; a state that is not finite has."""
        bounded = jnp.abs(jnp.concatenate([after.qpos[2:], after.qvel])) < LARGEST
        height, pitch = after.qpos[1], after.qpos[2]
        return ~(bounded.all() & (height > LOWEST) & (jnp.abs(pitch) < STEEPEST))
