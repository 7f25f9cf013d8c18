"""The transfer experiment: train in the source, ground it, retrain, evaluate in the target.

Desai et al. 2020 (arXiv 2008.01594), algorithm 1, with every seed a row of one program. Beside
the method stand two controls, which say whether grounding did the work: as much more training in
the ungrounded source, and training with action noise alone.
"""

import dataclasses
import zlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from garat_jax import rollout, split, summary, train
from garat_jax.agents import trpo
from garat_jax.agents.actor_critic import ActorCriticState, PolicyParams
from garat_jax.agents.trpo import TRPOConfig
from garat_jax.compiler_options import compiler_options
from garat_jax.dynamics import Override
from garat_jax.effects import Effect
from garat_jax.env import Env, Task, World, make_world
from garat_jax.errors import check_at_least
from garat_jax.methods.garat import GARATConfig
from garat_jax.methods.gat import GATConfig
from garat_jax.methods.grounded import GroundedEnv, Grounding, action_noise, check_bounded
from garat_jax.methods.make import make_method
from garat_jax.methods.transition_error import (
    best_constant,
    check_differs,
    constant_error,
    transition_error,
)
from garat_jax.rollout import Recorded
from garat_jax.runs import RunDirectory
from garat_jax.train import Trainer, UntilSolved
from garat_jax.types import Agent, Params


@dataclasses.dataclass(frozen=True)
class Pair:
    """A source and a target world of one task.

    Attributes:
        name: Its name.
        summary: One line that says what differs.
        task: What both worlds ask of the agent.
        source: Overrides that make the source.
        target: Overrides that make the target.
        source_effects: Physical effects that the source has.
        target_effects: Physical effects that the target has.
        agent: Settings with which an agent learns either world.
        max_iterations: Of training a policy until it solves either world.
    """

    name: str
    summary: str
    task: Task
    source: tuple[Override, ...]
    target: tuple[Override, ...]
    source_effects: tuple[Effect, ...] = ()
    target_effects: tuple[Effect, ...] = ()
    agent: TRPOConfig = dataclasses.field(default_factory=TRPOConfig)
    max_iterations: int = 200

    def worlds(self, engine: str = "auto") -> tuple[World, World]:
        """Compile the source and the target."""
        return (
            make_world(self.task, self.source, self.source_effects, engine),
            make_world(self.task, self.target, self.target_effects, engine),
        )


@dataclasses.dataclass(frozen=True)
class TransferConfig:
    """Settings of one transfer experiment; presets give tuned ones.

    Raises:
        UserError: There is nothing to train, to learn from or to evaluate on.
    """

    pair: Pair
    method: str
    seeds: int = 5
    first_seed: int = 0
    engine: str = "auto"
    agent: TRPOConfig = dataclasses.field(default_factory=TRPOConfig)
    grounding: GARATConfig | GATConfig = dataclasses.field(default_factory=GARATConfig)
    max_iterations: int | None = None  # of training a policy until it solves; None for the pair's
    num_updates: int = 50  # of the action transformer, Desai et al. 2020
    num_retraining: int = 60  # iterations of the agent in the grounded source
    num_target_transitions: int = 5000
    num_curve_transitions: int = 1000  # for the error after each update, and the best constant
    action_noise: float = 0.135  # half-ranges: the transformer's initial standard deviation
    num_episodes: int = 50  # Desai et al. 2020
    num_solving_episodes: int = 20

    def __post_init__(self) -> None:
        """Refuse what would fail after hours."""
        check_at_least(self, num_updates=0, num_retraining=0, first_seed=0)
        check_at_least(self, seeds=1, num_episodes=1, num_solving_episodes=1)
        check_at_least(self, num_curve_transitions=1, num_target_transitions=self.agent.num_envs)


@dataclasses.dataclass(frozen=True)
class GroundConfig:
    """Settings of grounding on measurements; presets give tuned ones.

    Attributes:
        method: Its name.
        learner: Its settings.
        num_updates: Of the action transformer.
        num_transitions: Most recorded control steps that it learns from, drawn at random.
        num_held_out: Most held-out control steps that the transition error is measured on.
        episode: Seconds that a rollout in the source goes on from a recorded state.

    Raises:
        UserError: There is nothing to learn, to learn from or to measure on.
    """

    method: str
    learner: GARATConfig | GATConfig
    num_updates: int
    num_transitions: int = 5000  # Desai et al. 2020
    num_held_out: int = 2000
    episode: float = 0.5

    def __post_init__(self) -> None:
        """Refuse what would fail when it has been learned."""
        check_at_least(self, num_updates=1, num_transitions=1, num_held_out=1, episode=0)

    def reaching(self, reach: float) -> GARATConfig | GATConfig:
        """Return the learner's settings, GARAT's with a reach in half-ranges of the action."""
        if isinstance(self.learner, GATConfig):
            return self.learner
        return dataclasses.replace(self.learner, reach=reach)


@dataclasses.dataclass(frozen=True)
class Worlds:
    """The two worlds and the agent that lives in them."""

    source: World
    target: World
    agent: Agent


