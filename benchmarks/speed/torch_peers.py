"""The sides of stable-baselines3 and sb3-contrib, at the size and the threads that suit them."""

# pyright: reportMissingImports=false
import importlib.metadata
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium import make
from gymnasium.spaces import flatdim
from sb3_contrib import TRPO
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from garat_jax.adapters import to_gymnasium_vector
from garat_jax.agents.ppo import PPOConfig
from garat_jax.agents.trpo import TRPOConfig
from garat_jax.env import World

from .sides import Side, seconds_of

BATCH = 5000
"""Steps in an iteration, as in the presets."""
GYMNASIUM = {
    "inverted_pendulum": "InvertedPendulum-v5",
    "hopper": "Hopper-v5",
    "half_cheetah": "HalfCheetah-v5",
    "walker2d": "Walker2d-v5",
}
"""What Gymnasium calls its own environments."""
VECTOR, NATIVE = "to_gymnasium_vector", "Gymnasium's own"
NUM_ENVS = {VECTOR: (8, 50, 250), NATIVE: (1, 8)}
"""Numbers of environments that are tried, by how they are stepped."""
NUM_THREADS = (1, 2)
"""Numbers of torch's threads that are tried."""
TRIALS = 2
"""Timed iterations of each choice; the faster one counts."""


class VectorForBaselines(VecEnv):
    """A Gymnasium vector environment that resets within the step, as stable-baselines3 has them."""

    def __init__(self, vector: Any):
        self.vector = vector
        self._actions = None
        super().__init__(
            vector.num_envs, vector.single_observation_space, vector.single_action_space
        )

    def reset(self) -> np.ndarray:
        seeds = None if self._seeds[0] is None else self._seeds
        obs, _ = self.vector.reset(seed=seeds)
        self._reset_seeds()
        return obs

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        obs, reward, terminated, truncated, infos = self.vector.step(self._actions)
        done = terminated | truncated
        each: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(done):
            each[i] = {
                "terminal_observation": infos["final_obs"][i],
                "TimeLimit.truncated": bool(truncated[i]),
            }
        return obs, reward.astype(np.float32), done, each

    def close(self) -> None:
        self.vector.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.vector, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self.vector, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **named: Any) -> list:
        return [getattr(self.vector, method_name)(*args, **named)]

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False] * len(list(self._get_indices(indices)))


class Choice(NamedTuple):
    """How a peer is run.

    Attributes:
        stepped: How its environments are stepped: `VECTOR` or `NATIVE`.
        num_envs: How many.
        num_threads: Torch's threads.
    """

    stepped: str
    num_envs: int
    num_threads: int


def make_envs(env_name: str, world: World, num_envs: int, stepped: str = VECTOR) -> VecEnv:
    """Make the environments that a peer learns in."""
    if stepped == VECTOR:
        return VectorForBaselines(to_gymnasium_vector(world.env, world.params, num_envs))
    return DummyVecEnv([lambda: make(GYMNASIUM[env_name])] * num_envs)


def make_trpo(
    envs: VecEnv, seed: int = 0, shrinking: float = 0.5, config: TRPOConfig | None = None
) -> TRPO:
    """Build sb3-contrib's TRPO with the hyper-parameters of ours.

    The peer averages the KL divergence over the actions' components (`kl_divergence` of
    stable_baselines3 2.9.2, common/distributions.py, of independent normals), where Schulman et
    al. 2015 and ours sum them; its limit and its damping of the Fisher information, which is that
    divergence's Hessian, are divided by their number, so that the trust regions are the same.

    Ours normalises observations on top, which would cost the peer time, and leaves out the value's
    incomplete last minibatch. The peer takes the share of the batch on which ours estimates the
    Fisher information for the whole step of the policy, which costs it less. It takes a step only
    within its limit, ours within 1.5 times that; the library shrinks steps by 0.8, we by 0.5.
    """
    config = config or TRPOConfig()
    num_actions = flatdim(envs.action_space)
    return TRPO(
        "MlpPolicy",
        envs,
        learning_rate=config.value_learning_rate,
        n_steps=BATCH // envs.num_envs,
        batch_size=config.value_minibatch,
        gamma=config.discount,
        gae_lambda=config.trace,
        cg_max_steps=config.cg_iterations,
        cg_damping=config.cg_damping / num_actions,
        sub_sampling_factor=round(1 / config.fisher_share),
        line_search_shrinking_factor=shrinking,
        line_search_max_iter=config.line_search_steps,
        n_critic_updates=config.value_epochs,
        target_kl=config.max_kl / num_actions,
        policy_kwargs=_networks(config.hidden, config.initial_log_std),
        seed=seed,
        device="cpu",
    )


