"""A source world that begins where recordings were, and the policy that their commands show."""

import copy
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from garat_jax import dynamics
from garat_jax.dynamics import Dynamics, PhysicsState
from garat_jax.env import LARGEST, Env, EnvState, StepResult
from garat_jax.rollout import Recorded
from garat_jax.types import Params, Policy, Transition

NEIGHBOURS = 5
"""Recorded states among which the cloned policy draws; 1 would be deterministic."""
MOST_STATES = 2000
"""Recorded states that a cloned policy remembers; it looks at all of them in every step."""


class Steps(NamedTuple):
    """Recorded control steps.

    Attributes:
        state: qpos and qvel at their beginning, as the sensors report them, [N, nq + nv].
        action: Command held during them, [N, nu].
        next_state: The same as `state` at their end, [N, nq + nv].
    """

    state: np.ndarray
    action: np.ndarray
    next_state: np.ndarray


class Paths(NamedTuple):
    """Recorded control steps that follow each other.

    Attributes:
        start: qpos and qvel at their beginning, as the sensors report them, [N, nq + nv].
        action: Command held during each, [N, H, nu].
        state: The same as `start` at the end of each, [N, H, nq + nv].
    """

    start: np.ndarray
    action: np.ndarray
    state: np.ndarray


class RecordedEnv(Env):
    """A model without a task: episodes begin in recorded states and earn nothing.

    `params` are its `Dynamics`; an observation is (qpos, qvel) as the sensors report them, with
    their noise: without it, a discriminator would know the machine by its noise, and an inverse
    model would read commands from differences that drown in noise there.

    Args:
        states: Where episodes begin, as the sensors reported it, [N, nq + nv].
        noise: Standard deviation of the sensors' white noise, [nq + nv].
        host: The model.
        action_low: Lower bounds, [nu].
        action_high: Upper bounds, [nu].
        num_substeps: Physics substeps in a control step.
        episode_length: Control steps in an episode.
    """

    def __init__(
        self,
        states: np.ndarray,
        noise: np.ndarray,
        host: mujoco.MjModel,
        action_low: np.ndarray,
        action_high: np.ndarray,
        num_substeps: int,
        episode_length: int,
    ):
        self.states, self.noise = states, noise
        self.num_position = host.nq
        endless = (host.jnt_type == mujoco.mjtJoint.mjJNT_HINGE) & ~host.jnt_limited.astype(bool)
        self.angles = host.jnt_qposadr[endless]
        self.obs_size = states.shape[1]
        self.action_low, self.action_high = action_low, action_high
        self.num_substeps = num_substeps
        self.episode_length = episode_length

    def features(self, obs: jax.Array) -> jax.Array:
        """Return observations [..., nq + nv] with sine and cosine of angles without a limit.

        A network would take one turn more for another place.
        """
        obs = jnp.asarray(obs)
        angle = obs[..., self.angles]
        return jnp.concatenate([obs.at[..., self.angles].set(jnp.sin(angle)), jnp.cos(angle)], -1)

    def reset(self, params: Dynamics, key: jax.Array) -> EnvState:
        """Start an episode in one of the recorded states."""
        draw_key, noise_key = jax.random.split(key)
        states = jnp.asarray(self.states, jnp.float32)
        state = self.at(params, states[jax.random.randint(draw_key, (), 0, len(states))])
        return state._replace(obs=self._with_noise(state.obs, noise_key))

    def at(self, params: Dynamics, recorded: jax.Array) -> EnvState:
        """Start an episode where the sensors report a state [nq + nv].

        Nothing is under way there: delays and activations begin empty.
        """
        true = recorded
        for _ in range(3):  # exact after one for offsets; scales within 5 % are then within 1e-4
            true = true + recorded - self._sense(params, self._begin(params, true))
        physics = self._begin(params, true)
        return EnvState(physics, self._sense(params, physics), jnp.zeros((), jnp.int32))

    def step(
        self, params: Dynamics, state: EnvState, action: jax.Array, key: jax.Array
    ) -> StepResult:
        """Hold the clipped action as the command for one control step."""
        physics = dynamics.step(params, state.physics, self.clip(action), self.num_substeps)
        obs = self._with_noise(self._sense(params, physics), key)
        after = EnvState(physics, obs, state.steps + 1)
        over = after.steps >= self.episode_length
        return StepResult(after, jnp.zeros(()), jnp.zeros((), bool), over)

    def without_noise(self) -> "RecordedEnv":
        """Return the same environment with perfect sensors."""
        quiet = copy.copy(self)
        quiet.noise = np.zeros_like(self.noise)
        return quiet

    def unbounded(self) -> "RecordedEnv":
        """Return the same environment for any commands; the model's `ctrlrange` still holds."""
        free = copy.copy(self)
        free.action_low = np.full_like(self.action_low, -np.inf)
        free.action_high = np.full_like(self.action_high, np.inf)
        return free

    def _with_noise(self, obs: jax.Array, key: jax.Array) -> jax.Array:
        return obs + jnp.asarray(self.noise, obs.dtype) * jax.random.normal(key, obs.shape)

    def _begin(self, params: Dynamics, state: jax.Array) -> PhysicsState:
        return dynamics.initial_state(
            params, state[: self.num_position], state[self.num_position :]
        )

    def _sense(self, params: Dynamics, physics: PhysicsState) -> jax.Array:
        sensed = dynamics.sensed(params, physics)
        return jnp.concatenate([sensed.qpos, sensed.qvel])


class Clone(NamedTuple):
    """Parameters of `cloned`: states' features by their spread [N, features], commands [N, nu]."""

    state: jax.Array
    spread: jax.Array
    action: jax.Array


