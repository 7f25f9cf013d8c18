"""Learn an action transformer of a model from recordings, and score it on held-out ones."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from garat_jax import checkpoint
from garat_jax.compiler_options import compiler_options
from garat_jax.diagnosis.compare import Comparison, compare
from garat_jax.diagnosis.diagnose import split
from garat_jax.diagnosis.measurements import Recording, noise
from garat_jax.diagnosis.model_card import Model
from garat_jax.diagnosis.segments import metric_spread
from garat_jax.dynamics import Dynamics
from garat_jax.ground.source import FORMAT, TRANSFORMER, make_source, with_transformer
from garat_jax.ground.steps import choose_bounds, control_paths, control_steps, draw, longest_path
from garat_jax.methods.garat import GARATConfig
from garat_jax.methods.gat import GATConfig
from garat_jax.methods.grounded import GroundedEnv, Grounding
from garat_jax.methods.make import make_method
from garat_jax.methods.recorded import (
    Paths,
    RecordedEnv,
    Steps,
    as_recorded,
    as_transitions,
    clone,
    cloned,
    exploring,
    needed_change,
    path_error,
)
from garat_jax.methods.transition_error import check_differs, constant_error, transition_error
from garat_jax.plain import to_plain
from garat_jax.runs import RunDirectory
from garat_jax.train import FAULTY, Trainer
from garat_jax.transfer import GroundConfig
from garat_jax.types import Params, Policy

MOST_PATHS = 100
"""Recorded paths that the updates of a transformer are compared on, drawn at random."""
FAR = 0.1
"""Standard deviations of recorded commands by which a given policy's may be off them."""
CHANCE = 4.0
"""Part, over the root of their number, by which chance may raise the mean square of differences."""
REACH = 3.0
"""Root mean squares of the needed change of a command that a transformer is prepared for."""


@dataclasses.dataclass(frozen=True)
class Grounded:
    """A model with an action transformer, and how it does on recordings that were held out.

    Attributes:
        model: The model; its predictions have the transformer, if one is better than none.
        comparison: Of the model as it was, with the grounded one beside it.
        summary: Content of summary.json.
    """

    model: Model
    comparison: Comparison
    summary: Mapping[str, Any]

    @property
    def warnings(self) -> Sequence[str]:
        """What speaks against what was learned, one line each."""
        return self.summary["warnings"]

    @property
    def sentence(self) -> str:
        """What grounding did to the held-out error, in one sentence."""
        if self.model.transform is None:
            return (
                "No update of the action transformer follows the recordings better than the model "
                "does, which stays as it is: its held-out error is "
                f"{100 * self.comparison.error.before:.3g} % of the signals' spread; the noise "
                f"floor is {100 * self.comparison.error.noise_floor:.2g} %."
            )
        before, after = self.comparison.error.before, self.comparison.also[0].error
        verb, use = ("falls", "") if after < before else ("rises", " The model is better without.")
        return (
            f"With the action transformer the held-out error {verb} from {100 * before:.3g} % to "
            f"{100 * after:.3g} % of the signals' spread; the noise floor is "
            f"{100 * self.comparison.error.noise_floor:.2g} %.{use}"
        )


class Lesson(NamedTuple):
    """What a transformer is learned from.

    Attributes:
        env: The source.
        world: Its dynamics.
        agent: What acts in it.
        agent_params: The agent's parameters.
        seen: Recorded control steps to learn from.
        unseen: Those to measure the transition error on.
        paths: Recorded paths to choose the best update on.
        weight: What a squared error of each signal counts in that, [nq + nv].
    """

    env: RecordedEnv
    world: Dynamics
    agent: Policy
    agent_params: Params
    seen: Steps
    unseen: Steps
    paths: Paths
    weight: jax.Array


class Best(NamedTuple):
    """A method's state with the best of its transformers so far.

    Attributes:
        state: The method's.
        transformer: The best one's parameters.
        error: Its error on the paths, [].
        update: Which update made it, []; 0 if none is better than no transformer.
        updates: How many there were, [].
    """

    state: Any
    transformer: Params
    error: jax.Array
    update: jax.Array
    updates: jax.Array

    def after(self, state: Any, transformer: Params, error: jax.Array) -> "Best":
        """Return the best after one more update, which made a transformer with an error."""
        updates = self.updates + 1
        choose = functools.partial(jnp.where, error < self.error)
        kept = jax.tree.map(choose, transformer, self.transformer)
        return Best(state, kept, choose(error, self.error), choose(updates, self.update), updates)


