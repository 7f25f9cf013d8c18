"""Measure environment steps a second with learning in them, beside other libraries and the engine.

`python benchmarks/throughput.py`: iterations of TRPO with the presets' settings and of PPO with
`PPOConfig`'s; the same steps with random actions; C MuJoCo alone; and other libraries' TRPO and PPO
with the same hyper-parameters in the same worlds. All are compiled and warm, and run in turns. The
result is written anew after each world, so that a run that is cut off keeps those it has, and says
which it lacks.
"""

import dataclasses
import os
from pathlib import Path
from typing import Any

import tyro
from record import RESULTS, command_line, write_result
from speed import ours
from speed.ours import FIFTH, Size
from speed.parts import parts
from speed.sides import RANDOM, Side, measure, with_ratios

from garat_jax.env import World, make_world
from garat_jax.envs import ENVS
from garat_jax.errors import choose

ITERATIONS = 5
"""Iterations in a timed run."""
EXTRA = "pip install garat_jax[bench]"


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measure environment steps a second including learning."""

    envs: tuple[str, ...] = ("inverted_pendulum", "hopper", "half_cheetah", "walker2d")
    """The environments."""
    repetitions: int = 5
    """Timed runs of each side; the median counts."""
    engine: str = "auto"
    """Physics of the JAX sides."""
    mjx: tuple[str, ...] = ("inverted_pendulum",)
    """Environments that are stepped with MJX too."""
    peers: bool = True
    """Other libraries as well."""
    out: Path = RESULTS
    """Folder for the results."""


def own_sides(name: str, world: World, mjx: World | None) -> list[Side]:
    """Compile our sides; 50 environments and 100 steps a batch are the presets'."""
    sides = []
    for num_seeds, num_envs, num_steps in ((1, 50, 100), (5, 50, 100), (1, 250, 20)):
        size = Size(num_seeds, num_envs, num_steps, ITERATIONS)
        if world.params.engine == "mujoco":
            sides.append(ours.engine_alone(name, world, size))
        agents = (RANDOM, "trpo", "ppo", *((FIFTH,) if num_seeds == 1 else ()))
        sides += [ours.make_side(agent, name, world, size) for agent in agents]
    if mjx is not None and world.params.engine != "mjx":
        size = Size(1, 50, 20, ITERATIONS)  # MJX on a CPU is slow, and gets less
        sides += [ours.make_side(agent, name, mjx, size) for agent in (RANDOM, "trpo", "ppo")]
    return sides


def peer_sides(name: str, world: World) -> tuple[list[Side], list[dict[str, Any]]]:
    """Return other libraries' sides, and what their choices gave; say which are not installed."""
    sides, tried = [], []
    try:
        from speed import torch_peers
    except ModuleNotFoundError as error:
        skip("stable-baselines3 and sb3-contrib", error)
    else:
        host = make_world(world.env.task, engine="mujoco")
        sides, tried = torch_peers.sides(name, host, ("trpo", "ppo"), ITERATIONS)
    from speed import jax_peers

    sides.append(jax_peers.brax_side(name, world, ITERATIONS))
    try:
        sides.append(jax_peers.rejax_side(name, world, ITERATIONS))
    except ModuleNotFoundError as error:
        skip("rejax", error)
    return sides, tried


def skip(peer: str, error: ModuleNotFoundError) -> None:
    print(f"{peer}: left out, {error.name} is not installed; it comes with {EXTRA}", flush=True)


def measure_world(name: str, arguments: Arguments) -> tuple[list[dict], list[dict], list[dict]]:
    """Return a world's rows, what the peers' choices gave, and the parts of an iteration."""
    task = choose("environment", name, ENVS)()
    world = make_world(task, engine=arguments.engine)
    mjx = make_world(task, engine="mjx") if name in arguments.mjx else None
    busy = os.getloadavg()[0]
    own = own_sides(name, world, mjx)
    others, tried = peer_sides(name, world) if arguments.peers else ([], [])
    rows = with_ratios(measure([*own, *others], arguments.repetitions))
    for side in (*own, *others):
        side.close()
    costs = [
        parts(name, world, Size(num_seeds, 50, 100, 1), arguments.repetitions)
        for num_seeds in (1, 5)
    ]
    rows = [row | {"load_average_before": busy} for row in rows]
    for row in rows:
        show(row)
    return rows, tried, costs


def show(row: dict[str, Any]) -> None:
    ratio = row.get("ours_over_this")
    share = row.get("share_of_random_actions")
    engine = row.get("share_of_engine_alone")
    print(
        f"{row['env']:18} {row['agent']:23} {row['engine']:7} seeds {row['seeds']} envs "
        f"{row['envs']:3} {row['steps_per_second']:9,.0f} steps/s "
        f"{row['steps_per_processor_second']:9,.0f} a processor second"
        + (f", {share:.2f} of random actions'" if share else "")
        + (f", {engine:.2f} of the engine's" if engine else "")
        + (f"; ours is {ratio:.1f} times as fast" if ratio else ""),
        flush=True,
    )


def main() -> None:
    arguments = tyro.cli(Arguments)
    rows, tried, costs = [], [], []
    for number, name in enumerate(arguments.envs, 1):
        for found, more in zip((rows, tried, costs), measure_world(name, arguments), strict=True):
            found += more
        details = {
            "not_measured": arguments.envs[number:],
            "load_average_after": os.getloadavg(),
            "choices_of_the_peers": tried,
            "parts_of_a_trpo_iteration": costs,
        }
        print(
            write_result(
                "throughput",
                rows,
                seeds=list(range(5)),
                command=command_line(),
                details=details,
                folder=arguments.out,
            )
        )


if __name__ == "__main__":
    main()
