"""Small environments without physics, each of which takes one faculty to learn, and one task."""

import dataclasses
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from garat_jax.env import Env, EnvState, StepResult, Task


class Probe(Env):
    """One observation and one action in [-1, 1]; an episode is one step that terminates."""

    obs_size = 1
    action_low = np.full(1, -1.0)
    action_high = np.full(1, 1.0)
    episode_length = 1
    terminates = True

    def first_obs(self, key: jax.Array) -> jax.Array:
        """Draw the first observation, []."""
        del key
        return jnp.zeros(())

    def next_obs(self, obs: jax.Array) -> jax.Array:
        """Return the observation that follows, []."""
        return obs

    def reward(self, obs: jax.Array, action: jax.Array) -> jax.Array:
        """Return the reward for an action [] after an observation [], []."""
        del obs, action
        return jnp.ones(())

    def reset(self, params, key) -> EnvState:
        del params
        return EnvState(None, self.first_obs(key)[None], jnp.zeros((), jnp.int32))

    def step(self, params, state, action, key) -> StepResult:
        del params, key
        reward = self.reward(state.obs[0], self.clip(action)[0])
        steps = state.steps + 1
        over = steps >= self.episode_length
        after = EnvState(None, self.next_obs(state.obs[0])[None], steps)
        return StepResult(after, reward, over & self.terminates, over & (not self.terminates))


class ConstantReward(Probe):
    """Faculty: the value's regression. V = 1."""


class ValueOfObs(Probe):
    """Faculty: the value sees the observation. V(obs) = obs."""

    def first_obs(self, key):
        return jax.random.rademacher(key, (), jnp.float32)

    def reward(self, obs, action):
        return obs


class DelayedReward(Probe):
    """Faculty: discounting. The reward comes at the second step: V(0) = γ, V(1) = 1."""

    episode_length = 2

    def next_obs(self, obs):
        return obs + 1

    def reward(self, obs, action):
        return obs


class Truncated(Probe):
    """Faculty: bootstrapping. Time is up after each step, and yet V = 1 / (1 - γ)."""

    terminates = False


class ActionMatters(Probe):
    """Faculty: the policy's advantage. The best action is 0.5."""

    def reward(self, obs, action):
        return -jnp.square(action - 0.5)


class ActionAndObsMatter(Probe):
    """Faculty: the policy sees the observation. The best action is half of it."""

    def first_obs(self, key):
        return jax.random.rademacher(key, (), jnp.float32)

    def reward(self, obs, action):
        return -jnp.square(action - 0.5 * obs)


PROBES: dict[str, Probe] = {
    "constant reward": ConstantReward(),
    "value of obs": ValueOfObs(),
    "delayed reward": DelayedReward(),
    "truncated": Truncated(),
    "action matters": ActionMatters(),
    "action and obs matter": ActionAndObsMatter(),
}


class AnyProbe(Probe):
    """All of them; `params` is the index of the one to be, so that one program serves all."""

    episode_length = max(probe.episode_length for probe in PROBES.values())

    def reset(self, params, key):
        return jax.lax.switch(params, [partial(p.reset, None) for p in PROBES.values()], key)

    def step(self, params, state, action, key):
        steps = [partial(p.step, None) for p in PROBES.values()]
        return jax.lax.switch(params, steps, state, action, key)


class WalkParams(NamedTuple):
    """How strong actions are, and how far a walker is pushed at each step."""

    gain: float | jax.Array
    push: float | jax.Array = 0.0


class Walk(Env):
    """A point that moves by its action in [-2, 1], for at most 6 steps.

    Beyond ±0.9 the episode terminates. The reward is the position.
    """

    obs_size = 1
    action_low = np.full(1, -2.0)
    action_high = np.full(1, 1.0)
    episode_length = 6
    limit = 0.9

    def reset(self, params, key) -> EnvState:
        del params
        start = jax.random.uniform(key, (1,), minval=-0.1, maxval=0.1)
        return EnvState(None, start, jnp.zeros((), jnp.int32))

    def step(self, params, state, action, key) -> StepResult:
        del key
        obs = state.obs + params.gain * self.clip(action) + params.push
        terminated = jnp.abs(obs[0]) > self.limit
        steps = state.steps + 1
        truncated = (steps >= self.episode_length) & ~terminated
        return StepResult(EnvState(None, obs, steps), obs[0], terminated, truncated)


class Bursting(Walk):
    """A walk in which physics fails beyond 0.5, to infinity or to NaN, before the task ends it."""

    def __init__(self, to: float):
        self.to = to

    def step(self, params, state, action, key):
        result = super().step(params, state, action, key)
        obs = jnp.where(result.state.obs > 0.5, self.to, result.state.obs)
        return result._replace(state=result.state._replace(obs=obs), reward=obs[0])


@dataclasses.dataclass(frozen=True)
class Hang(Task):
    """A task that pays the action asked for."""

    mjcf: Path
    num_substeps: int = 10
    episode_length: int = 20
    solved_return: float = 1.0

    def initial(self, host, key):
        return jnp.full(host.nq, 0.3), jnp.full(host.nv, -1.0)

    def observe(self, state):
        return jnp.concatenate([state.qpos, state.qvel])

    def reward(self, before, action, after):
        return action[0]

    def terminated(self, after):
        return jnp.zeros((), bool)