def make_ppo(envs: VecEnv) -> PPO:
    """Build stable-baselines3's PPO with the hyper-parameters of ours."""
    config = PPOConfig()
    return PPO(
        "MlpPolicy",
        envs,
        learning_rate=config.learning_rate,
        n_steps=BATCH // envs.num_envs,
        batch_size=BATCH // config.num_minibatches,
        n_epochs=config.num_epochs,
        gamma=config.discount,
        gae_lambda=config.trace,
        clip_range=config.clip,
        ent_coef=config.entropy_weight,
        vf_coef=config.value_weight,
        max_grad_norm=config.max_grad_norm,
        policy_kwargs=_networks(config.hidden, config.initial_log_std),
        seed=0,
        device="cpu",
    )


LEARNERS: dict[str, tuple[str, Callable[[VecEnv], Any]]] = {
    "trpo": ("sb3-contrib", make_trpo),
    "ppo": ("stable-baselines3", make_ppo),
}
"""By algorithm: the library and how its learner is made."""


def _networks(hidden: Sequence[int], log_std: float) -> dict[str, Any]:
    return {
        "net_arch": {"pi": list(hidden), "vf": list(hidden)},
        "activation_fn": torch.nn.Tanh,
        "log_std_init": log_std,
    }


def learn(learner: Any, choice: Choice, iterations: int) -> None:
    """Take iterations of a learner with the number of torch's threads that is its best."""
    torch.set_num_threads(choice.num_threads)
    learner.learn(BATCH * iterations, log_interval=None, reset_num_timesteps=False)


def sides(
    env_name: str, world: World, algorithms: Sequence[str], iterations: int
) -> tuple[list[Side], list[dict[str, Any]]]:
    """Return each peer at its best in a world, and what all the choices gave.

    A peer is a side twice: at its best in our world, and in Gymnasium's own where it has the world.
    """
    tried: list[dict[str, Any]] = []
    learners: dict[tuple[str, Choice], Any] = {}
    for stepped, num_envs in _sizes(env_name):
        envs = make_envs(env_name, world, num_envs, stepped)
        for algorithm in algorithms:
            library, make_learner = LEARNERS[algorithm]
            with warnings.catch_warnings():  # advice on batch sizes and on GPUs
                warnings.simplefilter("ignore")
                learner = make_learner(envs)
            for num_threads in NUM_THREADS:
                choice = Choice(stepped, num_envs, num_threads)
                learn(learner, choice, 1)
                seconds = min(
                    seconds_of(lambda: learn(learner, choice, 1))[0]  # noqa: B023
                    for _ in range(TRIALS)
                )
                row = {"env": env_name, "agent": f"{library} {algorithm}", **choice._asdict()}
                tried.append(row | {"steps_per_second": BATCH / seconds})
                print(*tried[-1].values(), flush=True)
                learners[algorithm, choice] = learner
    found = []
    for algorithm in algorithms:
        library, _ = LEARNERS[algorithm]
        for is_native in (False, True):
            rows = [
                row
                for row in tried
                if row["agent"] == f"{library} {algorithm}"
                and (row["stepped"] == NATIVE) == is_native
            ]
            if not rows:
                continue
            best = max(rows, key=lambda row: row["steps_per_second"])
            choice = Choice(best["stepped"], best["num_envs"], best["num_threads"])
            found.append(
                _side(env_name, algorithm, choice, learners[algorithm, choice], iterations)
            )
    return found, tried


def _sizes(env_name: str) -> Iterator[tuple[str, int]]:
    for stepped, numbers in NUM_ENVS.items():
        if stepped == NATIVE and env_name not in GYMNASIUM:
            continue
        for num_envs in numbers:
            yield stepped, num_envs


def _side(env_name: str, algorithm: str, choice: Choice, learner: Any, iterations: int) -> Side:
    library, _ = LEARNERS[algorithm]
    row = {
        "env": env_name,
        "agent": f"{library} {algorithm}",
        "engine": "mujoco",
        "seeds": 1,
        "envs": choice.num_envs,
        "steps": BATCH // choice.num_envs,
        "stepped": choice.stepped,
        "threads": choice.num_threads,
        "version": importlib.metadata.version(library),
        "torch": torch.__version__,
    }
    return Side(row, lambda: learn(learner, choice, iterations), BATCH * iterations)