def clone(env: Env, steps: Steps) -> Clone:
    """Return the parameters with which `cloned(env)` acts as recorded in some steps.

    Of more than `MOST_STATES` it remembers the first: they should be drawn at random.
    """
    steps = Steps(*(column[:MOST_STATES] for column in steps))
    seen = np.asarray(env.features(jnp.asarray(steps.state)))
    spread = seen.std(axis=0) + 1e-6
    return Clone(*(jnp.asarray(x, jnp.float32) for x in (seen / spread, spread, steps.action)))


def cloned(env: Env) -> Policy:
    """Behaviour cloning without training: act as in one of the nearest recorded states, drawn.

    It keeps commands within those recorded and follows a command that jumps, where a regression
    would average. Nearest neighbours in place of a network: Pari et al. 2021 (arXiv 2112.01511),
    there of images.
    """

    def act(params: Clone, obs: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        seen = env.features(obs) / params.spread
        distance = jnp.sum(jnp.square(params.state - seen), axis=1)
        _, nearest = jax.lax.top_k(-distance, min(NEIGHBOURS, params.state.shape[0]))
        drawn = jax.random.randint(key, (), 0, nearest.shape[0])
        return params.action[nearest[drawn]], jnp.zeros(())

    return act


def exploring(env: Env, policy: Policy, scale: float) -> Policy:
    """Add Gaussian noise to a policy's actions, `scale` of half their range."""
    half_range = (env.action_high - env.action_low) / 2

    def explore(params: Params, obs: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        policy_key, noise_key = jax.random.split(key)
        action, log_prob = policy(params, obs, policy_key)
        return action + scale * half_range * jax.random.normal(noise_key, action.shape), log_prob

    return explore


def needed_change(env: RecordedEnv, params: Dynamics, steps: Steps) -> jax.Array:
    """Return how far commands are from those that would go where the recordings went, [nu].

    Root mean square over the steps, by linear least squares in each, within the range of commands;
    residuals count relative to the sensors' noise. What noise alone would need is part of it. A
    step in which a command does nothing, as where its motor is saturated, or in which physics is
    not finite, says nothing about it and does not count; without any other, 0 is returned.
    """
    quiet, transitions = env.without_noise(), as_transitions(env, steps)
    smallest = 1e-3 * steps.state.std(axis=0) + 1e-9
    weight = jnp.asarray(1.0 / np.maximum(env.noise, smallest), jnp.float32)
    middle, reach = (env.action_low + env.action_high) / 2, (env.action_high - env.action_low) / 2
    key = jax.random.key(0)  # without noise, a step draws nothing

    def one(obs: jax.Array, action: jax.Array, next_obs: jax.Array) -> tuple[jax.Array, jax.Array]:
        state = quiet.at(params, obs)
        inward = jnp.where(action > middle, -0.1, 0.1) * reach  # never beyond the bounds
        tried = action + jnp.concatenate([jnp.zeros((1, len(inward))), jnp.diag(inward)])
        ends = jax.vmap(lambda a: quiet.step(params, state, a, key).state.obs)(tried)
        slopes = (ends[1:] - ends[0]) / inward[:, None] * weight
        normal = slopes @ slopes.T + 1e-6 * jnp.trace(slopes @ slopes.T) * jnp.eye(len(inward))
        change = jnp.linalg.solve(normal, slopes @ ((next_obs - ends[0]) * weight))
        counts = jnp.any(slopes != 0, axis=1) & jnp.isfinite(change)
        return jnp.where(counts, jnp.clip(change, -2 * reach, 2 * reach), 0.0), counts

    changes, counts = jax.vmap(one)(transitions.obs, transitions.action, transitions.next_obs)
    return jnp.sqrt(jnp.sum(jnp.square(changes), axis=0) / jnp.maximum(counts.sum(axis=0), 1))


def path_error(
    env: Env, params: Params, starts: EnvState, paths: Paths, weight: jax.Array
) -> jax.Array:
    """Return how far an environment strays from recorded paths that it is given the commands of.

    Args:
        env: The environment; nothing in it may be random.
        params: Its parameters.
        starts: Its states at the start of the paths, [N].
        paths: The paths.
        weight: What a squared error of each signal counts, [nq + nv].

    Returns:
        The root mean square of the weighted errors, [], `LARGEST` at most and if not finite.
    """
    key = jax.random.key(0)  # nothing draws

    def advance(states: EnvState, recorded: tuple[jax.Array, jax.Array]):
        action, wanted = recorded
        step = jax.vmap(env.step, (None, 0, 0, None))
        states = step(params, states, env.clip(action), key).state
        return states, jnp.mean(weight * jnp.square(states.obs - wanted))

    action, state = (jnp.swapaxes(jnp.asarray(x, jnp.float32), 0, 1) for x in paths[1:])
    _, squares = jax.lax.scan(advance, starts, (action, state))
    error = jnp.sqrt(squares.mean())
    return jnp.where(jnp.isfinite(error), jnp.minimum(error, LARGEST), LARGEST)


def as_transitions(env: Env, steps: Steps) -> Transition:
    """Return recorded steps as an environment's transitions [N], their actions within bounds."""
    num = len(steps.state)
    state, action, next_state = (jnp.asarray(x, jnp.float32) for x in steps)
    never, nothing = jnp.zeros(num, bool), jnp.zeros(num)
    return Transition(state, env.clip(action), nothing, next_state, never, never, nothing, never)


def as_recorded(env: RecordedEnv, params: Dynamics, steps: Steps) -> Recorded:
    """Return recorded steps with the environment's states at their beginning, [1, N]."""
    transitions = as_transitions(env, steps)
    states = jax.vmap(env.at, (None, 0))(params, transitions.obs)
    return jax.tree.map(lambda x: x[None], Recorded(transitions, states))
