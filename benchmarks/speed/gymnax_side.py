"""Our environments as gymnax's, which rejax trains in."""

# pyright: reportMissingImports=false
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from gymnax.environments import spaces
from gymnax.environments.environment import Environment

from garat_jax.env import Env, EnvState
from garat_jax.types import Params


class GymnaxParams(NamedTuple):
    """An environment's parameters, and the length of an episode where gymnax looks for it."""

    env_params: Params
    max_steps_in_episode: int


class GymnaxEnv(Environment):
    """One of our environments as gymnax's; it resets itself and knows no truncation."""

    def __init__(self, env: Env):
        self.env = env

    def step_env(self, key: jax.Array, state: Any, action: Any, params: Any):
        """Take one control step; gymnax resets where the episode ended, for whatever reason."""
        result = self.env.step(params.env_params, state, action, key)
        done = result.terminated | result.truncated
        return result.state.obs, result.state, result.reward, done, {}

    def reset_env(self, key: jax.Array, params: Any) -> tuple[jax.Array, EnvState]:
        """Start an episode."""
        state = self.env.reset(params.env_params, key)
        return state.obs, state

    def action_space(self, params: Any) -> spaces.Box:
        """Return the box of actions."""
        low, high = jnp.asarray(self.env.action_low), jnp.asarray(self.env.action_high)
        return spaces.Box(low, high, (self.env.action_size,))

    def observation_space(self, params: Any) -> spaces.Box:
        """Return the box of observations."""
        return spaces.Box(-jnp.inf, jnp.inf, (self.env.obs_size,))


def as_gymnax(env: Env, params: Params) -> tuple[GymnaxEnv, GymnaxParams]:
    """Make an environment one of gymnax's, with its parameters."""
    return GymnaxEnv(env), GymnaxParams(params, env.episode_length)
