"""InvertedPendulum: keep a pole upright on a cart."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco

from garat_jax.dynamics import PhysicsState
from garat_jax.env import Task

RESET_NOISE = 0.01
"""Half-width of the initial distribution of every position and velocity."""
FALLEN = 0.2
"""Pole angle [rad] beyond which the pole counts as fallen."""


@dataclasses.dataclass(frozen=True)
class InvertedPendulum(Task):
    """Keep a pole upright on a cart; Gymnasium's InvertedPendulum-v4.

    Observation: cart position [m], pole angle [rad], and their rates. Action: force on the cart in
    units of 100 N, -3 to 3. Reward: 1 a step. An episode ends when the pole leans by more than
    0.2 rad. A control step is 0.04 s.
    """

    mjcf: Path = Path(__file__).parent / "assets" / "inverted_pendulum.xml"
    num_substeps: int = 2
    episode_length: int = 1000
    solved_return: float = 950.0  # Gymnasium's reward threshold

    def initial(self, host: mujoco.MjModel, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Draw a state near rest, uniformly."""
        noise = jax.random.uniform(
            key, (host.nq + host.nv,), minval=-RESET_NOISE, maxval=RESET_NOISE
        )
        return noise[: host.nq], noise[host.nq :]

    def observe(self, state: PhysicsState) -> jax.Array:
        """Return positions and velocities, [4]."""
        return jnp.concatenate([state.qpos, state.qvel])

    def reward(self, before: PhysicsState, action: jax.Array, after: PhysicsState) -> jax.Array:
        """Return 1 for every step."""
        del before, action
        return jnp.ones((), after.qpos.dtype)

    def terminated(self, after: PhysicsState) -> jax.Array:
        """Say whether the pole has fallen; a state that is not finite has."""
        finite = jnp.isfinite(after.qpos).all() & jnp.isfinite(after.qvel).all()
        return ~(finite & (jnp.abs(after.qpos[1]) <= FALLEN))
