"""Walker2d: walk forward on two legs, in the plane."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp

from garat_jax.dynamics import PhysicsState
from garat_jax.envs.planar import ASSETS, PlanarRunner

LOWEST, HIGHEST = 0.8, 2.0
"""Torso heights [m] between which the robot is up."""
STEEPEST = 1.0
"""Torso pitch [rad] beyond which the robot counts as fallen."""


@dataclasses.dataclass(frozen=True)
class Walker2d(PlanarRunner):
    """Walk forward on two legs; Gymnasium's Walker2d-v4.

    Observation: see `PlanarRunner`, [17]. Action: torques at hip, knee and ankle of the right leg,
    then of the left, in units of 100 N m, -1 to 1. Reward: forward speed [m/s] + 1 - 0.001 |a|². An
    episode ends when the torso is not between 0.8 m and 2 m or leans by more than 1 rad. A control
    step is 0.008 s.
    """

    mjcf: Path = ASSETS / "walker2d.xml"
    num_substeps: int = 4
    control_seconds: float = 0.008
    solved_return: float = 2500.0  # see SOURCES.md
    reset_noise: float = 5e-3
    alive_reward: float = 1.0
    effort_cost: float = 1e-3
    fastest: float = 10.0

    def terminated(self, after: PhysicsState) -> jax.Array:
        """Say whether the robot has fallen; a state that is not finite has."""
        height, pitch = after.qpos[1], after.qpos[2]
        finite = jnp.isfinite(after.qpos).all() & jnp.isfinite(after.qvel).all()
        up = (height > LOWEST) & (height < HIGHEST) & (jnp.abs(pitch) < STEEPEST)
        return ~(finite & up)
