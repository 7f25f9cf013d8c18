"""What each part of an iteration of TRPO costs, compiled by itself on the same batch."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from garat_jax.agents import actor_critic, trpo
from garat_jax.agents.actor_critic import Batch
from garat_jax.agents.trpo import TRPOConfig
from garat_jax.compiler_options import compiler_options
from garat_jax.env import World
from garat_jax.networks import GaussianPolicy, ValueNet

from .ours import Size
from .sides import seconds_of

NAMES = {
    "rollout": "acting and stepping the environments",
    "advantages": "values, advantages, normalised observations",
    "policy": "the policy's step: gradient, conjugate gradient, line search, metrics",
    "direction": "of that, the conjugate gradient: products with the Fisher information",
    "value": "fitting the value network",
    "statistics": "running statistics of the observations",
}
"""The parts, and what is in each."""


def parts(env_name: str, world: World, size: Size, repetitions: int) -> dict[str, Any]:
    """Time the parts of an iteration in turns, and the iteration as a whole.

    Returns:
        Seconds of each of `NAMES` and of `iteration`, medians over the repetitions. The parts need
        not add up to the whole: XLA sees more at once there.
    """
    config = TRPOConfig(size.num_envs, size.num_steps)
    agent = trpo.make(world.env, config)
    keys = jax.vmap(jax.random.key)(jnp.arange(size.num_seeds))
    options = compiler_options(world.params)
    state = jax.jit(jax.vmap(agent.init, (0, None)), compiler_options=options)(keys, world.params)
    programs = _programs(world, agent, config)

    def compiled(name: str, *arguments: Any) -> tuple[Callable[[], Any], Any]:
        jitted = jax.jit(jax.vmap(programs[name]), compiler_options=options)
        program = jitted.lower(*arguments).compile()
        result = jax.block_until_ready(program(*arguments))
        return lambda: jax.block_until_ready(program(*arguments)), result

    calls = {}
    calls["iteration"], state = compiled("iteration", state)
    calls["rollout"], (state, transitions) = compiled("rollout", state)
    calls["advantages"], batch = compiled("advantages", state, transitions)
    weights = state.policy.weights
    calls["direction"], _ = compiled("direction", weights, batch)
    calls["policy"], _ = compiled("policy", weights, batch)
    calls["value"], _ = compiled("value", state.value, state.optimiser, batch, state.key)
    calls["statistics"], _ = compiled("statistics", state, transitions)
    taken = [[seconds_of(call)[0] for call in calls.values()] for _ in range(repetitions)]
    seconds = dict(zip(calls, np.median(taken, axis=0).tolist(), strict=True))
    return {
        "env": env_name,
        "engine": world.params.engine,
        "seeds": size.num_seeds,
        "envs": size.num_envs,
        "steps": size.num_steps,
        "seconds": {name: seconds[name] for name in (*NAMES, "iteration")},
    }


def _programs(world: World, agent, config: TRPOConfig) -> dict[str, Callable]:
    """Return the parts as functions of one seed."""
    env, params = world.env, world.params
    policy_net = GaussianPolicy(env.action_size, config.hidden, config.initial_log_std)
    value_net = ValueNet(config.hidden)

    def direction(weights, batch: Batch) -> jax.Array:
        flat, unflatten = ravel_pytree(weights)
        seen = batch.obs[trpo.spread(batch.obs.shape[0], config.fisher_share)]
        product = trpo.fisher_vector_product(policy_net, flat, unflatten, seen, config.cg_damping)
        found = trpo.conjugate_gradient(product, jnp.ones_like(flat), config.cg_iterations)
        return found @ product(found)

    return {
        "iteration": lambda state: agent.step(state, params)[0],
        "rollout": lambda state: actor_critic.collect(
            env, params, agent.policy, state, config.num_steps
        ),
        "advantages": lambda state, transitions: actor_critic.prepare(
            env, value_net, state, transitions, config.discount, config.trace
        ),
        "direction": direction,
        "policy": lambda weights, batch: trpo.policy_step(policy_net, weights, batch, config),
        "value": lambda value, optimiser, batch, key: trpo.fit_value(
            value_net, value, optimiser, batch, key, config
        ),
        "statistics": lambda state, transitions: actor_critic.observe(env, state, transitions),
    }
