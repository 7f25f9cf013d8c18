"""Measure environment steps a second with learning in them, beside what the physics alone gives.

`python benchmarks/throughput.py`: an iteration of TRPO and of PPO with the presets' settings, and
the same number of steps of the same environments with random actions, compiled first and then run
in turns.
"""

import dataclasses
import os
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from record import write_result

from garat_jax import rollout
from garat_jax.agents import ppo, trpo
from garat_jax.agents.ppo import PPOConfig
from garat_jax.agents.trpo import TRPOConfig
from garat_jax.compiler_options import compiler_options
from garat_jax.env import Env, World, make_world
from garat_jax.envs import ENVS
from garat_jax.errors import choose
from garat_jax.types import Agent


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measure environment steps a second including learning."""

    env: str = "inverted_pendulum"
    """The environment."""
    repetitions: int = 5
    """Timed runs of each program; the median counts."""


@dataclasses.dataclass(frozen=True)
class Size:
    """How much one engine has to do: MJX on a CPU is slow, and gets less."""

    engine: str
    num_seeds: tuple[int, ...]
    num_envs: int
    num_steps: int


SIZES = (Size("mujoco", (1, 5), 50, 100), Size("mjx", (1,), 50, 20))
"""50 environments and 100 steps a batch are the presets'."""
ITERATIONS = 5
"""Iterations in a timed run."""


class Program(NamedTuple):
    """A compiled program that goes from a state to the next, and what to report of it."""

    row: dict[str, Any]
    step: Callable[[Any], Any]
    state: Any
    env_steps: int


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


def make_agents(env: Env, size: Size) -> dict[str, Agent]:
    num_envs, num_steps = size.num_envs, size.num_steps
    return {
        "random actions": random_agent(env, num_envs, num_steps),
        "trpo": trpo.make(env, TRPOConfig(num_envs, num_steps)),
        "ppo": ppo.make(env, PPOConfig(num_envs, num_steps)),
    }


def make_program(name: str, agent: Agent, world: World, size: Size, num_seeds: int) -> Program:
    """Compile an agent's iteration for a number of seeds, and take one to warm up."""
    options = compiler_options(world.params)
    keys = jax.vmap(jax.random.key)(jnp.arange(num_seeds))
    state = jax.jit(jax.vmap(agent.init, (0, None)), compiler_options=options)(keys, world.params)

    def iterate(state):
        state, metrics, _ = jax.vmap(agent.step, (0, None))(state, world.params)
        return state, metrics

    started, busy = time.perf_counter(), time.process_time()
    compiled = jax.jit(iterate, compiler_options=options).lower(state).compile()
    seconds, busy = time.perf_counter() - started, time.process_time() - busy
    row = {
        "engine": size.engine,
        "agent": name,
        "seeds": num_seeds,
        "envs": size.num_envs,
        "steps": size.num_steps,
        "compile_seconds": seconds,
        "compile_processor_seconds": busy,
    }
    state = jax.block_until_ready(compiled(state))[0]
    return Program(row, compiled, state, num_seeds * agent.steps_per_iteration)


def measure(programs: list[Program], repetitions: int) -> list[dict[str, Any]]:
    """Run the programs in turns; return their rows with medians and the share of the raw rate."""
    states = [program.state for program in programs]
    seconds, busy = np.zeros((2, repetitions, len(programs)))
    for repetition in range(repetitions):
        for number, program in enumerate(programs):
            started, used = time.perf_counter(), time.process_time()
            for _ in range(ITERATIONS):
                states[number] = program.step(states[number])[0]
            jax.block_until_ready(states[number])
            seconds[repetition, number] = time.perf_counter() - started
            busy[repetition, number] = time.process_time() - used
    steps = ITERATIONS * np.asarray([program.env_steps for program in programs])
    rates = steps / np.median(seconds, axis=0)
    by_processors = steps / np.median(busy, axis=0)
    raw = {
        (p.row["engine"], p.row["seeds"]): rate
        for p, rate in zip(programs, rates, strict=True)
        if p.row["agent"] == "random actions"
    }
    return [
        program.row
        | {
            "steps_per_second": rate,
            "steps_per_processor_second": by_processor,
            "slowest": count / taken.max(),
            "fastest": count / taken.min(),
            "share_of_random_actions": rate / raw[program.row["engine"], program.row["seeds"]],
        }
        for program, rate, by_processor, count, taken in zip(
            programs, rates, by_processors, steps, seconds.T, strict=True
        )
    ]


def main() -> None:
    arguments = tyro.cli(Arguments)
    task = choose("environment", arguments.env, ENVS)()
    programs = []
    for size in SIZES:
        world = make_world(task, engine=size.engine)
        programs += [
            make_program(name, agent, world, size, num_seeds)
            for num_seeds in size.num_seeds
            for name, agent in make_agents(world.env, size).items()
        ]
    busy = os.getloadavg()[0]
    rows = [
        {"env": arguments.env, **row, "load_average_before": busy}
        for row in measure(programs, arguments.repetitions)
    ]
    for row in rows:
        print(
            f"{row['engine']:7} {row['agent']:15} seeds {row['seeds']}"
            f"{row['steps_per_second']:10,.0f} steps/s, "
            f"{row['steps_per_processor_second']:10,.0f} a processor second, "
            f"{row['share_of_random_actions']:.2f} of the random actions', compiled in "
            f"{row['compile_processor_seconds']:.1f} processor seconds"
        )
    command = (
        f"python benchmarks/throughput.py --env {arguments.env} "
        f"--repetitions {arguments.repetitions}"
    )
    print(write_result("throughput", rows, seeds=list(range(5)), command=command))


if __name__ == "__main__":
    main()
