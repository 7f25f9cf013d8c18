"""Measure the most memory that a whole transfer holds, in each pair's worlds, with five seeds.

`python benchmarks/memory.py`: every stage of `garat transfer` with the preset's sizes but few
iterations, in a process of its own with an empty compilation cache, because compiling takes memory.
"""

import dataclasses
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import tyro
from record import RESULTS, command_line, write_result

from garat_jax import compilation_cache

LIMIT = 2048.0
"""MiB that no pair should need."""
STAGE = re.compile(r"memory ([\d.]+) MiB of states and ([\d.]+) MiB more")
"""What a stage prints: states that go in and come out, and what an iteration needs besides."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measure the memory of a transfer."""

    pairs: tuple[str, ...] = ()
    """The pairs; all by default."""
    method: str = "garat"
    """How to ground."""
    engine: str = "auto"
    """Physics."""
    seeds: int = 5
    """How many seeds."""
    out: Path = RESULTS
    """Folder for the results."""
    transfer: str = ""
    """Only transfer, in this process: PAIR,FOLDER."""


def transfer(pair: str, folder: Path, arguments: Arguments) -> None:
    """Go through the stages in this process, and print the memory that it held at most."""
    compilation_cache.enable()
    from garat_jax.devices import peak_mebibytes
    from garat_jax.envs.pairs import PAIRS
    from garat_jax.presets import METHODS
    from garat_jax.runs import RunDirectory
    from garat_jax.transfer import run_transfer

    config = METHODS[arguments.method](PAIRS[pair], seeds=arguments.seeds, engine=arguments.engine)
    config = dataclasses.replace(config, max_iterations=2, num_updates=2, num_retraining=2)
    run_transfer(config, RunDirectory.create(folder, {}, "", range(arguments.seeds)))
    print(peak_mebibytes())


def measure(pair: str, arguments: Arguments) -> dict[str, Any]:
    """Return what a transfer in a process of its own holds at most."""
    busy, started = os.getloadavg()[0], time.perf_counter()
    with tempfile.TemporaryDirectory() as root:
        command = [
            *(sys.executable, "-W", "ignore", __file__),
            *("--method", arguments.method, "--engine", arguments.engine),
            *("--seeds", str(arguments.seeds), "--transfer", f"{pair},{root}/run"),
        ]
        environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
        done = subprocess.run(
            command,
            env={**environment, "XDG_CACHE_HOME": f"{root}/cache"},
            capture_output=True,
            text=True,
        )
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr}")
    stages = [(float(held), float(way)) for held, way in STAGE.findall(done.stderr)]
    if not stages:
        raise RuntimeError(f"{' '.join(command)} did not print what its stages need")
    row = {
        "pair": pair,
        "method": arguments.method,
        "engine": arguments.engine,
        "seeds": arguments.seeds,
        "peak_mebibytes": float(done.stdout.split()[-1]),
        "states_mebibytes": max(states for states, _ in stages),
        "iteration_mebibytes": max(on_the_way for _, on_the_way in stages),
        "limit_mebibytes": LIMIT,
        "seconds": time.perf_counter() - started,
        "load_average_before": busy,
    }
    print(f"{pair:24} {row['peak_mebibytes']:6.0f} MiB after {row['seconds']:.0f} s", flush=True)
    return row


def main() -> None:
    arguments = tyro.cli(Arguments)
    if arguments.transfer:
        pair, folder = arguments.transfer.split(",", 1)
        transfer(pair, Path(folder), arguments)
        return
    from garat_jax.envs.pairs import PAIRS

    rows = [measure(pair, arguments) for pair in arguments.pairs or PAIRS]
    seeds = list(range(arguments.seeds))
    print(write_result("memory", rows, seeds=seeds, command=command_line(), folder=arguments.out))


if __name__ == "__main__":
    main()
