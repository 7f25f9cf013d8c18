"""Measure GARAT's settings one by one: the table of docs/grounding.md.

`python benchmarks/figures/grounding_variants.py`. One source policy a seed is trained, and every
variant grounds the source for it with the same target transitions. What counts is the held-out
transition error, as a share of the ungrounded source's.
"""

import dataclasses
import sys
import tempfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from record import write_result

from garat_jax.agents import trpo
from garat_jax.agents.ppo import PPOConfig
from garat_jax.env import make_world
from garat_jax.envs.pairs import PAIRS
from garat_jax.errors import DivergedError, choose
from garat_jax.methods.garat import GARATConfig
from garat_jax.methods.transition_error import best_constant, constant_error, transition_error
from garat_jax.presets import garat, garat_paper
from garat_jax.rollout import Recorded
from garat_jax.runs import RunDirectory
from garat_jax.train import Trainer
from garat_jax.transfer import Experiment, TransferConfig, Worlds

DEFAULT = GARATConfig()
PAPER = garat_paper(PAIRS["inverted_pendulum_heavy"])
PAPER_PPO = PPOConfig(initial_log_std=DEFAULT.transformer.initial_log_std)


def vary(**changes: Any) -> dict[str, Any]:
    """Return changes to a TransferConfig that change the default GARATConfig."""
    return {"grounding": dataclasses.replace(DEFAULT, **changes)}


def vary_ppo(**changes: Any) -> dict[str, Any]:
    """Return changes to a TransferConfig that change the transformer's PPO."""
    return vary(transformer=dataclasses.replace(DEFAULT.transformer, **changes))


VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "the paper read literally": {
        "grounding": garat_paper(PAIRS["inverted_pendulum_heavy"]).grounding
    },
    "rewards not centred": vary(centre_reward=False),
    "one discriminator step an update": vary(num_minibatches=1),
    "the paper's PPO, initial deviation small": vary(transformer=PAPER_PPO),
    "γ 0.99 and λ 0.95 for the transformer": vary_ppo(discount=0.99, trace=0.95),
    "initial deviation of one half-range": vary_ppo(initial_log_std=0.0),
    "absolute output": vary(output="absolute"),
    "changes of up to 2 half-ranges": vary(reach=2.0),
    "discriminator's learning rate 3e-4": vary(learning_rate=3e-4),
    "gradient penalty 1": vary(gradient_penalty=1.0),
    "no L2 on the weights": vary(weight_penalty=0.0),
    "L2 on the weights 1e-2": vary(weight_penalty=1e-2),
    "L2 on the weights 1e-1": vary(weight_penalty=1e-1),
    "1,000 target transitions": {"num_target_transitions": 1000},
}


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measure GARAT's settings one by one."""

    pair: str = "inverted_pendulum_heavy"
    """The pair to ground."""
    seeds: int = 3
    """How many seeds: 0, 1, ..."""
    updates: int = 50
    """Adversarial updates."""
    only: tuple[str, ...] = ()
    """Variants to run; all by default. Only a whole table is written to the results."""


def make_experiment(config: TransferConfig, folder: Path) -> Experiment:
    """Build the worlds and the host loop of the transfer experiment."""
    task, pair = config.pair.task, config.pair
    source = make_world(task, pair.source, engine=config.engine)
    target = make_world(task, pair.target, engine=config.engine)
    worlds = Worlds(source, target, trpo.make(source.env, config.agent))
    seeds = range(config.seeds)
    keys = jax.vmap(jax.random.key)(jnp.asarray(seeds))
    return Experiment(config, Trainer(new_run(folder, seeds), seeds), worlds, keys)


def new_run(folder: Path, seeds: range) -> RunDirectory:
    return RunDirectory.create(folder, {}, "", seeds)


def measure(experiment: Experiment, policy, recorded: Recorded, held_out: Recorded) -> dict:
    """Ground every seed and return the last update's numbers."""
    try:
        experiment.ground(policy, recorded, held_out)
    except DivergedError as error:
        return {"error_ratio": None, "mean": None, "worst": None, "note": str(error)}
    curve = list(experiment.trainer.run.metrics())
    ratios = np.asarray(curve[-1]["error_ratio"])
    return {
        "error_ratio": ratios,
        "mean": ratios.mean(),
        "worst": ratios.max(),
        "lowest_on_the_way": np.min([line["error_ratio"] for line in curve], axis=0),
        "discriminator_accuracy": np.mean(curve[-1]["discriminator_accuracy"]),
        "update": curve[-1]["step"],
    }


def baselines(experiment: Experiment, recorded: Recorded, held_out: Recorded) -> list[dict]:
    """Return the ratios of what needs no learning: no action, and the best constant one."""
    source = experiment.worlds.source

    def ratios(recorded: Recorded, held_out: Recorded):
        best = best_constant(source.env, source.params, recorded)
        zero = constant_error(source.env, source.params, held_out, 0.0).mean
        constant = constant_error(source.env, source.params, held_out, best).mean
        plain = transition_error(source.env, source.params, held_out).mean
        return jnp.stack([zero, constant]) / plain

    found = np.asarray(experiment.map(ratios, recorded, held_out)).T
    names = ("baseline: zero action", "baseline: the best constant action")
    return [
        {"variant": name, "error_ratio": row, "mean": row.mean(), "worst": row.max()}
        for name, row in zip(names, found, strict=True)
    ]


def run_variants(arguments: Arguments, folder: Path) -> list[dict[str, Any]]:
    """Train the source policies, run the variants, print and return the rows."""
    pair = choose("pair", arguments.pair, PAIRS)
    config = dataclasses.replace(garat(pair, seeds=arguments.seeds), num_updates=arguments.updates)
    experiment = make_experiment(config, folder / "shared")
    policy = experiment.solve("source policy", experiment.worlds.source).state.policy
    held_out = experiment.record(policy, "held-out transitions")
    recorded = experiment.record(policy, "target transitions")
    rows = baselines(experiment, recorded, held_out)
    for row in rows:
        show(row)
    for number, name in enumerate(arguments.only or VARIANTS):
        changes = choose("variant", name, VARIANTS)
        run = new_run(folder / str(number), range(arguments.seeds))
        variant = dataclasses.replace(
            experiment,
            config=dataclasses.replace(config, **changes),
            trainer=Trainer(run, experiment.trainer.seeds),
        )
        data = variant.record(policy, "target transitions")
        rows.append({"variant": name, **measure(variant, policy, data, held_out)})
        show(rows[-1])
    return rows


def show(row: dict[str, Any]) -> None:
    numbers = "diverged" if row["mean"] is None else f"{row['mean']:.3f} | {row['worst']:.3f}"
    print(f"| {row['variant']} | {numbers} |", flush=True)


def main() -> None:
    arguments = tyro.cli(Arguments)
    print("| variant | error ratio, mean | worst seed |")
    with tempfile.TemporaryDirectory() as folder:
        rows = run_variants(arguments, Path(folder))
    if not arguments.only:
        command = f"python benchmarks/figures/grounding_variants.py --seeds {arguments.seeds}"
        if arguments.updates != Arguments.updates:
            command += f" --updates {arguments.updates}"
        seeds = range(arguments.seeds)
        print(write_result("grounding_variants", rows, seeds=list(seeds), command=command))


if __name__ == "__main__":
    main()
