"""Measure how long a run takes from its start to its first update, without and with the cache.

`python benchmarks/start.py`: `garat transfer` starts in a process of its own, with an empty
compilation cache and then with what that start left in it, and is stopped at its first logged line.
"""

import dataclasses
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import tyro
from record import write_result

PAIR = "inverted_pendulum_heavy"
PROGRAM = "from garat_jax.cli import entry; entry()"
LIMIT = 600.0


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measure the time from a run's start to its first update."""

    repetitions: int = 3
    """Starts of each kind; the median counts."""
    engine: tuple[str, ...] = ("mujoco", "mjx")
    """Physics engines."""


def seconds_to_first_update(engine: str, cache: Path, out: Path) -> float:
    command = ["transfer", PAIR, "--seeds", "1", "--engine", engine, "--out", str(out)]
    environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    started = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", PROGRAM, *command],
        env={**environment, "XDG_CACHE_HOME": str(cache)},
        stderr=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
    )
    metrics = out / "metrics.jsonl"
    while not metrics.exists() or not metrics.stat().st_size:
        if process.poll() is not None or time.perf_counter() - started > LIMIT:
            process.kill()
            raise RuntimeError(f"garat {' '.join(command)} did not get to its first update")
        time.sleep(0.01)
    seconds = time.perf_counter() - started
    process.kill()  # not Ctrl-C, which is ignored where a shell started this in the background
    process.wait()
    return seconds


def measure(engine: str, repetitions: int) -> dict[str, Any]:
    cold, warm = [], []
    for _ in range(repetitions):
        with tempfile.TemporaryDirectory() as folder:
            root = Path(folder)
            cold.append(seconds_to_first_update(engine, root / "cache", root / "cold"))
            warm.append(seconds_to_first_update(engine, root / "cache", root / "warm"))
    return {
        "pair": PAIR,
        "engine": engine,
        "cold_seconds": statistics.median(cold),
        "warm_seconds": statistics.median(warm),
        "fastest_cold": min(cold),
        "fastest_warm": min(warm),
        "load_average": os.getloadavg()[0],
    }


def main() -> None:
    arguments = tyro.cli(Arguments)
    rows = [measure(engine, arguments.repetitions) for engine in arguments.engine]
    for row in rows:
        print(row)
    command = f"python benchmarks/start.py --repetitions {arguments.repetitions}"
    print(write_result("start", rows, seeds=[0], command=command))


if __name__ == "__main__":
    main()
