"""Environments: a task on dynamics that are an explicit argument of every call."""

import abc
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from garat_jax import dynamics
from garat_jax.dynamics import Dynamics, PhysicsState
from garat_jax.effects import check_together
from garat_jax.errors import UserError
from garat_jax.overrides import load_spec
from garat_jax.types import Params

LARGEST = 1e10
"""Absolute value beyond which a state has exploded; MuJoCo's own limit, mjMAXVAL."""
SAME_DURATION = 0.01
"""Relative difference up to which control steps last alike."""


Transform = Callable[[jax.Array, jax.Array], jax.Array]
"""A fixed action transformer; see `TaskEnv`."""


class EnvState(NamedTuple):
    """One environment between two steps.

    Attributes:
        physics: The physics.
        obs: What the policy sees, [obs_size].
        steps: Control steps since the reset, [].
    """

    physics: PhysicsState
    obs: jax.Array
    steps: jax.Array


class StepResult(NamedTuple):
    """What a step gave; `state` is never reset, so its `obs` is the true next observation."""

    state: EnvState
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array


class GuardedStep(NamedTuple):
    """What a guarded step gave.

    Attributes:
        result: What to go on with; see `guarded_step`.
        faulty: Whether physics left the finite numbers, [].
        after: The state that came of it, as it was.
    """

    result: StepResult
    faulty: jax.Array
    after: EnvState


