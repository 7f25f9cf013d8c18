"""The sides of brax.training's and rejax's PPO on our worlds."""

# pyright: reportMissingImports=false
import functools
import importlib.metadata
import queue
import threading
from typing import Any

import flax.linen as nn
import jax
from brax.training.agents.ppo import networks as brax_networks
from brax.training.agents.ppo import train as brax_ppo

from garat_jax.adapters import brax_on_new_jax, to_brax
from garat_jax.agents.ppo import PPOConfig
from garat_jax.compiler_options import compiler_options
from garat_jax.env import World

from .sides import Side

CONFIG = PPOConfig()
BATCH = CONFIG.num_envs * CONFIG.num_steps
FOREVER = 10_000
"""Epochs that Brax is asked for; it is stopped before."""


class NoMoreEpochsError(Exception):
    """Leaves Brax's training when no more epochs are wanted."""


class BraxTraining:
    """Brax's PPO in a thread of its own, which goes on by one epoch at a time.

    Brax's `train` is a function with a loop inside. It calls back after each epoch, and is held
    there until the next one is wanted.
    """

    def __init__(self, world: World, iterations: int):
        self._go: queue.Queue[bool] = queue.Queue()
        self._done: queue.Queue[BaseException | None] = queue.Queue()
        self._world, self._iterations = world, iterations
        self._thread = threading.Thread(target=self._train, daemon=True)
        self._thread.start()

    def epoch(self) -> None:
        """Take one epoch: so many iterations as were asked for."""
        self._go.put(True)
        error = self._done.get()
        if error is not None:
            raise error

    def close(self) -> None:
        """End the training."""
        self._go.put(False)
        self._thread.join()

    def _wait(self) -> None:
        if not self._go.get():
            raise NoMoreEpochsError

    def _progress(self, steps: int, metrics: Any) -> None:
        del steps, metrics
        self._done.put(None)
        self._wait()

    def _train(self) -> None:
        try:
            self._wait()
            with brax_on_new_jax():
                self._brax()
        except NoMoreEpochsError:
            pass
        except BaseException as error:  # handed to whoever waits for the epoch
            self._done.put(error)

    def _brax(self) -> None:
        brax_ppo.train(
            to_brax(self._world.env, self._world.params),
            num_timesteps=FOREVER * self._iterations * BATCH,
            num_evals=FOREVER + 1,
            run_evals=False,
            episode_length=self._world.env.episode_length,
            num_envs=CONFIG.num_envs,
            unroll_length=CONFIG.num_steps,
            batch_size=CONFIG.num_envs // CONFIG.num_minibatches,
            num_minibatches=CONFIG.num_minibatches,
            num_updates_per_batch=CONFIG.num_epochs,
            learning_rate=CONFIG.learning_rate,
            discounting=CONFIG.discount,
            gae_lambda=CONFIG.trace,
            clipping_epsilon=CONFIG.clip,
            vf_loss_coefficient=CONFIG.value_weight,
            entropy_cost=CONFIG.entropy_weight,
            max_grad_norm=CONFIG.max_grad_norm,
            normalize_observations=True,
            network_factory=functools.partial(
                brax_networks.make_ppo_networks,
                policy_hidden_layer_sizes=CONFIG.hidden,
                value_hidden_layer_sizes=CONFIG.hidden,
                activation=nn.tanh,
            ),
            seed=0,
            progress_fn=self._progress,
        )


def brax_side(env_name: str, world: World, iterations: int) -> Side:
    """Return Brax's PPO with the hyper-parameters of ours."""
    training = BraxTraining(world, iterations)
    training.epoch()
    row = _row(env_name, world, "brax")
    return Side(row, training.epoch, BATCH * iterations, training.close)


def rejax_side(env_name: str, world: World, iterations: int) -> Side:
    """Return rejax's PPO with the hyper-parameters of ours, its clipping of gradients included."""
    from rejax import PPO

    from .gymnax_side import as_gymnax

    env, params = as_gymnax(world.env, world.params)
    ppo = PPO.create(
        env=env,
        env_params=params,
        agent_kwargs={"activation": "tanh", "hidden_layer_sizes": CONFIG.hidden},
        num_envs=CONFIG.num_envs,
        num_steps=CONFIG.num_steps,
        num_epochs=CONFIG.num_epochs,
        num_minibatches=CONFIG.num_minibatches,
        learning_rate=CONFIG.learning_rate,
        gamma=CONFIG.discount,
        gae_lambda=CONFIG.trace,
        clip_eps=CONFIG.clip,
        vf_coef=CONFIG.value_weight,
        ent_coef=CONFIG.entropy_weight,
        max_grad_norm=CONFIG.max_grad_norm,
        normalize_observations=True,
    )
    state = ppo.init_state(jax.random.key(0))
    options = compiler_options(world.params)
    step = jax.jit(ppo.train_iteration, compiler_options=options).lower(state).compile()
    held = [jax.block_until_ready(step(state))]

    def run() -> None:
        for _ in range(iterations):
            held[0] = step(held[0])
        jax.block_until_ready(held[0])

    return Side(_row(env_name, world, "rejax"), run, BATCH * iterations)


def _row(env_name: str, world: World, library: str) -> dict[str, Any]:
    return {
        "env": env_name,
        "agent": f"{library} ppo",
        "engine": world.params.engine,
        "seeds": 1,
        "envs": CONFIG.num_envs,
        "steps": CONFIG.num_steps,
        "version": importlib.metadata.version(library),
    }
