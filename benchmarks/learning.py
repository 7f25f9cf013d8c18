"""Measure what TRPO learns in a million steps, beside sb3-contrib's TRPO in the same worlds.

`python benchmarks/learning.py`: five seeds of each with the same hyper-parameters; mean returns of
the policies' mean actions over 50 whole episodes, at four points of the training. The peer's
observations are normalised like ours, which it leaves to its user, and its line search is as the
library has it. Its seeds run in `--jobs` processes. Both learn in two trust regions: the paper's,
and that of the peer's user who gives it the paper's number, which it takes for a mean over the
actions' components and not their sum. Ours also learns in the targets of the pairs, which it should
solve, for longer where a million steps are not enough. `--extend` keeps the rows of the result file
and adds what they lack, seeds too; each names the commits of its seeds. Where five seeds leave open
who learns more, `--extend --seeds 40 --envs half_cheetah --regions sum --pairs` takes forty there.
"""

# pyright: reportMissingImports=false
import concurrent.futures
import dataclasses
import importlib.metadata
import json
import multiprocessing
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jobs import end_with_parent
from record import RESULTS, command_line, result_path, write_result

from garat_jax import rollout
from garat_jax.agents import trpo
from garat_jax.agents.trpo import TRPOConfig
from garat_jax.compiler_options import compiler_options
from garat_jax.env import World, make_world
from garat_jax.envs import ENVS
from garat_jax.envs.pairs import PAIRS
from garat_jax.provenance import git_state

NAME = "learning"
"""Of the result file."""
POINTS = 4
"""How often in the training the policies are evaluated, evenly."""
EPISODES = 50
TIMES = {"ant": 6}
"""How many times as long ours learns in some targets, at most."""
WITHIN = 0.1
"""Ours may lie below the peer's mean return by this share of it."""
OURS, PEER = "garat_jax trpo", "sb3-contrib trpo"

Kept = dict[tuple[str, str, float], dict[str, Any]]
"""Rows of an earlier run, by where, who and trust region."""


Region = Literal["sum", "mean"]
"""Trust region: its limit is on the sum over the actions' components, or on their mean."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measure what TRPO learns, beside sb3-contrib's."""

    envs: tuple[str, ...] = ("inverted_pendulum", "hopper", "half_cheetah", "walker2d")
    """The environments."""
    regions: tuple[Region, ...] = ("sum", "mean")
    """Trust regions in them; with one action they are the same."""
    pairs: tuple[str, ...] = tuple(PAIRS)
    """The pairs whose targets ours learns in."""
    steps: int = 1_000_000
    """Environment steps of each seed."""
    seeds: int = 5
    """How many seeds, at least."""
    jobs: int = 2
    """Processes for the peer's seeds."""
    extend: bool = False
    """Keep the rows of the result file and add what it lacks."""
    out: Path = RESULTS
    """Folder for the results."""


def host_world(name: str) -> World:
    return make_world(ENVS[name](), engine="mujoco")


def configs(world: World, regions: Sequence[Region]) -> list[TRPOConfig]:
    """Return settings with the paper's trust region, and with as wide a one as the peer's mean."""
    paper = TRPOConfig()
    wide = paper.averaged(world.env.action_size)
    by_region: dict[Region, TRPOConfig] = {"sum": paper, "mean": wide}
    return list(dict.fromkeys(by_region[region] for region in regions))