def ground(
    model: Model,
    recordings: Sequence[Recording],
    config: GroundConfig,
    run: RunDirectory,
    *,
    holdout: Sequence[Recording] = (),
    policy: Policy | None = None,
    interval: float | None = None,
    seed: int = 0,
    say: Callable[[str], None] = lambda message: None,
) -> Grounded:
    """Learn an action transformer of a model from recordings, and score it on held-out ones.

    Args:
        model: The source, with the effects that its card has.
        recordings: What was measured; some are held out as in `diagnose`.
        config: Settings.
        run: Where metrics and checkpoints go.
        holdout: Recordings to prove the result on.
        policy: What acted in the recordings, `(params, (qpos, qvel), key) -> (command, log_prob)`;
            cloned from the recorded commands if None.
        interval: Seconds of a control step; see `choose_bounds`.
        seed: Seed of networks, rollouts and draws.
        say: Told what is being done.

    Raises:
        UserError: As `choose_bounds` and `control_steps`.
    """
    fitted, held_out, how = split(recordings, holdout)
    bounds = choose_bounds(model, fitted, interval, held_out)
    rng = np.random.default_rng(seed)
    seen = draw(control_steps(fitted, bounds.interval), config.num_transitions, rng)
    unseen = draw(control_steps(held_out, bounds.interval), config.num_held_out, rng)
    deviation = np.sqrt(np.mean([noise(r) ** 2 for r in fitted], axis=0))
    env, world = make_source(model, seen.state, deviation, bounds, config.episode)
    agent, agent_params = (cloned(env), clone(env, seen)) if policy is None else (policy, ())
    has_discriminator = isinstance(config.learner, GARATConfig)
    warnings = warn_of_policy(env, policy, seen) if policy and has_discriminator else ()
    for warning in warnings:
        say(f"warning: {warning}")
    trainer = Trainer(run, [seed])
    say(f"learning an action transformer with {config.method}")
    num_steps = max(1, round(config.episode / bounds.interval))
    num_steps = min(num_steps, longest_path(fitted, bounds.interval))
    num_samples = sum(b - a for r in fitted for a, b in r.spans)
    every = max(1, num_samples // (10 * MOST_PATHS))
    paths = control_paths(fitted, bounds.interval, num_steps, every)
    paths = draw(paths, MOST_PATHS, rng)
    spread = metric_spread(paths.state.reshape(-1, env.obs_size), deviation)
    measured = np.arange(env.obs_size) < env.num_position
    measured |= all(r.velocity_measured for r in fitted)
    weight = jnp.asarray(measured / measured.mean() / spread**2, jnp.float32)
    lesson = Lesson(env, world, agent, agent_params, seen, unseen, paths, weight)
    reach = _choose_reach(lesson, trainer)
    method, transformer, learned = _learn(lesson, config, reach, trainer)
    chosen = learned["chosen"]["update"] > 0
    transform = with_transformer(method, env, transformer) if chosen else None
    grounded = dataclasses.replace(
        model, path=run.root, transform=transform, interval=bounds.interval
    )
    comparison = compare(model, held_out, say, [grounded])
    summary = {
        "format": FORMAT,
        "method": config.method,
        "learner": to_plain(config.learner),
        "model": str(model.path),
        "data": [r.name for r in fitted],
        "holdout": [r.name for r in held_out],
        "held_out": how,
        "policy": "cloned" if policy is None else "given",
        "warnings": warnings,
        "control": bounds._asdict(),
        "reach": reach,
        "episode": config.episode,
        "transitions": len(seen.state),
        **learned,
        "error": {
            "horizon": comparison.horizon,
            "model": comparison.error.before,
            "grounded": comparison.also[0].error,
            "noise_floor": comparison.error.noise_floor,
        },
        "seconds": dataclasses.asdict(trainer.seconds),
    }
    return Grounded(grounded, comparison, summary)


def warn_of_policy(env: RecordedEnv, policy: Policy, steps: Steps) -> tuple[str, ...]:
    """Warn where a given policy's commands are not those of recorded steps.

    A recorded step has the mean command, one in the source that of the policy at its beginning: a
    discriminator tells them apart by the commands alone. Differences such as between two draws of
    the policy do not count.
    """
    recorded = as_transitions(env, steps)
    keys = jax.random.split(jax.random.key(0), (2, len(steps.state)))
    act = jax.vmap(jax.vmap(policy, (None, 0, 0)), (None, None, 0))
    first, second = env.clip(act((), recorded.obs, keys)[0])
    action = np.asarray(recorded.action)
    apart, own = (np.mean(np.square(first - a), axis=0) for a in (action, second))
    spread = np.maximum(action.std(axis=0), 1e-5 * (env.action_high - env.action_low))
    by_chance = own * (1.0 + CHANCE / np.sqrt(len(action)))
    off = float(np.max(np.sqrt(np.maximum(apart - by_chance, 0.0)) / spread))
    if off <= FAR:
        return ()
    return (
        f"the recorded commands, means over control steps, are {off:.2g} of their standard "
        "deviations off the policy's at the beginning of each, by which the discriminator knows "
        "them: leave --policy out, and it is cloned, or record the policy's own commands at its "
        "own rate, a sample each, and give the time between them as --interval",
    )


def _choose_reach(lesson: Lesson, trainer: Trainer) -> float:
    """Return how far a transformer may have to change an action, in half-ranges, at most 1.

    It is 1 where no command did anything in the recorded states: nothing says how far.

    GARAT's transformer changes it at most so much, and starts with noise of a fixed share of that;
    GAT's source acts with noise of that size, so that its inverse model knows such commands. Were
    it the whole range, a small effect would drown in it.
    """
    env, world, seen = lesson.env, lesson.world, lesson.seen
    options = compiler_options(world)
    change = trainer.call(lambda w: needed_change(env, w, seen), world, options=options)
    if not change.any():
        return 1.0
    return float(min(1.0, np.max(REACH * change / ((env.action_high - env.action_low) / 2))))


def _learn(lesson: Lesson, config: GroundConfig, reach: float, trainer: Trainer):
    """Learn a transformer; return the method, the best parameters, and what summary.json tells."""
    env, world, agent, agent_params, seen, unseen, paths, weight = lesson
    if isinstance(config.learner, GATConfig):
        agent = exploring(env, agent, reach)
    method = make_method(env, agent, config.reaching(reach))
    options = compiler_options(world)
    target = as_transitions(env, seen)
    keys = jax.random.split(jax.random.key(trainer.seeds[0]), 1)
    init = jax.vmap(method.init, (0, None, None, None))
    state = trainer.call(init, keys, world, agent_params, target, options=options)
    quiet = env.without_noise()  # the recorded states have theirs already
    grounded = GroundedEnv(quiet, method.transform)
    free = quiet.unbounded()  # held-out commands may go further than those to learn from
    recorded = trainer.call(lambda w: as_recorded(free, w, unseen), world, options=options)
    errors = _errors(free, world, recorded, trainer, options)
    start = jax.vmap(quiet.at, (None, 0))
    starts = trainer.call(start, world, jnp.asarray(paths.start, jnp.float32), options=options)
    as_it_is = trainer.call(
        lambda w, s: path_error(quiet, w, s, paths, weight), world, starts, options=options
    )

    def update(best: Best, params):
        world, agent_params, target, recorded, starts = params
        state, metrics = method.step(best.state, world, agent_params, target)
        transformer = state.transformer.policy
        grounding = Grounding(world, transformer)
        error, faulty = transition_error(grounded, grounding, recorded)
        path = path_error(grounded, grounding, starts, paths, weight)
        best = best.after(state, transformer, path)
        told = {"error": error, "error_ratio": error / errors["source"], f"error_{FAULTY}": faulty}
        return best, metrics | told | {"path_error": path}

    none = jnp.zeros(1, jnp.int32)
    best = Best(state, state.transformer.policy, as_it_is[None], none, none)
    params = (world, agent_params, target, recorded, starts)
    step = jax.vmap(update, (0, None))
    best = trainer.train("grounding", step, best, params, config.num_updates, options)
    transformer = jax.tree.map(lambda x: x[0], best.transformer)
    folder = trainer.run.path(TRANSFORMER)
    if checkpoint.latest_step(folder) is None:
        checkpoint.save(folder, config.num_updates, transformer)
    chosen = int(best.update[0])
    lines = [line for line in trainer.run.metrics() if line["stage"] == "grounding"]
    errors["grounded"] = lines[chosen - 1]["error"][0] if chosen else errors["source"]
    return (
        method,
        transformer,
        {
            "transition_error": errors,
            "chosen": {
                "update": chosen,
                "path_error": float(best.error[0]),
                "path_error_of_model": float(as_it_is),
                "paths": len(paths.start),
                "steps": paths.action.shape[1],
            },
        },
    )


def _errors(env: RecordedEnv, world: Dynamics, recorded, trainer: Trainer, options):
    """Return the transition errors of the source, and of the source with every action zero."""

    def both(world, recorded):
        return {
            "source": transition_error(env, world, recorded),
            "zero_action": constant_error(env, world, recorded, 0.0),
        }

    found = trainer.call(both, world, recorded, options=options)
    for name, error in found.items():
        trainer.check_faults(f"{name} error", np.asarray(error.faulty_share)[None])
    check_differs(np.asarray(found["source"].mean))
    return {name: float(error.mean) for name, error in found.items()}
