"""Our environments as Brax's and Brax's as ours.

Brax splits raw PRNG keys and steps actions in [-1, 1]; both stay on its side of the bridge.
"""

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

import brax.envs.base
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from garat_jax.env import Env, EnvState, StepResult, guarded_step
from garat_jax.errors import UserError
from garat_jax.types import Params

KEY = "key"
"""Where a Brax state's `info` carries the raw PRNG key of an environment's next step."""
FAULTY = "faulty"
"""Where its `metrics` count steps in which physics left the finite numbers."""


class BraxEnv(brax.envs.base.Env):
    """One of our environments as Brax's; see `to_brax`.

    Attributes:
        sys: The environment's parameters, under the name that Brax's domain randomisation replaces.
    """

    def __init__(self, env: Env, params: Params):
        self.env = env
        self.sys = params
        bounded = np.isfinite(env.action_low) & np.isfinite(env.action_high)
        low = np.where(bounded, env.action_low, -1.0)
        high = np.where(bounded, env.action_high, 1.0)
        self._half_range, self._middle = (high - low) / 2, (high + low) / 2

    def reset(self, rng: jax.Array) -> brax.envs.base.State:
        """Start an episode from a key of JAX's default kind: raw, as Brax splits them, or typed."""
        is_typed = jnp.issubdtype(rng.dtype, jax.dtypes.prng_key)
        reset_key, key = jax.random.split(rng if is_typed else jax.random.wrap_key_data(rng))
        state = self.env.reset(self.sys, reset_key)
        zero = jnp.zeros((), jnp.float32)
        info = {KEY: jax.random.key_data(key)}
        return brax.envs.base.State(_any(state), state.obs, zero, zero, {FAULTY: zero}, info)

    def step(self, state: brax.envs.base.State, action: jax.Array) -> brax.envs.base.State:
        """Take one guarded step; `done` says only that the task, or a fault, ended it."""
        step_key, key = jax.random.split(jax.random.wrap_key_data(state.info[KEY]))
        sent = jnp.asarray(self._middle) + self._half_range * action
        before = _any(state.pipeline_state)
        result, faulty, _ = guarded_step(self.env, self.sys, before, sent, step_key)
        return state.replace(  # pyright: ignore[reportAttributeAccessIssue]
            pipeline_state=result.state,
            obs=result.state.obs,
            reward=result.reward,
            done=result.terminated.astype(jnp.float32),
            metrics={**state.metrics, FAULTY: faulty.astype(jnp.float32)},
            info={**state.info, KEY: jax.random.key_data(key)},
        )

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        return self.env.obs_size

    @property
    def action_size(self) -> int:
        """Number of actions."""
        return self.env.action_size

    @property
    def backend(self) -> str:
        """What Brax calls the physics; ours is in the parameters."""
        return "mjx"


def to_brax(env: Env, params: Params) -> BraxEnv:
    """Make an environment one of Brax's, for `brax.training` and its wrappers.

    Actions in [-1, 1] span the range of each bounded action; unbounded ones pass as they are. Time
    limits are Brax's: give its `train` or `EpisodeWrapper` the `episode_length` of the environment.

    Args:
        env: The environment.
        params: Its parameters.
    """
    return BraxEnv(env, params)


class BraxSource(Env):
    """One of Brax's environments as ours; see `from_brax`.

    Its states carry Brax's own in `physics`. There are no parameters.
    """

    def __init__(self, env: Any, episode_length: int):
        self.env = env
        self.episode_length = episode_length
        self.obs_size = env.observation_size
        self.action_low = np.full(env.action_size, -1.0, np.float32)
        self.action_high = np.full(env.action_size, 1.0, np.float32)

    def reset(self, params: Params, key: jax.Array) -> EnvState:
        """Start an episode."""
        del params
        state = self.env.reset(jax.random.key_data(key))
        return EnvState(state, state.obs, jnp.zeros((), jnp.int32))

    def step(
        self, params: Params, state: EnvState, action: jax.Array, key: jax.Array
    ) -> StepResult:
        """Take one control step."""
        del params, key
        after = self.env.step(_any(state.physics), self.clip(action))
        steps = state.steps + 1
        terminated = after.done > 0
        truncated = (steps >= self.episode_length) & ~terminated
        return StepResult(EnvState(after, after.obs, steps), after.reward, terminated, truncated)

    def must_be_finite(self, state: EnvState) -> jax.Array:
        """Return the observation: what else a library keeps may be infinite and mean something."""
        return state.obs


def from_brax(env: Any, episode_length: int) -> BraxSource:
    """Make one of Brax's or MuJoCo Playground's environments one of ours, with no parameters.

    Args:
        env: The environment itself, without Brax's training wrappers: those reset it before the
            last observation is seen, and call a time limit an end.
        episode_length: Control steps after which an episode is truncated.

    Raises:
        UserError: The environment is wrapped, or its observation is not one vector.
    """
    if env.unwrapped is not env:
        raise UserError(f"{type(env).__name__} wraps the environment; give the one that is inside")
    if not isinstance(env.observation_size, int):
        raise UserError(f"observations must be one vector, not {env.observation_size}")
    return BraxSource(env, episode_length)


@contextlib.contextmanager
def brax_on_new_jax() -> Iterator[None]:
    """Give JAX back `device_put_replicated`, which Brax 0.14.2 calls and JAX 0.10 removed.

    Use it around `brax.training.agents.*.train.train`; nothing else needs it.
    """
    name = "device_put_replicated"
    before = vars(jax).get(name)
    setattr(jax, name, _device_put_replicated)
    try:
        yield
    finally:
        if before is None:
            delattr(jax, name)
        else:
            setattr(jax, name, before)


def _device_put_replicated(tree: Any, devices: Sequence[Any]) -> Any:
    """Put a copy of every leaf on every device: [...] to [devices, ...], split along the first."""
    # The name is that of Brax's own pmap axis: JAX lets one program mix no two meshes.
    sharding = NamedSharding(Mesh(np.asarray(devices), ("i",)), PartitionSpec("i"))
    copies = jax.tree.map(lambda x: jnp.stack([x] * len(devices)), tree)
    return jax.device_put(copies, sharding)


def _any(value: Any) -> Any:
    """Hide a type: Brax declares a state of its own physics where any pytree will do."""
    return value
