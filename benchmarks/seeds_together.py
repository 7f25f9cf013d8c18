"""Measure five seeds as one run beside five runs of a seed each, from their start to their end.

`python benchmarks/seeds_together.py`: TRPO with the presets' settings, in processes of their own,
with an empty compilation cache for each, with one that is empty at first and then shared, and with
one that has everything. Starting, importing, compiling, logging and saving count.
"""

import dataclasses
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tyro
from record import RESULTS, command_line, write_result

from garat_jax import compilation_cache

STEPS = {"inverted_pendulum": 200_000, "hopper": 1_000_000}
"""Environment steps of each seed, by environment."""
COLD, SHARED, WARM = "each empty", "shared, empty at first", "has everything"


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measure seeds trained together beside seeds trained one after another."""

    envs: tuple[str, ...] = ("inverted_pendulum", "hopper")
    """The environments."""
    caches: tuple[str, ...] = (COLD, SHARED, WARM)
    """The compilation caches."""
    seeds: int = 5
    """How many seeds."""
    repetitions: int = 1
    """Runs of each; the median counts."""
    steps: int = 0
    """Environment steps of each seed; 0 for those of `STEPS`, or a million."""
    out: Path = RESULTS
    """Folder for the results."""
    train: str = ""
    """Only train, in this process: ENV FIRST_SEED NUM_SEEDS FOLDER, as one word with commas."""


def train(name: str, seeds: Sequence[int], steps: int, folder: Path) -> None:
    """Train in this process, as the package does."""
    compilation_cache.enable()
    import jax
    import jax.numpy as jnp

    from garat_jax.agents import trpo
    from garat_jax.agents.trpo import TRPOConfig
    from garat_jax.compiler_options import compiler_options
    from garat_jax.env import make_world
    from garat_jax.envs import ENVS
    from garat_jax.runs import RunDirectory
    from garat_jax.train import Trainer

    world = make_world(ENVS[name]())
    agent = trpo.make(world.env, TRPOConfig())
    trainer = Trainer(RunDirectory.create(folder, {}, "", seeds), seeds)
    options = compiler_options(world.params)
    keys = jax.vmap(jax.random.key)(jnp.asarray(seeds))
    state = trainer.call(jax.vmap(agent.init, (0, None)), keys, world.params, options=options)

    def step(state, params):
        return jax.vmap(agent.step, (0, None))(state, params)[:2]

    iterations = steps // agent.steps_per_iteration
    trainer.train("policy", step, state, world.params, iterations, options)


def seconds_of_process(
    name: str, seeds: Sequence[int], steps: int, folder: Path, cache: Path
) -> float:
    """Train in a process of its own; return the seconds from its start to its end."""
    number = len(list(folder.glob("run-*")))
    what = f"{name},{seeds[0]},{len(seeds)},{folder / f'run-{number}'}"
    command = [sys.executable, "-W", "ignore", __file__, "--steps", str(steps), "--train", what]
    environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    started = time.perf_counter()
    done = subprocess.run(
        command,
        env={**environment, "XDG_CACHE_HOME": str(cache)},
        stderr=subprocess.PIPE,
        text=True,
    )
    seconds = time.perf_counter() - started
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr}")
    return seconds


def measure_once(name: str, cache: str, seeds: int, steps: int) -> tuple[float, list[float]]:
    """Return the seconds of all seeds together, and of each by itself."""
    with tempfile.TemporaryDirectory() as root:
        folder = Path(root)

        def run(seeds: Sequence[int], cache_name: str) -> float:
            return seconds_of_process(name, seeds, steps, folder, folder / cache_name)

        if cache == WARM:  # one short run of each kind fills it
            for number in (1, seeds):
                seconds_of_process(name, range(number), 5000, folder, folder / "alone")
            together = run(range(seeds), "alone")
        else:
            together = run(range(seeds), "together")
        alone = [
            run(range(seed, seed + 1), f"alone-{seed}" if cache == COLD else "alone")
            for seed in range(seeds)
        ]
    return together, alone


def measure(name: str, cache: str, arguments: Arguments) -> dict[str, Any]:
    steps = arguments.steps or STEPS.get(name, 1_000_000)
    busy = os.getloadavg()[0]
    found = [
        measure_once(name, cache, arguments.seeds, steps) for _ in range(arguments.repetitions)
    ]
    together = statistics.median(seconds for seconds, _ in found)
    one_after_another = statistics.median(sum(alone) for _, alone in found)
    row = {
        "env": name,
        "cache": cache,
        "seeds": arguments.seeds,
        "steps_of_each": steps,
        "together_seconds": together,
        "one_after_another_seconds": one_after_another,
        "ratio": together / one_after_another,
        "alone_seconds": [alone for _, alone in found],
        "load_average_before": busy,
    }
    print(
        f"{name:18} cache {cache:24} together {together:6.1f} s, one after another "
        f"{one_after_another:6.1f} s, ratio {row['ratio']:.2f}",
        flush=True,
    )
    return row


def main() -> None:
    arguments = tyro.cli(Arguments)
    if arguments.train:
        name, first, number, folder = arguments.train.split(",", 3)
        seeds = range(int(first), int(first) + int(number))
        train(name, seeds, arguments.steps, Path(folder))
        return
    rows = [
        measure(name, cache, arguments) for name in arguments.envs for cache in arguments.caches
    ]
    seeds = list(range(arguments.seeds))
    print(
        write_result(
            "seeds_together", rows, seeds=seeds, command=command_line(), folder=arguments.out
        )
    )


if __name__ == "__main__":
    main()