class Task(abc.ABC):
    """What an agent is asked to do with a model; stateless and without parameters.

    A task is a frozen dataclass, for runs write down its fields.

    Attributes:
        mjcf: The model.
        num_substeps: Physics substeps in a control step.
        episode_length: Control steps after which an episode is truncated.
        solved_return: Mean return from which the task counts as solved.
        control_seconds: How long a control step is for the reward, which counts on it; 0 if it does
            not.
    """

    mjcf: Path
    num_substeps: int
    episode_length: int
    solved_return: float
    control_seconds: float = 0.0

    @abc.abstractmethod
    def initial(self, host: mujoco.MjModel, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Draw an initial qpos [nq] and qvel [nv]."""

    @abc.abstractmethod
    def observe(self, state: PhysicsState) -> jax.Array:
        """Return the observation [obs_size]."""

    @abc.abstractmethod
    def reward(self, before: PhysicsState, action: jax.Array, after: PhysicsState) -> jax.Array:
        """Return the reward [] of a control step."""

    @abc.abstractmethod
    def terminated(self, after: PhysicsState) -> jax.Array:
        """Say whether the episode is over for good, []."""


class Env(abc.ABC):
    """One environment; batch it with `jax.vmap`.

    Attributes:
        obs_size: Length of an observation.
        action_low: Lower bounds, [action_size].
        action_high: Upper bounds, [action_size].
        episode_length: Control steps until truncation.
    """

    obs_size: int
    action_low: np.ndarray
    action_high: np.ndarray
    episode_length: int

    @property
    def action_size(self) -> int:
        """Number of actions."""
        return self.action_low.shape[0]

    def clip(self, action: jax.Array) -> jax.Array:
        """Return the action [action_size] within its bounds.

        JAX keeps an array that it met in a program, by its identity, in the precision of then:
        these are new ones for each.
        """
        action = _as_float(action)
        low, high = (np.array(x, action.dtype) for x in (self.action_low, self.action_high))
        return jnp.clip(action, low, high)

    def features(self, obs: jax.Array) -> jax.Array:
        """Return what networks see of observations [..., obs_size], [..., features]."""
        return obs

    @abc.abstractmethod
    def reset(self, params: Params, key: jax.Array) -> EnvState:
        """Start an episode."""

    @abc.abstractmethod
    def step(
        self, params: Params, state: EnvState, action: jax.Array, key: jax.Array
    ) -> StepResult:
        """Take one control step with an action [action_size], which is clipped."""

    def step_sending(
        self, params: Params, state: EnvState, action: jax.Array, sent: jax.Array, key: jax.Array
    ) -> StepResult:
        """Take one control step in which another action is sent than the one asked for.

        The reward is for the action that was asked for, unless the environment cannot tell.
        """
        del action
        return self.step(params, state, sent, key)

    def idle(self, params: Params, state: EnvState) -> EnvState:
        """Return a state whose next step costs as little as it can, for nobody looks at it."""
        del params
        return state

    def must_be_finite(self, state: EnvState) -> Any:
        """Return the part of a state [pytree] that a sound step leaves finite."""
        return state


class TaskEnv(Env):
    """A task on physics: the world that agents act in; `params` are its `Dynamics`.

    The policy sees what the sensors report; reward and termination judge the truth. The reward is
    for the action that the policy asked for, as on the machine, whatever is sent instead of it.

    Args:
        task: The task.
        world: The dynamics.
        transform: A fixed action transformer, (qpos and qvel as the sensors report them [nq + nv],
            command [nu]) -> command that is sent instead.

    Raises:
        UserError: A control step lasts longer or shorter than the task's reward counts on, or the
            task is no dataclass or returns something else than a `Task` does.
    """

    def __init__(self, task: Task, world: Dynamics, transform: Transform | None = None):
        host = world.host.model
        _check_settings(task)
        _check_duration(task, task.num_substeps * world.timestep)
        self.transform = transform
        limited = host.actuator_ctrllimited.astype(bool)
        self.task = task
        self.episode_length = task.episode_length
        self.action_low = np.where(limited, host.actuator_ctrlrange[:, 0], -np.inf)
        self.action_high = np.where(limited, host.actuator_ctrlrange[:, 1], np.inf)
        self.obs_size = _check_shapes(task, world)

    def reset(self, params: Dynamics, key: jax.Array) -> EnvState:
        """Start an episode at a state drawn by the task."""
        qpos, qvel = self.task.initial(params.host.model, key)
        physics = dynamics.initial_state(params, qpos, qvel)
        return EnvState(physics, self._observe(params, physics), jnp.zeros((), jnp.int32))

    def step(
        self, params: Dynamics, state: EnvState, action: jax.Array, key: jax.Array
    ) -> StepResult:
        """Hold the clipped action as the command for one control step."""
        return self.step_sending(params, state, action, action, key)

    def step_sending(
        self, params: Dynamics, state: EnvState, action: jax.Array, sent: jax.Array, key: jax.Array
    ) -> StepResult:
        """Hold what is sent, clipped, as the command for one control step.

        Raises:
            UserError: An action has another shape.
        """
        del key
        for given in (action, sent):
            _check_shape("the action", jnp.asarray(given), (self.action_size,))
        action = self.clip(action)
        command = self._command(params, state.physics, self.clip(sent))
        physics = dynamics.step(params, state.physics, command, self.task.num_substeps)
        reward = _as_float(self.task.reward(state.physics, action, physics))
        terminated = jnp.asarray(self.task.terminated(physics), bool)
        steps = state.steps + 1
        truncated = (steps >= self.episode_length) & ~terminated
        after = EnvState(physics, self._observe(params, physics), steps)
        return StepResult(after, reward, terminated, truncated)

    def idle(self, params: Dynamics, state: EnvState) -> EnvState:
        """Return a state that is not finite, which C MuJoCo does not step; MJX steps every one."""
        if params.engine != "mujoco":
            return state
        return state._replace(physics=state.physics._replace(time=jnp.full((), jnp.nan)))

    def _command(self, params: Dynamics, physics: PhysicsState, action: jax.Array) -> jax.Array:
        """Return the command [nu] that is sent for an action."""
        if self.transform is None:
            return action
        sensed = dynamics.sensed(params, physics)
        return self.clip(self.transform(jnp.concatenate([sensed.qpos, sensed.qvel]), action))

    def _observe(self, params: Dynamics, physics: PhysicsState) -> jax.Array:
        """Return the observation [obs_size] of what the sensors report."""
        return self.task.observe(dynamics.sensed(params, physics))


def _as_float(value: Any) -> jax.Array:
    """Return numbers as an array of floats, of their own precision if that is 32 bits or more."""
    array = jnp.asarray(value)
    return array.astype(jnp.result_type(array, jnp.float32))


def _check_settings(task: Task) -> None:
    if not dataclasses.is_dataclass(task):
        raise UserError(
            f"{type(task).__name__} is a plain class, whose settings a run cannot write down; "
            "make it a dataclass: @dataclasses.dataclass(frozen=True)"
        )
    for name in ("num_substeps", "episode_length"):
        value = getattr(task, name)
        if not isinstance(value, int | np.integer) or value < 1:
            raise UserError(
                f"{type(task).__name__}.{name} is {value!r}; expected a whole number from 1"
            )


def _check_shapes(task: Task, world: Dynamics) -> int:
    """Return the length of the observation that a task makes in a world, whose rest is checked."""
    host, name = world.host.model, type(task).__name__
    start = jax.eval_shape(lambda key: task.initial(host, key), jax.random.key(0))
    if not isinstance(start, tuple | list) or len(start) != 2:
        raise UserError(f"{name}.initial returns {type(start).__name__}; expected (qpos, qvel)")
    for what, value, size in (("qpos", start[0], host.nq), ("qvel", start[1], host.nv)):
        _check_shape(f"{what} of {name}.initial", value, (size,))
    state = jax.eval_shape(lambda start: dynamics.initial_state(world, *start), start)
    obs = jax.eval_shape(task.observe, state)
    size = ("obs_size",) if len(getattr(obs, "shape", ())) != 1 else obs.shape
    _check_shape(f"what {name}.observe returns", obs, size)
    reward = jax.eval_shape(task.reward, state, jax.ShapeDtypeStruct((host.nu,), "float32"), state)
    _check_shape(f"what {name}.reward returns", reward, ())
    _check_shape(f"what {name}.terminated returns", jax.eval_shape(task.terminated, state), ())
    return obs.shape[0]


def _check_shape(what: str, value: Any, shape: tuple[Any, ...]) -> None:
    wanted = f"({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"
    if not hasattr(value, "shape"):
        raise UserError(f"{what} is a {type(value).__name__}; expected an array of shape {wanted}")
    if value.shape != shape:
        raise UserError(f"{what} has the shape {value.shape}; expected {wanted}")


def _check_duration(task: Task, seconds: float) -> None:
    wanted = task.control_seconds
    if wanted and abs(seconds - wanted) > SAME_DURATION * wanted:
        raise UserError(
            f"the reward of {type(task).__name__} counts on control steps of {wanted:.4g} s, and "
            f"{task.num_substeps} substeps of this model last {seconds:.4g} s; give the task other "
            "num_substeps, or the model another timestep"
        )


def guarded_step(
    env: Env, params: Params, state: EnvState, action: jax.Array, key: jax.Array
) -> GuardedStep:
    """Take one control step, and end the episode if physics leaves the finite numbers in it.

    Such a step counts as terminated, earns nothing, and stays in the state that it began in, the
    last sound one. Arguments are those of `Env.step`.
    """
    after, reward, terminated, truncated = env.step(params, state, action, key)
    faulty = ~_is_sound((env.must_be_finite(after), reward))
    kept = jax.tree.map(lambda old, new: jnp.where(faulty, old, new), state, after)
    reward = jnp.where(faulty, 0.0, reward)
    result = StepResult(kept, reward, terminated | faulty, truncated & ~faulty)
    return GuardedStep(result, faulty, after)


def _is_sound(values: Any) -> jax.Array:
    """Say whether every float is finite and within MuJoCo's limit, []."""
    leaves = map(jnp.asarray, jax.tree.leaves(values))  # Brax has rewards that are plain numbers
    floats = [x for x in leaves if jnp.issubdtype(x.dtype, jnp.floating)]
    return jnp.stack([jnp.all(jnp.abs(x) < LARGEST) for x in floats]).all()


@dataclasses.dataclass(frozen=True)
class World:
    """An environment together with the dynamics that make it this world."""

    env: TaskEnv
    params: Dynamics


def make_world(
    task: Task,
    overrides: tuple[dynamics.Override, ...] = (),
    effects: tuple[Any, ...] = (),
    engine: str = "auto",
) -> World:
    """Compile a task's model with overrides and effects.

    Raises:
        UserError: As `dynamics.compile` and `TaskEnv`; two of the effects are exclusive.
    """
    check_together(effects)
    params = dynamics.compile(load_spec(task.mjcf), overrides, effects, engine)
    return World(TaskEnv(task, params), params)
