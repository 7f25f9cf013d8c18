"""A model with an action transformer before it: made after learning, read back from a run."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from garat_jax import checkpoint
from garat_jax.diagnosis.model_card import Model, load_model
from garat_jax.diagnosis.progress import tell
from garat_jax.dynamics import Dynamics, Override
from garat_jax.effects.catalogue import Catalogue
from garat_jax.errors import UserError, choose
from garat_jax.ground.steps import Bounds
from garat_jax.methods.make import make_method
from garat_jax.methods.recorded import RecordedEnv, Steps, as_transitions, clone, cloned
from garat_jax.plain import finite_or_null, to_plain
from garat_jax.runs import RunDirectory
from garat_jax.transfer import GroundConfig

FORMAT = "garat-ground/2"
CARD, SUMMARY, TRANSFORMER = "model.toml", "summary.json", "transformer"
"""What a run holds: the model's card, what came out, and the folder of the checkpoint."""


def make_source(
    model: Model, states: np.ndarray, noise: np.ndarray, bounds: Bounds, episode: float
) -> tuple[RecordedEnv, Dynamics]:
    """Build the source: the model, stepped by control intervals from recorded states.

    Args:
        model: The model.
        states: Where episodes begin, [N, nq + nv].
        noise: Standard deviation of the sensors' noise, [nq + nv].
        bounds: Control interval and range of commands.
        episode: Seconds of an episode.
    """
    host = model.compile(engine="mujoco").host.model
    substeps = max(1, int(np.ceil(bounds.interval / host.opt.timestep - 1e-6)))
    timestep = Override("option", "", "timestep", bounds.interval / substeps)
    world = dataclasses.replace(model, overrides=(*model.overrides, timestep)).compile()
    length = max(1, round(episode / bounds.interval))
    return RecordedEnv(states, noise, host, bounds.low, bounds.high, substeps, length), world


def load_grounded(
    root: str | Path,
    configs: Mapping[str, GroundConfig],
    catalogue: Catalogue | None = None,
    say: Callable[[str], None] = tell,
) -> Model:
    """Read a run of `garat ground`: its model, with the action transformer before it, if any.

    Args:
        root: The run directory.
        configs: The settings of each method by name.
        catalogue: The kinds of effect that there are.
        say: Told if the run found that the model is better without.

    Raises:
        UserError: There is no such run, or it was made with other settings.
    """
    root = Path(root)
    run = RunDirectory.open(root)
    if checkpoint.latest_step(root / TRANSFORMER) is None or not (root / SUMMARY).is_file():
        raise UserError(f"{root} holds no action transformer; expected a run of garat ground")
    summary = run.read_json(SUMMARY)
    if summary["format"] != FORMAT:
        raise UserError(f"{root} was written by another version of garat; ground the model again")
    config = choose("method", summary["method"], configs)
    _check_settings(root, summary.get("learner", {}), finite_or_null(to_plain(config.learner)))
    model = dataclasses.replace(load_model(root / CARD, catalogue), path=root)
    if not summary["chosen"]["update"]:
        say(f"{root}: no action transformer was better than none; this is the model as it is")
        return model
    error = summary["error"]
    if error["grounded"] is None or error["grounded"] > error["model"]:
        reached = error["grounded"]
        reached = "no number" if reached is None else f"{100 * reached:.3g} %"
        say(
            f"{root}: with its action transformer the held-out error rises from "
            f"{100 * error['model']:.3g} % to {reached}; the model is better without"
        )
    control = summary["control"]
    bounds = Bounds(control["interval"], np.asarray(control["low"]), np.asarray(control["high"]))
    host = model.compile(engine="mujoco").host.model
    start = np.zeros((1, host.nq + host.nv))
    start[0, : host.nq] = host.qpos0
    env, world = make_source(model, start, 0 * start[0], bounds, summary["episode"])
    steps = Steps(start, np.zeros((1, host.nu)), start)
    method = make_method(env, cloned(env), config.reaching(summary["reach"]))
    shapes = jax.eval_shape(
        method.init, jax.random.key(0), world, clone(env, steps), as_transitions(env, steps)
    )
    like = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes.transformer.policy)
    transformer = checkpoint.restore(root / TRANSFORMER, like)
    transform = with_transformer(method, env, transformer)
    return dataclasses.replace(model, transform=transform, interval=bounds.interval)


def _check_settings(root: Path, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Refuse settings other than those that a run was made with; older ones recorded none."""
    for name, value in before.items():
        if now.get(name) != value:
            raise UserError(
                f"{root} was made with {name} = {value}, here it is {now.get(name)}: ground the "
                "model again, or give load_grounded the settings that it was made with"
            )


def with_transformer(method, env: RecordedEnv, transformer):
    """Return `(state, command) -> command` in the precision that it is called with."""
    params = jax.tree.map(np.asarray, transformer)

    def transform(state: jax.Array, command: jax.Array) -> jax.Array:
        def new(x: np.ndarray) -> np.ndarray:  # for each program, as in `Env.clip`
            return np.array(x, state.dtype if np.issubdtype(x.dtype, np.floating) else x.dtype)

        key = jax.random.key(0)  # unused: a transformer's mean draws nothing
        return env.clip(method.transform(jax.tree.map(new, params), state, env.clip(command), key))

    return transform