@dataclasses.dataclass(frozen=True)
class Experiment:
    """One run of the protocol.

    Attributes:
        config: Its settings.
        trainer: Its host loop.
        worlds: Its worlds and agent.
        keys: One PRNG key a seed, [seeds].
    """

    config: TransferConfig
    trainer: Trainer
    worlds: Worlds
    keys: jax.Array

    def solve(self, stage: str, world: World) -> UntilSolved:
        """Train policies [seeds] from scratch until each solves a world, and say which did."""
        config, agent = self.config, self.worlds.agent

        def evaluate(state: ActorCriticState, params: Params, key: jax.Array, wanted):
            episodes = config.num_solving_episodes
            returns, faulty_share = rollout.evaluate(
                world.env, params, agent.policy, state.policy, key, episodes, wanted
            )
            return returns.mean(), faulty_share

        def start(key: jax.Array) -> UntilSolved:
            init_key, key = jax.random.split(key)
            return UntilSolved.start(agent.init(init_key, world.params), key)

        step = train.until_solved(agent.step, evaluate, config.pair.task.solved_return)
        return self.train(
            stage,
            step,
            self.map(start, _fold(self.keys, stage)),
            world.params,
            config.pair.max_iterations if config.max_iterations is None else config.max_iterations,
            world,
        )

    def retrain(self, stage: str, env: Env, params: Params, start: ActorCriticState, axes=None):
        """Train policies [seeds] further in an environment; `axes` as `vmap`'s for `params`."""
        agent = trpo.make(env, self.config.agent)

        def move(state: ActorCriticState, key: jax.Array, params: Params) -> ActorCriticState:
            reset_key, key = jax.random.split(key)
            num_envs = self.config.agent.num_envs
            return state._replace(env=rollout.reset(env, params, reset_key, num_envs), key=key)

        state = self.map(move, start, _fold(self.keys, stage), params, axes=(0, 0, axes))
        return self.train(
            stage,
            lambda state, params: agent.step(state, params)[:2],
            state,
            params,
            self.config.num_retraining,
            self.worlds.source,
            axes,
        )

    def train(self, stage: str, step, state, params, num_iterations: int, world: World, axes=None):
        """Run a stage with one learner a seed."""
        return self.trainer.train(
            stage,
            split.over_seeds(step, (0, axes), self.trainer.mesh),
            state,
            params,
            num_iterations,
            compiler_options(world.params),
        )

    def map(self, function, *arguments, axes: Any = 0) -> Any:
        """Apply a function to the arguments of every seed; `axes` as `vmap`'s."""
        options = compiler_options(self.worlds.source.params)
        function = split.over_seeds(function, axes, self.trainer.mesh)
        return self.trainer.call(function, *arguments, options=options)

    def map_guarded(self, what: str, function, *arguments, axes: Any = 0) -> Any:
        """As `map`, of a function whose second result is a share of faulty steps, to be told."""
        result, faulty_share = self.map(function, *arguments, axes=axes)
        self.trainer.check_faults(what, np.asarray(faulty_share))
        return result

    def target_returns(self, policy: PolicyParams, stage: str) -> np.ndarray:
        """Return the mean return of stochastic policies [seeds] in the target, [seeds]."""
        target, agent = self.worlds.target, self.worlds.agent

        def evaluate(policy: PolicyParams, key: jax.Array):
            episodes = self.config.num_episodes
            returns, faulty_share = rollout.evaluate(
                target.env, target.params, agent.policy, policy, key, episodes
            )
            return returns.mean(), faulty_share

        what = f"{stage} evaluation"
        return np.asarray(self.map_guarded(what, evaluate, policy, _fold(self.keys, what)))

    def record(self, policy: PolicyParams, name: str) -> Recorded:
        """Roll policies [seeds] out in the target: transitions and states, [seeds, T, B]."""
        target, agent = self.worlds.target, self.worlds.agent
        num_envs = self.config.agent.num_envs

        def collect(policy: PolicyParams, key: jax.Array):
            length = self.config.num_target_transitions // num_envs
            recorded = rollout.record(
                target.env, target.params, agent.policy, policy, key, num_envs, length
            )
            faulty = recorded.transitions.faulty
            transitions, states = rollout.without_faults(recorded, faulty)
            executed = transitions._replace(action=target.env.clip(transitions.action))
            return rollout.as_of(
                self.worlds.source, target, Recorded(executed, states)
            ), faulty.mean()

        return self.map_guarded(name, collect, policy, _fold(self.keys, name))

    def ground(self, agent_policy: PolicyParams, recorded: Recorded, held_out: Recorded):
        """Learn action transformers [seeds]; return the method and their final states."""
        source, agent = self.worlds.source, self.worlds.agent
        method = make_method(source.env, agent.policy, self.config.grounding)
        target = jax.tree.map(
            lambda x: x.reshape(x.shape[0], x.shape[1] * x.shape[2], *x.shape[3:]),
            recorded.transitions,
        )
        arguments = (_fold(self.keys, "grounding"), source.params, agent_policy, target)
        start = self.map(method.init, *arguments, axes=(0, None, 0, 0))

        def step(state, params):
            env_params, agent_policy, target, held_out, source_error = params
            state, metrics = method.step(state, env_params, agent_policy, target)
            grounding = Grounding(env_params, state.transformer.policy)
            error, faulty_share = transition_error(method.grounded, grounding, held_out)
            errors = {"error": error, "error_ratio": error / source_error}
            return state, metrics | errors | {f"error_{train.FAULTY}": faulty_share}

        held_out = rollout.thinned(held_out, self.config.num_curve_transitions)
        source_error = self.source_error(held_out)
        check_differs(np.asarray(source_error))
        params = (source.params, agent_policy, target, held_out, source_error)
        axes = (None, 0, 0, 0, 0)
        updates = self.config.num_updates
        state = self.train("grounding", step, start, params, updates, source, axes)
        return method, state

    def source_error(self, held_out: Recorded) -> jax.Array:
        """Return the ungrounded source's transition error, [seeds]."""
        source = self.worlds.source

        def error(held_out: Recorded):
            return transition_error(source.env, source.params, held_out)

        return self.map_guarded("the source's error", error, held_out)