def learn(world: World, config: TRPOConfig, seeds: Sequence[int], steps: int) -> np.ndarray:
    """Train ours; return mean returns [points, seeds]."""
    agent = trpo.make(world.env, config)
    options = compiler_options(world.params)

    def acting(params, obs: jax.Array, key: jax.Array):
        del key
        return agent.mean(params, obs), jnp.zeros(())

    def evaluate(state, key: jax.Array) -> jax.Array:
        found = rollout.evaluate(world.env, world.params, acting, state.policy, key, EPISODES)
        return found.returns.mean()

    def iterate(state):
        return jax.vmap(agent.step, (0, None))(state, world.params)[0]

    keys = jax.vmap(jax.random.key)(jnp.asarray(seeds))
    state = jax.jit(jax.vmap(agent.init, (0, None)), compiler_options=options)(keys, world.params)
    step = jax.jit(iterate, compiler_options=options)
    score = jax.jit(jax.vmap(evaluate), compiler_options=options)
    found = []
    for point in range(POINTS):
        for _ in range(steps // POINTS // agent.steps_per_iteration):
            state = step(state)
        evaluation_keys = jax.vmap(jax.random.fold_in, (0, None))(keys, point)
        found.append(np.asarray(score(state, evaluation_keys)))
    return np.asarray(found)


def learn_peer(name: str, config: TRPOConfig, seed: int, steps: int) -> list[float]:
    """Train one seed of the peer; return its mean returns [points]."""
    import torch
    from speed.torch_peers import make_envs, make_trpo
    from stable_baselines3.common.vec_env import VecNormalize

    from garat_jax.adapters import to_gymnasium_vector

    torch.set_num_threads(1)
    world = host_world(name)
    envs = VecNormalize(make_envs(name, world, num_envs=config.num_envs), norm_reward=False)
    with warnings.catch_warnings():  # advice on batch sizes
        warnings.simplefilter("ignore")
        learner = make_trpo(envs, seed, shrinking=0.8, config=config)
    judges = to_gymnasium_vector(world.env, world.params, EPISODES)
    found = []
    for _ in range(POINTS):
        learner.learn(steps // POINTS, log_interval=steps, reset_num_timesteps=False)
        obs, _ = judges.reset(seed=10_000 + EPISODES * seed)
        alive, total = np.ones(EPISODES, bool), np.zeros(EPISODES)
        while alive.any():
            action, _ = learner.predict(envs.normalize_obs(obs), deterministic=True)
            obs, reward, terminated, truncated, _ = judges.step(action)
            total += alive * reward
            alive &= ~(terminated | truncated)
        found.append(float(total.mean()))
    return found


def row_of(
    where: str,
    agent: str,
    config: TRPOConfig,
    solved: float,
    returns: np.ndarray,
    steps: int,
    earlier: dict[str, Any] | None,
) -> dict[str, Any]:
    """Return a row from mean returns [points, seeds], behind those of an earlier row."""
    commits = [(git_state() or {}).get("commit")] * returns.shape[1]
    if earlier:
        returns = np.concatenate([earlier["returns"], returns], axis=1)
        commits = [*commits_of(earlier), *commits]
    row = {
        "env": where,
        "agent": agent,
        "max_kl": config.max_kl,
        "steps": [steps * (point + 1) // POINTS for point in range(POINTS)],
        "returns": returns.tolist(),
        "mean": float(returns[-1].mean()),
        "standard_error": float(returns[-1].std(ddof=1) / np.sqrt(returns.shape[1])),
        "solved_return": solved,
        "solved": [bool(best >= solved) for best in returns.max(axis=0)],
        "commits": commits,
    }
    print(row, flush=True)
    return row


def commits_of(row: dict[str, Any]) -> list[str | None]:
    """Return the commit of each seed of a row; one that was not extended may name it once."""
    return row["commits"] if "commits" in row else [row["commit"]] * len(row["solved"])


def lacking(row: dict[str, Any] | None, seeds: int) -> range:
    """Return the seeds that a row does not have yet."""
    return range(len(row["solved"]) if row else 0, seeds)


def _key(row: dict[str, Any]) -> tuple[str, str, float]:
    return row["env"], row["agent"], row["max_kl"]


def target_steps(arguments: Arguments, name: str) -> int:
    """Return how many steps ours learns in the target of a pair."""
    return TIMES.get(name, 1) * arguments.steps


def recorded(arguments: Arguments) -> tuple[Kept, Kept]:
    """Return the rows of the result file, of worlds and of targets; none where there is no file.

    Not those of a target whose `TIMES`, or whose pair's trust region, changed.

    Raises:
        SystemExit: They have another number of steps.
    """
    path = result_path(NAME, arguments.out)
    if not path.exists():
        return {}, {}
    result = json.loads(path.read_text(encoding="utf-8"))
    worlds, sizes = result["rows"], {row["steps"][-1] for row in result["rows"]}
    if sizes - {arguments.steps}:
        raise SystemExit(f"--extend: {path} has {sorted(sizes)} steps; give the same")
    targets = [
        row
        for row in result["targets"]
        if row["steps"][-1] == target_steps(arguments, row["env"])
        and row["max_kl"] == PAIRS[row["env"]].agent.max_kl
    ]
    return {_key(row): row for row in worlds}, {_key(row): row for row in targets}


def measure(arguments: Arguments, kept: Kept) -> Iterator[dict[str, Any]]:
    """Yield a row for each world, agent and trust region."""
    steps = arguments.steps
    worlds = {name: host_world(name) for name in arguments.envs}
    sides = [
        (name, world, config)
        for name, world in worlds.items()
        for config in configs(world, arguments.regions)
    ]
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(arguments.jobs, context, end_with_parent) as pool:
        peers = {
            (name, config): [
                pool.submit(learn_peer, name, config, seed, steps)
                for seed in lacking(kept.get((name, PEER, config.max_kl)), arguments.seeds)
            ]
            for name, _, config in sides
        }
        for name, world, config in sides:
            solved = world.env.task.solved_return
            ours, theirs = (kept.get((name, agent, config.max_kl)) for agent in (OURS, PEER))
            if seeds := lacking(ours, arguments.seeds):
                returns = learn(world, config, seeds, steps)
                ours = row_of(name, OURS, config, solved, returns, steps, ours)
            if futures := peers[name, config]:
                returns = np.asarray([future.result() for future in futures]).T
                theirs = row_of(name, PEER, config, solved, returns, steps, theirs)
            assert ours and theirs
            least = theirs["mean"] - WITHIN * abs(theirs["mean"])
            yield theirs
            yield ours | {"met": ours["mean"] >= least}


def measure_targets(arguments: Arguments, kept: Kept) -> Iterator[dict[str, Any]]:
    """Yield a row for each pair's target."""
    for name in arguments.pairs:
        config = PAIRS[name].agent
        _, target = PAIRS[name].worlds("mujoco")
        solved, steps = target.env.task.solved_return, target_steps(arguments, name)
        row = kept.get((name, OURS, config.max_kl))
        if seeds := lacking(row, arguments.seeds):
            returns = learn(target, config, seeds, steps)
            row = row_of(name, OURS, config, solved, returns, steps, row)
        assert row
        yield row


def write(arguments: Arguments, rows: Kept, targets: Kept) -> Path:
    """Write all rows so far."""
    seeds = max(len(row["solved"]) for row in (*rows.values(), *targets.values()))
    details = {
        "peer": {k: importlib.metadata.version(k) for k in ("sb3-contrib", "torch")},
        "within": WITHIN,
        "episodes": EPISODES,
        "targets": [*targets.values()],
    }
    return write_result(
        NAME,
        [*rows.values()],
        seeds=range(seeds),
        command=command_line(),
        details=details,
        folder=arguments.out,
    )


def main() -> None:
    arguments = tyro.cli(Arguments)
    rows, targets = recorded(arguments) if arguments.extend else ({}, {})
    for measured, into in (
        (measure(arguments, rows), rows),
        (measure_targets(arguments, targets), targets),
    ):
        for row in measured:
            into[_key(row)] = row
            path = write(arguments, rows, targets)  # so that --extend can go on from here
            print(path, flush=True)


if __name__ == "__main__":
    main()
