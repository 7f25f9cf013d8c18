"""Run the transfer experiment of a pair and record whether it meets what it is held to.

`python benchmarks/transfer.py --pair inverted_pendulum_heavy --method garat --seeds 5`
"""

import dataclasses
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from record import write_result

from garat_jax.envs.pairs import PAIRS
from garat_jax.errors import choose
from garat_jax.presets import METHODS
from garat_jax.runs import RunDirectory
from garat_jax.summary import counted
from garat_jax.transfer import run_transfer

SOURCE_FAILS = 300.0
"""The source policy's target return of every seed has to be below this, else nothing transfers."""
TARGET_SOLVED = 900.0
"""The target policy's target return of every seed has to be above this."""
ERROR_RATIO = 0.25
"""Share of the source's held-out transition error that a grounded source may keep."""
SCALED_RETURN = 0.9
"""Mean return to be reached, where the source policy is 0 and the target policy 1."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Run the transfer experiment and record whether it meets what it is held to."""

    pair: str = "inverted_pendulum_heavy"
    """Source and target."""
    method: str = "garat"
    """How to ground."""
    seeds: int = 5
    """How many seeds: 0, 1, ..."""
    out: Path | None = None
    """Keep the run directory here."""


def thresholds(summary: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return each threshold with the value that is held to it and whether it is met."""
    ratio = np.asarray(summary["error_ratio"])
    zero = np.asarray(summary["baselines"]["zero_action"]["ratio"])
    mean_ratio = float(counted(summary, summary["error_ratio"]).mean())
    scaled = summary["scaled"]["mean"]
    source, target = (summary["returns"][f"{name}_policy"] for name in ("source", "target"))
    return {
        "source policy fails in the target, every seed": {
            "limit": SOURCE_FAILS,
            "value": max(source),
            "met": max(source) < SOURCE_FAILS,
        },
        "target policy solves the target, every seed": {
            "limit": TARGET_SOLVED,
            "value": min(target),
            "met": min(target) > TARGET_SOLVED,
        },
        "error ratio, mean": {
            "limit": ERROR_RATIO,
            "value": mean_ratio,
            "met": mean_ratio <= ERROR_RATIO,
        },
        "error ratio below the zero action's, every seed": {
            "limit": float(zero.min()),
            "value": ratio.max(),
            "met": (ratio < zero).all(),
        },
        "scaled return, mean": {
            "limit": SCALED_RETURN,
            "value": scaled,
            "met": scaled is not None and scaled >= SCALED_RETURN,
        },
    }


def main() -> None:
    arguments = tyro.cli(Arguments)
    pair = choose("pair", arguments.pair, PAIRS)
    config = choose("method", arguments.method, METHODS)(pair, seeds=arguments.seeds)
    command = (
        f"python benchmarks/transfer.py --pair {arguments.pair} --method {arguments.method} "
        f"--seeds {arguments.seeds}"
    )
    with tempfile.TemporaryDirectory() as folder:
        out = arguments.out or Path(folder) / "run"
        run = RunDirectory.create(out, config, command, range(arguments.seeds))
        summary = run_transfer(config, run)
    row = summary | {"thresholds": thresholds(summary)}
    for name, threshold in row["thresholds"].items():
        print(f"{name}: {threshold['value']} against {threshold['limit']}: {threshold['met']}")
    name = f"transfer_{arguments.pair}"
    if arguments.method != "garat":
        name += f"_{arguments.method}"
    print(write_result(name, [row], seeds=list(range(arguments.seeds)), command=command))


if __name__ == "__main__":
    main()
