"""The sides of a comparison, run in turns so that other work on the machine meets all alike."""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

RANDOM, ENGINE_ALONE = "random actions", "engine alone"
"""The sides whose rates the others' are compared with."""

RATIOS = {
    "ours_over_this": (1, 50),
    "ours_with_250_envs_over_this": (1, 250),
    "ours_with_5_seeds_over_this": (5, 50),
}
"""What of ours a peer is compared with: seeds, and environments of each."""


class Side(NamedTuple):
    """Something that takes environment steps, compiled and warm.

    Attributes:
        row: What to report of it, by name.
        run: Takes `env_steps` steps, and returns once they are done.
        env_steps: Environment steps in a run.
        close: Called once it is no longer needed.
    """

    row: dict[str, Any]
    run: Callable[[], None]
    env_steps: int
    close: Callable[[], None] = lambda: None


def seconds_of(run: Callable[[], Any]) -> tuple[float, float]:
    """Return the wall and the processor seconds that a call takes."""
    started, busy = time.perf_counter(), time.process_time()
    run()
    return time.perf_counter() - started, time.process_time() - busy


def measure(sides: Sequence[Side], repetitions: int) -> list[dict[str, Any]]:
    """Run the sides in turns; return their rows with medians over the repetitions.

    Args:
        sides: What to run.
        repetitions: Runs of each.

    Returns:
        Each side's row with its steps a second and a processor second, the slowest and the fastest
        run, and its shares of the rates of random actions and of the engine alone, where there are
        such sides with the same engine and numbers of seeds and environments.
    """
    taken = np.asarray([[seconds_of(side.run) for side in sides] for _ in range(repetitions)])
    seconds, busy = np.median(taken, axis=0).T
    steps = np.asarray([side.env_steps for side in sides])
    rates = {
        (side.row["agent"], _world_of(side.row)): rate
        for side, rate in zip(sides, steps / seconds, strict=True)
    }
    rows = []
    for number, side in enumerate(sides):
        rate = side.env_steps / seconds[number]
        row = side.row | {
            "steps_per_second": rate,
            "steps_per_processor_second": side.env_steps / busy[number],
            "slowest": side.env_steps / taken[:, number, 0].max(),
            "fastest": side.env_steps / taken[:, number, 0].min(),
        }
        for agent in (RANDOM, ENGINE_ALONE):
            if (raw := rates.get((agent, _world_of(row)))) is not None:
                row[f"share_of_{agent.replace(' ', '_')}"] = rate / raw
        rows.append(row)
    return rows


def with_ratios(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Add to each peer's row how many times as fast ours is."""
    own = {
        (row["agent"], row["seeds"], row["envs"]): row["steps_per_second"]
        for row in rows
        if "version" not in row and row["engine"] == rows[0]["engine"]
    }
    for row in rows:
        if "version" in row:
            algorithm = row["agent"].split()[-1]
            for ratio, size in RATIOS.items():
                row[ratio] = own[algorithm, *size] / row["steps_per_second"]
    return rows


def _world_of(row: dict[str, Any]) -> tuple[Any, ...]:
    return row["env"], row["engine"], row["seeds"], row["envs"]
