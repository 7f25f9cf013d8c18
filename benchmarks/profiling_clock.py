"""Measure what MuJoCo's profiling clock and its search for islands cost in a step.

`python benchmarks/profiling_clock.py`: a batch of each world's source is stepped with the clock
that MuJoCo's Python package sets, without, and also without a search for islands, in turns.
"""

import dataclasses
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import tyro
from mujoco.batch import Batch
from record import RESULTS, command_line, write_result

from garat_jax import devices
from garat_jax.engine import profiling_clock
from garat_jax.env import make_world
from garat_jax.envs.pairs import PAIRS

ISLANDS = int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
WAYS = ("clock and islands", "islands", "neither")


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measure what MuJoCo's profiling clock and its search for islands cost in a step."""

    repetitions: int = 9
    """Timed runs of each; the median counts."""
    num_envs: int = 50
    """Simulations in a batch."""
    num_steps: int = 100
    """Physics steps of each simulation in a run."""
    out: Path = RESULTS
    """Folder for the result."""


def measure(model: mujoco.MjModel, clock, default, arguments: Arguments) -> dict[str, Any]:
    """Return the rates of all ways, and by how much their last states differ."""
    kept = model.opt.disableflags & ~ISLANDS
    shape = (arguments.num_envs, arguments.num_steps, model.nu)
    commands = np.random.default_rng(0).uniform(-1.0, 1.0, shape)
    spec = int(mujoco.mjtState.mjSTATE_CTRL)
    times: dict[str, list[float]] = {way: [] for way in WAYS}
    ends = {}
    for _ in range(arguments.repetitions + 1):
        for way in WAYS:
            clock.value = default if "clock" in way else None
            model.opt.disableflags = kept if "islands" in way else kept | ISLANDS
            batch = Batch(model, arguments.num_envs, nthread=devices.num_cores())
            started = time.perf_counter()
            found = batch.rollout(arguments.num_steps, commands, spec, record=("qpos", "qvel"))
            times[way].append(time.perf_counter() - started)
            ends[way] = np.concatenate([found["qpos"], found["qvel"]], axis=2)
    num = arguments.num_envs * arguments.num_steps
    return {
        "steps_per_second": {way: num / float(np.median(t[1:])) for way, t in times.items()},
        "largest_difference": max(float(np.abs(ends[w] - ends[WAYS[0]]).max()) for w in WAYS),
    }


def main() -> None:
    arguments = tyro.cli(Arguments)
    clock = profiling_clock()
    if clock is None:
        raise SystemExit("error: MuJoCo's library does not show its clock on this machine")
    default = clock.value  # as the package sets it: no model is compiled yet
    rows = []
    for name, pair in PAIRS.items():
        world = make_world(pair.task, pair.source, pair.source_effects, "mujoco")
        model = world.params.host.model
        rows.append({"pair": name, **measure(model, clock, default, arguments)})
        print(rows[-1], flush=True)
    name = "profiling_clock"
    write_result(name, rows, seeds=[0], command=command_line(), folder=arguments.out)


if __name__ == "__main__":
    main()
