"""The two views of one environment that make grounding.

In `GroundedEnv` the agent trains: its actions pass through an action transformer. In
`TransformerEnv` the transformer trains: it sees what the fixed agent wants to do, and is paid for
transitions that look like the target's.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from garat_jax.env import Env, EnvState, StepResult
from garat_jax.errors import UserError
from garat_jax.types import Params, Policy

Output = Literal["change", "absolute"]


class Grounding(NamedTuple):
    """Parameters of a `GroundedEnv`: the environment's and its action transformer's."""

    env: Params
    transformer: Params


class GroundedEnv(Env):
    """An environment whose actions pass through a transformer; the reward is the task's.

    As on the machine, it is for what the agent asks for, not for what the transformer makes of it.

    Args:
        env: The environment.
        transform: `(transformer_params, obs, action, key) -> action`.
    """

    def __init__(
        self,
        env: Env,
        transform: Callable[[Params, jax.Array, jax.Array, jax.Array], jax.Array],
    ):
        self.env = env
        self.transform = transform
        self.obs_size = env.obs_size
        self.action_low, self.action_high = env.action_low, env.action_high
        self.episode_length = env.episode_length

    def features(self, obs: jax.Array) -> jax.Array:
        """Return what networks see of the environment's observations."""
        return self.env.features(obs)

    def reset(self, params: Grounding, key: jax.Array) -> EnvState:
        """Start an episode."""
        return self.env.reset(params.env, key)

    def step(
        self, params: Grounding, state: EnvState, action: jax.Array, key: jax.Array
    ) -> StepResult:
        """Step the environment with the transformed action; the agent is paid for its own."""
        return self.step_sending(params, state, action, action, key)

    def step_sending(
        self, params: Grounding, state: EnvState, action: jax.Array, sent: jax.Array, key: jax.Array
    ) -> StepResult:
        """Send what the transformer makes of an action that replaces the one asked for."""
        transform_key, key = jax.random.split(key)
        sent = self.transform(params.transformer, state.obs, self.env.clip(sent), transform_key)
        return self.env.step_sending(params.env, state, self.env.clip(action), sent, key)

    def idle(self, params: Grounding, state: EnvState) -> EnvState:
        """Return a state in which the environment idles."""
        return self.env.idle(params.env, state)

    def must_be_finite(self, state: EnvState) -> Any:
        """Return what must be finite in the environment."""
        return self.env.must_be_finite(state)


class TransformerParams(NamedTuple):
    """Parameters of a `TransformerEnv`: the environment's, the fixed agent's, the reward's."""

    env: Params
    agent: Params
    reward: Params


class TransformerEnv(Env):
    """The environment as the action transformer sees it.

    Observation: (obs, a) with a drawn from the fixed agent. Action: the transformer's output, see
    `decode_action`. Reward: `reward(params.reward, obs, a, next_obs)`.

    Args:
        env: The environment.
        agent: The fixed agent's stochastic policy.
        decode: `(action, output) -> action` that is sent to the environment.
        reward: The reward of a transition.
    """

    def __init__(
        self,
        env: Env,
        agent: Policy,
        decode: Callable[[jax.Array, jax.Array], jax.Array],
        reward: Callable[[Params, jax.Array, jax.Array, jax.Array], jax.Array],
    ):
        self.env = env
        self.agent = agent
        self.decode = decode
        self.reward = reward
        self.obs_size = env.obs_size + env.action_size
        self.action_low = np.full(env.action_size, -np.inf)
        self.action_high = np.full(env.action_size, np.inf)
        self.episode_length = env.episode_length

    def _with_action(self, params: TransformerParams, state: EnvState, key: jax.Array) -> EnvState:
        action, _ = self.agent(params.agent, state.obs, key)
        return state._replace(obs=jnp.concatenate([state.obs, self.env.clip(action)]))

    def features(self, obs: jax.Array) -> jax.Array:
        """Return what networks see of the agent's view, and its action."""
        view, action = self.split(obs)
        return jnp.concatenate([self.env.features(view), action], axis=-1)

    def split(self, obs: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Split observations [..., obs_size + action_size] into the agent's view and action."""
        return obs[..., : self.env.obs_size], obs[..., self.env.obs_size :]

    def reset(self, params: TransformerParams, key: jax.Array) -> EnvState:
        """Start an episode and let the agent choose its first action."""
        env_key, agent_key = jax.random.split(key)
        return self._with_action(params, self.env.reset(params.env, env_key), agent_key)

    def step(
        self, params: TransformerParams, state: EnvState, action: jax.Array, key: jax.Array
    ) -> StepResult:
        """Send the transformed action; then let the agent choose the next."""
        env_key, agent_key = jax.random.split(key)
        obs, wanted = self.split(state.obs)
        sent = self.decode(wanted, action)
        result = self.env.step(params.env, state._replace(obs=obs), sent, env_key)
        reward = self.reward(params.reward, obs, wanted, result.state.obs)
        after = self._with_action(params, result.state, agent_key)
        return result._replace(state=after, reward=reward)

    def must_be_finite(self, state: EnvState) -> Any:
        """Return what must be finite in the environment, and what the transformer sees."""
        return state.obs, self.env.must_be_finite(state)


def check_bounded(env: Env) -> None:
    """Refuse an environment whose actions are not bounded: transformers count in their ranges.

    Raises:
        UserError: Some action is not.
    """
    if not np.isfinite(env.action_low).all() or not np.isfinite(env.action_high).all():
        raise UserError("an action transformer needs bounded actions: give actuators a ctrlrange")


def decode_action(
    env: Env, output_is: Output, reach: float
) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """Return `(action, output) -> action` for a transformer's raw output.

    The output is in half-ranges of the action and clipped to ±1, times `reach`. As a `change` it is
    added to the action (as the public implementations do); as `absolute` it is the action.

    Args:
        env: The environment; its actions must be bounded.
        output_is: How to read the output.
        reach: Largest change, or largest action, in half-ranges.

    Raises:
        UserError: The environment's actions are not bounded.
    """
    check_bounded(env)
    half_range = (env.action_high - env.action_low) / 2
    middle = (env.action_high + env.action_low) / 2

    def decode(action: jax.Array, output: jax.Array) -> jax.Array:
        origin = action if output_is == "change" else jnp.asarray(middle, action.dtype)
        reached = np.array(reach * half_range, action.dtype)  # new arrays, as in `Env.clip`
        return env.clip(origin + reached * jnp.clip(output, -1, 1))

    return decode


def action_noise(env: Env) -> Callable[[jax.Array, jax.Array, jax.Array, jax.Array], jax.Array]:
    """Return what adds noise to actions; its parameter is the noise's scale in half-ranges, [].

    Raises:
        UserError: The environment's actions are not bounded.
    """
    check_bounded(env)
    half_range = (env.action_high - env.action_low) / 2

    def transform(scale: jax.Array, obs: jax.Array, action: jax.Array, key: jax.Array) -> jax.Array:
        del obs
        return action + scale * half_range * jax.random.normal(key, action.shape)

    return transform
