"""Measure how steps a second grow with the number of environments, and of seeds.

`python benchmarks/growth.py`: TRPO and random actions, the number of environments of one seed from
1 to 4096, and the number of seeds with the presets' 50 environments each. The result is written
anew after each world, so that a run that is cut off keeps those it has, and says which it lacks.
"""

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tyro
from record import RESULTS, command_line, write_result
from speed import ours
from speed.ours import Size
from speed.sides import RANDOM, measure

from garat_jax.env import make_world
from garat_jax.envs import ENVS
from garat_jax.errors import choose

BATCH = 5000
"""Steps in a batch as long as each environment has `FEWEST`, as in the presets."""
FEWEST = 16
"""Steps that each environment takes in a batch, at least."""
TIMED = 20_000
"""Environment steps in a timed run, at least."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measure how steps a second grow with environments and seeds."""

    envs: tuple[str, ...] = ("inverted_pendulum", "hopper", "half_cheetah", "walker2d")
    """The environments."""
    num_envs: tuple[int, ...] = (1, 4, 16, 64, 256, 1024, 4096)
    """Numbers of environments, of one seed."""
    num_seeds: tuple[int, ...] = (1, 2, 5, 10)
    """Numbers of seeds, of 50 environments each."""
    repetitions: int = 5
    """Timed runs of each; the median counts."""
    engine: str = "auto"
    """Physics."""
    out: Path = RESULTS
    """Folder for the results."""


def size_of(num_seeds: int, num_envs: int) -> Size:
    num_steps = max(FEWEST, BATCH // num_envs)
    iterations = max(1, round(TIMED / (num_seeds * num_envs * num_steps)))
    return Size(num_seeds, num_envs, num_steps, iterations)


def grow(name: str, grows: str, sizes: Sequence[Size], arguments: Arguments) -> list[dict]:
    """Return the rows of one world and one thing that grows."""
    world = make_world(choose("environment", name, ENVS)(), engine=arguments.engine)
    busy = os.getloadavg()[0]
    rows: list[dict[str, Any]] = []
    for agent in (RANDOM, "trpo"):
        sides = [ours.make_side(agent, name, world, size) for size in sizes]
        rows += measure(sides, arguments.repetitions)
    for row in rows:
        row |= {"grows": grows, "load_average_before": busy}
        row.pop("share_of_random_actions", None)  # each agent is measured by itself
        print(
            f"{name:18} {row['agent']:15} seeds {row['seeds']:2} envs {row['envs']:4} steps "
            f"{row['steps']:4} {row['steps_per_second']:9,.0f} steps/s",
            flush=True,
        )
    return rows


def main() -> None:
    arguments = tyro.cli(Arguments)
    rows: list[dict[str, Any]] = []
    for number, name in enumerate(arguments.envs, 1):
        by_envs = [size_of(1, num_envs) for num_envs in arguments.num_envs]
        by_seeds = [size_of(num_seeds, 50) for num_seeds in arguments.num_seeds]
        rows += grow(name, "envs", by_envs, arguments)
        rows += grow(name, "seeds", by_seeds, arguments)
        print(
            write_result(
                "growth",
                rows,
                seeds=list(range(max(arguments.num_seeds))),
                command=command_line(),
                details={"not_measured": arguments.envs[number:]},
                folder=arguments.out,
            )
        )


if __name__ == "__main__":
    main()
