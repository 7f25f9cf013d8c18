"""What the planar robots of Gymnasium share: run along x, at little effort."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco

from garat_jax.dynamics import PhysicsState
from garat_jax.env import Task

ASSETS = Path(__file__).parent / "assets"


@dataclasses.dataclass(frozen=True)
class PlanarRunner(Task):
    """Run forward in the plane; positions are x, z [m] and pitch [rad] of the torso, then joints.

    Observation: all positions but x, then all velocities within ±`fastest`. Reward: forward speed
    [m/s], plus `alive_reward`, less `effort_cost` times the squared norm of the action. As in
    Gymnasium's v4 environments the step that ends an episode pays like any other.

    Attributes:
        control_seconds: Length of a control step.
        reset_noise: Scale of the initial distribution.
        alive_reward: Reward for every step.
        effort_cost: What a unit of squared action costs.
        fastest: Bound of the observed velocities.
    """

    mjcf: Path
    num_substeps: int
    solved_return: float
    reset_noise: float
    alive_reward: float
    effort_cost: float
    fastest: float
    control_seconds: float = dataclasses.field(kw_only=True)
    episode_length: int = 1000

    def initial(self, host: mujoco.MjModel, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Draw positions and velocities near rest, uniformly."""
        scale = self.reset_noise
        noise = jax.random.uniform(key, (host.nq + host.nv,), minval=-scale, maxval=scale)
        return jnp.asarray(host.qpos0, noise.dtype) + noise[: host.nq], noise[host.nq :]

    def observe(self, state: PhysicsState) -> jax.Array:
        """Return positions without x, and bounded velocities, [nq - 1 + nv]."""
        velocity = jnp.clip(state.qvel, -self.fastest, self.fastest)
        return jnp.concatenate([state.qpos[1:], velocity])

    def reward(self, before: PhysicsState, action: jax.Array, after: PhysicsState) -> jax.Array:
        """Return forward speed and the reward for being alive, less the cost of the action."""
        speed = (after.qpos[0] - before.qpos[0]) / self.control_seconds
        return speed + self.alive_reward - self.effort_cost * jnp.square(action).sum()