def run_transfer(config: TransferConfig, run: RunDirectory) -> dict[str, Any]:
    """Run the experiment; write `summary.json` and return what is in it."""
    task = config.pair.task
    source, target = config.pair.worlds(config.engine)
    check_bounded(source.env)
    run.record_settings(dataclasses.replace(config, engine=source.params.engine))
    agent = trpo.make(source.env, config.agent)
    seeds = range(config.first_seed, config.first_seed + config.seeds)
    trainer = Trainer(run, seeds, mesh=split.make_mesh(config.seeds, config.agent.num_envs))
    keys = jax.vmap(jax.random.key)(jnp.asarray(trainer.seeds))
    experiment = Experiment(config, trainer, Worlds(source, target, agent), keys)

    source_learner = experiment.solve("source policy", source)
    source_state = source_learner.state
    target_state = experiment.solve("target policy", target).state
    recorded = experiment.record(source_state.policy, "target transitions")
    held_out = experiment.record(source_state.policy, "held-out transitions")
    method, grounding = experiment.ground(source_state.policy, recorded, held_out)

    transformer = grounding.transformer.policy
    axes = Grounding(None, 0)
    grounded_state = experiment.retrain(
        "grounded policy",
        method.grounded,
        Grounding(source.params, transformer),
        source_state,
        axes,
    )
    noisy = GroundedEnv(source.env, action_noise(source.env))
    more_state, noise_state = (
        experiment.retrain(stage, noisy, Grounding(source.params, jnp.asarray(scale)), source_state)
        for stage, scale in (("more source training", 0.0), ("action noise", config.action_noise))
    )
    states = {
        "source_policy": source_state,
        "target_policy": target_state,
        "method": grounded_state,
        "more_source_training": more_state,
        "action_noise": noise_state,
    }
    returns = {
        name: experiment.target_returns(state.policy, name) for name, state in states.items()
    }
    errors = _errors(experiment, method.grounded, transformer, recorded, held_out)
    result = summary.summarise(
        pair=config.pair.name,
        method=config.method,
        seeds=list(trainer.seeds),
        solved_return=task.solved_return,
        source_solved=np.asarray(source_learner.solved),
        returns=returns,
        errors=errors,
        curve=[line for line in run.metrics() if line["stage"] == "grounding"],
        target_transitions=recorded.transitions.reward[0].size,
        num_episodes=config.num_episodes,
        env_steps={
            name: np.asarray(state.env_steps)
            for name, state in (states | {"grounding": grounding.transformer}).items()
        },
        seconds=dataclasses.asdict(trainer.seconds),
    )
    run.write_json("summary.json", result)
    summary.write_report(run, result, config.pair.summary)
    return result


def _fold(keys: jax.Array, name: str) -> jax.Array:
    """Return keys [seeds] for a named purpose."""
    number = zlib.crc32(name.encode())
    return jax.vmap(lambda key: jax.random.fold_in(key, number))(keys)


def _errors(
    experiment: Experiment,
    grounded: Env,
    transformer: Params,
    recorded: Recorded,
    held_out: Recorded,
) -> dict[str, np.ndarray]:
    """Return held-out transition errors [seeds] of source, grounded source and baselines."""
    source = experiment.worlds.source
    recorded = rollout.thinned(recorded, experiment.config.num_curve_transitions)

    def errors(transformer: Params, recorded: Recorded, held_out: Recorded):
        best = best_constant(source.env, source.params, recorded)
        grounding = Grounding(source.params, transformer)
        return {
            "source": transition_error(source.env, source.params, held_out),
            "grounded": transition_error(grounded, grounding, held_out),
            "zero_action": constant_error(source.env, source.params, held_out, 0.0),
            "constant_action": constant_error(source.env, source.params, held_out, best),
        }

    found = experiment.map(errors, transformer, recorded, held_out)
    for name, error in found.items():
        experiment.trainer.check_faults(f"{name} error", np.asarray(error.faulty_share))
    return {name: np.asarray(error.mean) for name, error in found.items()}
