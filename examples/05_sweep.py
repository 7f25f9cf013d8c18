"""Which trust region learns fastest? Three KL bounds times four seeds, trained in one program."""

import jax
import jax.numpy as jnp

from garat_jax import make_world
from garat_jax.agents import trpo
from garat_jax.envs.inverted_pendulum import InvertedPendulum

ITERATIONS = 15
world = make_world(InvertedPendulum())
bounds = jnp.asarray([0.001, 0.01, 0.05])
keys = jax.random.split(jax.random.key(0), 4)


def train(max_kl: jax.Array, key: jax.Array) -> jax.Array:
    """Train one agent; return the mean steps of an episode in each iteration, [iterations]."""
    agent = trpo.make(world.env, trpo.TRPOConfig(num_envs=16, num_steps=50, max_kl=max_kl))

    def step(state, _):
        state, metrics, _ = agent.step(state, world.params)
        return state, metrics["episode_length"]

    return jax.lax.scan(step, agent.init(key, world.params), length=ITERATIONS)[1]


over_seeds = jax.vmap(train, (None, 0))
lengths = jax.jit(jax.vmap(over_seeds, (0, None)))(bounds, keys)  # [bounds, seeds, iterations]
for bound, last in zip(bounds, lengths[:, :, -1], strict=True):
    print(f"KL at most {bound:g}: {last.mean():.0f} steps an episode, seeds {last.round()}")
