"""Measure what XLA's levels of optimisation cost and save in programs that train with C MuJoCo.

`python benchmarks/optimisation_level.py`: each program is compiled at each level, and the compiled
ones run in turns.
"""

import dataclasses
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro
from record import RESULTS, command_line, write_result

from garat_jax.agents import ppo, trpo
from garat_jax.agents.ppo import PPOConfig
from garat_jax.agents.trpo import TRPOConfig
from garat_jax.compiler_options import OPTIMISATION_LEVEL
from garat_jax.env import World, make_world
from garat_jax.envs.pairs import PAIRS
from garat_jax.types import Agent

PPO = PPOConfig(num_epochs=10, num_minibatches=32)
LEVELS = (None, 1, 0)
"""None is XLA's default."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measure what XLA's levels of optimisation cost and save in training with C MuJoCo."""

    pairs: tuple[str, ...] = ("inverted_pendulum_heavy", "hopper_heavy", "half_cheetah_heavy")
    """Pairs of worlds whose source is trained in."""
    repetitions: int = 9
    """Timed iterations of each program; the median counts."""
    seed: int = 0
    """Seed of the agents."""
    out: Path = RESULTS
    """Folder for the result."""


def measure(name: str, agent: Agent, world: World, arguments: Arguments) -> list[dict[str, Any]]:
    """Return one agent's rows, one a level."""
    state = jax.jit(lambda key: agent.init(key, world.params))(jax.random.key(arguments.seed))
    programs, rows = [], []
    for level in LEVELS:
        options = {} if level is None else {OPTIMISATION_LEVEL: level}
        step = jax.jit(lambda *of: agent.step(*of)[:2], compiler_options=options)
        lowered = step.lower(state, world.params)
        started = time.perf_counter()
        programs.append(lowered.compile())
        compiling = time.perf_counter() - started
        rows.append({"agent": name, "level": level, "compile_seconds": compiling})
    times = []
    for _ in range(arguments.repetitions + 1):
        for program in programs:
            started = time.perf_counter()
            jax.block_until_ready(program(state, world.params))
            times.append(time.perf_counter() - started)
    medians = np.median(np.reshape(times, (-1, len(LEVELS)))[1:], axis=0)
    return [
        row | {"iteration_seconds": float(median)}
        for row, median in zip(rows, medians, strict=True)
    ]


def main() -> None:
    arguments = tyro.cli(Arguments)
    jax.config.update("jax_enable_compilation_cache", False)
    rows = []
    for name in arguments.pairs:
        pair = PAIRS[name]
        world = make_world(pair.task, pair.source, pair.source_effects, "mujoco")
        for agent, made in (
            ("TRPO", trpo.make(world.env, TRPOConfig())),
            ("PPO", ppo.make(world.env, PPO)),
        ):
            for row in measure(agent, made, world, arguments):
                rows.append({"pair": name, **row})
                print(rows[-1], flush=True)
    write_result(
        "optimisation_level",
        rows,
        seeds=[arguments.seed],
        command=command_line(),
        folder=arguments.out,
    )


if __name__ == "__main__":
    main()
