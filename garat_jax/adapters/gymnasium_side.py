"""Our environments as Gymnasium's, one by one or as a vector.

What they return are copies: NumPy shows JAX's arrays as they are, and nobody may write to those.
"""

import functools
import warnings
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from garat_jax.env import Env, EnvState, GuardedStep, StepResult, guarded_step
from garat_jax.types import Params

FAULTY = "faulty"
"""Where `info` says that physics left the finite numbers in a step, which ended the episode."""


def _spaces(env: Env) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Return the spaces of observations and actions."""
    observations = gymnasium.spaces.Box(-np.inf, np.inf, (env.obs_size,), np.float32)
    low, high = (np.asarray(x, np.float32) for x in (env.action_low, env.action_high))
    return observations, gymnasium.spaces.Box(low, high, dtype=np.float32)


def _check_no_options(options: dict[str, Any] | None) -> None:
    if options:
        raise ValueError(f"there are no options, not {', '.join(options)}")


def _as_actions(actions: Any, space: gymnasium.spaces.Space) -> np.ndarray:
    """Return actions as an array of a space's shape; bounds are the environment's to keep."""
    array = np.asarray(actions, np.float32)
    if array.shape != space.shape:
        raise ValueError(f"actions of shape {array.shape}; expected {space.shape}")
    return array


def _first_key(random: np.random.Generator) -> jax.Array:
    return jax.random.key(int(random.integers(2**31)))


def _start(env: Env, params: Params, key: jax.Array) -> tuple[EnvState, jax.Array]:
    """Start an episode; return its state and the key that follows."""
    reset_key, key = jax.random.split(key)
    return env.reset(params, reset_key), key


def _warn_of_faults(count: int) -> None:
    warnings.warn(
        f"physics left the finite numbers in {count} step{'s' if count > 1 else ''}, which ended "
        "with the last sound observation and no reward",
        RuntimeWarning,
        stacklevel=3,
    )


class GymnasiumEnv(gymnasium.Env):
    """One of our environments as Gymnasium's; see `to_gymnasium`."""

    def __init__(self, env: Env, params: Params):
        self.metadata = {"render_modes": []}
        self.render_mode = None
        self.observation_space, self.action_space = _spaces(env)
        self._params = params
        self._state = self._key = None

        def step(params: Params, state: EnvState, action: jax.Array, key: jax.Array):
            step_key, key = jax.random.split(key)
            return guarded_step(env, params, state, action, step_key), key

        self._start = jax.jit(lambda params, key: _start(env, params, key))
        self._step = jax.jit(step)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; a seed fixes this and all that follow.

        Raises:
            ValueError: Options are given; there are none.
        """
        _check_no_options(options)
        super().reset(seed=seed)
        if seed is not None or self._key is None:
            self._key = _first_key(self.np_random)
        self._state, self._key = self._start(self._params, self._key)
        return np.array(self._state.obs, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Take one guarded step; `info["faulty"]` is true where physics left the finite numbers.

        Raises:
            ResetNeeded: The environment has not been reset yet.
            ValueError: The action has another shape than the space.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before the first step")
        action = _as_actions(action, self.action_space)
        (result, faulty, _), self._key = self._step(self._params, self._state, action, self._key)
        self._state = result.state
        obs = np.array(result.state.obs, np.float32)
        info = {FAULTY: True} if faulty else {}
        if faulty:
            _warn_of_faults(1)
        return obs, float(result.reward), bool(result.terminated), bool(result.truncated), info


class GymnasiumVectorEnv(gymnasium.vector.VectorEnv):
    """A batch of our environments as Gymnasium's vector; see `to_gymnasium_vector`.

    Each of them does what a `GymnasiumEnv` with its seed does.
    """

    def __init__(self, env: Env, params: Params, num_envs: int, same_step: bool = True):
        if num_envs < 1:
            raise ValueError(f"num_envs is {num_envs}; expected 1 or more")
        mode = AutoresetMode.SAME_STEP if same_step else AutoresetMode.NEXT_STEP
        self.num_envs = num_envs
        self.metadata = {"render_modes": [], "autoreset_mode": mode}
        self.render_mode = None
        self.single_observation_space, self.single_action_space = _spaces(env)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._params = params
        self._states = self._keys = self._over = None
        self._seeds = np.full(num_envs, None, object)
        self._same_step = same_step
        step = functools.partial(_step_and_reset if same_step else _reset_or_step, env)
        self._start = jax.jit(jax.vmap(lambda params, key: _start(env, params, key), (None, 0)))
        self._step = jax.jit(jax.vmap(step, (None, 0, 0, 0, 0)))

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode in each; a seed is that of the first, the others count up from it.

        Of a list of seeds, those environments that have None go on with what they would draw next.

        Raises:
            ValueError: There is another number of seeds than of environments, or options are given.
        """
        _check_no_options(options)
        seeds = [seed] * self.num_envs if seed is None else seed
        if isinstance(seeds, int):
            seeds = [seeds + i for i in range(self.num_envs)]
        if len(seeds) != self.num_envs:
            raise ValueError(f"{len(seeds)} seeds for {self.num_envs} environments")
        anew = [i for i, seed in enumerate(seeds) if self._keys is None or seed is not None]
        if anew:
            randoms, self._seeds[anew] = zip(
                *(seeding.np_random(seeds[i]) for i in anew), strict=True
            )
            keys = jnp.stack([_first_key(random) for random in randoms])
            self._keys = keys if self._keys is None else self._keys.at[np.asarray(anew)].set(keys)
        self._states, self._keys = self._start(self._params, self._keys)
        self._over = np.zeros(self.num_envs, bool)
        return np.array(self._states.obs, np.float32), {}

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return the seed of each environment, as Gymnasium's own vectors do."""
        return tuple(self._seeds)

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take one guarded step in each, and reset those whose episode ended: now or before.

        Where physics left the finite numbers, `infos["faulty"]` says so, or
        `infos["final_info"]["faulty"]` where an environment is reset within the step.

        Raises:
            ResetNeeded: The environments have not been reset yet.
            ValueError: The actions have another shape than the space.
        """
        if self._states is None:
            raise gymnasium.error.ResetNeeded("call reset before the first step")
        actions = _as_actions(actions, self.action_space)
        (result, faulty, _), self._states, self._keys = self._step(
            self._params, self._states, actions, self._keys, self._over
        )
        faulty = np.array(faulty)
        if faulty.any():
            _warn_of_faults(faulty.sum())
        terminated, truncated = np.array(result.terminated), np.array(result.truncated)
        infos = {FAULTY: faulty, f"_{FAULTY}": faulty} if faulty.any() else {}
        if self._same_step:
            infos = _final(np.array(result.state.obs, np.float32), terminated | truncated, infos)
        else:
            self._over = terminated | truncated
        obs = np.array(self._states.obs, np.float32)
        return obs, np.array(result.reward, np.float64), terminated, truncated, infos


def _select(condition: jax.Array, yes: Any, no: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def _step_and_reset(env: Env, params: Params, state: EnvState, action, key, over):
    """Take one guarded step, and start anew if it ends the episode."""
    del over
    step_key, key = jax.random.split(key)
    step = guarded_step(env, params, state, action, step_key)
    result = step.result
    done = result.terminated | result.truncated
    state, key = _select(done, _start(env, params, key), (result.state, key))
    return step, state, key


def _reset_or_step(env: Env, params: Params, state: EnvState, action, key, over):
    """Start anew if the episode is over already; otherwise take one guarded step."""
    step_key, next_key = jax.random.split(key)
    step = guarded_step(env, params, state, action, step_key)
    fresh = _start(env, params, key)
    nothing = StepResult(fresh[0], *jax.tree.map(jnp.zeros_like, tuple(step.result[1:])))
    step = _select(over, GuardedStep(nothing, jnp.zeros((), bool), fresh[0]), step)
    return step, step.result.state, _select(over, fresh[1], next_key)


def _final(obs: np.ndarray, done: np.ndarray, infos: dict[str, Any]) -> dict[str, Any]:
    """Return the infos that tell of ended episodes, and theirs; empty where none ended."""
    if not done.any():
        return {}
    final_obs = np.full(len(done), None, dtype=object)
    for i in np.flatnonzero(done):
        final_obs[i] = obs[i]
    return {"final_obs": final_obs, "_final_obs": done, "final_info": infos, "_final_info": done}
