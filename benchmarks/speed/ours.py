"""Our own sides: TRPO, PPO, random actions in the same loop, and C MuJoCo without any loop."""

import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.batch import Batch

from garat_jax import devices, rollout
from garat_jax.agents import ppo, trpo
from garat_jax.agents.ppo import PPOConfig
from garat_jax.agents.trpo import TRPOConfig
from garat_jax.compiler_options import compiler_options
from garat_jax.env import Env, World
from garat_jax.types import Agent

from .sides import ENGINE_ALONE, RANDOM, Side

FIFTH = "trpo, Fisher from a fifth"
"""Our TRPO with the Fisher information estimated on every fifth step, as stable-baselines does."""


class Size(NamedTuple):
    """How much of an environment is stepped at once.

    Attributes:
        num_seeds: Learners.
        num_envs: Environments of each.
        num_steps: Steps of each environment in an iteration.
        iterations: Iterations in a timed run.
    """

    num_seeds: int
    num_envs: int
    num_steps: int
    iterations: int


def random_agent(env: Env, num_envs: int, num_steps: int) -> Agent:
    """Return an agent that acts at random and never learns."""
    low, high = jnp.asarray(env.action_low), jnp.asarray(env.action_high)

    def policy(params, obs: jax.Array, key: jax.Array):
        del params, obs
        return jax.random.uniform(key, low.shape, minval=low, maxval=high), jnp.zeros(())

    def init(key: jax.Array, env_params):
        reset_key, key = jax.random.split(key)
        return rollout.reset(env, env_params, reset_key, num_envs), key

    def step(state, env_params):
        env_state, key = state
        key, unroll_key = jax.random.split(key)
        env_state, transitions, _ = rollout.unroll(
            env, env_params, policy, (), env_state, unroll_key, num_steps
        )
        return (env_state, key), {"reward": transitions.reward.mean()}, transitions

    return Agent(init, step, policy, lambda params, obs: low, num_envs * num_steps)


def make_agent(name: str, env: Env, size: Size) -> Agent:
    """Build one of our learners; TRPO is as in the presets but for the size and `FIFTH`."""
    if name == RANDOM:
        return random_agent(env, size.num_envs, size.num_steps)
    if name in ("trpo", FIFTH):
        share = 0.2 if name == FIFTH else TRPOConfig.fisher_share
        return trpo.make(env, TRPOConfig(size.num_envs, size.num_steps, fisher_share=share))
    return ppo.make(env, PPOConfig(size.num_envs, size.num_steps))


def make_side(name: str, env_name: str, world: World, size: Size) -> Side:
    """Compile an agent's iteration for a number of seeds, and take one to warm up."""
    agent = make_agent(name, world.env, size)
    options = compiler_options(world.params)
    keys = jax.vmap(jax.random.key)(jnp.arange(size.num_seeds))
    state = jax.jit(jax.vmap(agent.init, (0, None)), compiler_options=options)(keys, world.params)

    def iterate(state):
        state, metrics, _ = jax.vmap(agent.step, (0, None))(state, world.params)
        return state, metrics

    started, busy = time.perf_counter(), time.process_time()
    compiled = jax.jit(iterate, compiler_options=options).lower(state).compile()
    seconds, busy = time.perf_counter() - started, time.process_time() - busy
    held = [jax.block_until_ready(compiled(state))[0]]

    def run() -> None:
        for _ in range(size.iterations):
            held[0] = compiled(held[0])[0]
        jax.block_until_ready(held[0])

    row = {
        "env": env_name,
        "agent": name,
        "engine": world.params.engine,
        "seeds": size.num_seeds,
        "envs": size.num_envs,
        "steps": size.num_steps,
        "compile_seconds": seconds,
        "compile_processor_seconds": busy,
    }
    return Side(row, run, size.num_seeds * agent.steps_per_iteration * size.iterations)


def engine_alone(env_name: str, world: World, size: Size) -> Side:
    """Step C MuJoCo in its own batch, from states and with actions that random actions gave.

    No policy, reward, reset or program is around it: what the engine gives on this machine.
    """
    host = world.params.host.model
    states, controls = _random_states(world, size)
    batch = Batch(host, states.shape[1], nthread=devices.num_cores())
    views = [batch.bind(name) for name in ("qpos", "qvel", "ctrl")]
    split = np.split(states, [host.nq], axis=2)
    inputs = [(*(part[t] for part in split), controls[t]) for t in range(len(states))]

    def run() -> None:
        for _ in range(size.iterations):
            for values in inputs:
                for view, value in zip(views, values, strict=True):
                    view[:] = value
                batch.step(None, nstep=world.env.task.num_substeps)

    run()
    row: dict[str, Any] = {
        "env": env_name,
        "agent": ENGINE_ALONE,
        "engine": "mujoco",
        "seeds": size.num_seeds,
        "envs": size.num_envs,
        "steps": size.num_steps,
        "mujoco": mujoco.__version__,
    }
    return Side(row, run, states.shape[0] * states.shape[1] * size.iterations)


def _random_states(world: World, size: Size) -> tuple[np.ndarray, np.ndarray]:
    """Return states [T, B, nq + nv] and commands [T, B, nu] of episodes with random actions."""
    num_envs = size.num_seeds * size.num_envs
    agent = random_agent(world.env, num_envs, size.num_steps)

    def record(key):
        return rollout.record(
            world.env, world.params, agent.policy, (), key, num_envs, size.num_steps
        )

    recorded = jax.jit(record)(jax.random.key(0))
    physics = recorded.states.physics
    states = np.concatenate([physics.qpos, physics.qvel], axis=2).astype(np.float64)
    return states, np.asarray(recorded.transitions.action, np.float64)
