"""HalfCheetah: run forward on two springy legs, in the plane."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco

from garat_jax.dynamics import PhysicsState
from garat_jax.envs.planar import ASSETS, PlanarRunner


@dataclasses.dataclass(frozen=True)
class HalfCheetah(PlanarRunner):
    """Run forward on two springy legs; Gymnasium's HalfCheetah-v4.

    Observation: see `PlanarRunner`, with velocities as they are, [17]. Action: torques at hip, knee
    and ankle of the back leg (in units of 120, 90 and 60 N m), then of the front leg (120, 60 and
    30 N m), -1 to 1. Reward: forward speed [m/s] - 0.1 |a|². An episode only ends when the state is
    not finite any more. A control step is 0.05 s.
    """

    mjcf: Path = ASSETS / "half_cheetah.xml"
    num_substeps: int = 5
    control_seconds: float = 0.05
    solved_return: float = 1785.0  # see SOURCES.md
    reset_noise: float = 0.1
    alive_reward: float = 0.0
    effort_cost: float = 0.1
    fastest: float = float("inf")

    def initial(self, host: mujoco.MjModel, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Draw positions uniformly and velocities normally near rest."""
        qpos_key, qvel_key = jax.random.split(key)
        qpos, _ = super().initial(host, qpos_key)
        return qpos, self.reset_noise * jax.random.normal(qvel_key, (host.nv,))

    def terminated(self, after: PhysicsState) -> jax.Array:
        """Say whether the state is not finite."""
        return ~(jnp.isfinite(after.qpos).all() & jnp.isfinite(after.qvel).all())
