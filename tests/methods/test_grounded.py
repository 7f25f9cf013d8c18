"""The two views of an environment that make grounding."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from garat_jax import rollout
from garat_jax.env import EnvState, StepResult, TaskEnv, make_world
from garat_jax.envs.half_cheetah import HalfCheetah
from garat_jax.errors import UserError
from garat_jax.methods.grounded import (
    GroundedEnv,
    Grounding,
    TransformerEnv,
    TransformerParams,
    action_noise,
    decode_action,
)
from garat_jax.methods.transition_error import (
    CONSTANT_ACTIONS,
    best_constant,
    check_differs,
    constant_error,
    transition_error,
)
from tests.probe_envs import Bursting, Probe, Walk, WalkParams

ENV = Walk()  # actions from -2 to 1: middle -0.5, half-range 1.5
GAIN = 0.2
PARAMS = WalkParams(GAIN)


def start():
    return ENV.reset(PARAMS, jax.random.key(0))


def uniform(params, obs, key):
    """Act at random beyond the bounds; `params` shifts the action."""
    del obs
    return params + jax.random.uniform(key, (1,), minval=-3, maxval=3), jnp.zeros(())


def test_grounded_by_the_identity_is_the_environment_itself():
    grounded = GroundedEnv(ENV, lambda params, obs, action, key: action)
    params = Grounding(PARAMS, ())
    jax.tree.map(
        np.testing.assert_array_equal,
        rollout.record(grounded, params, uniform, 0.0, jax.random.key(1), 3, 8).transitions,
        rollout.record(ENV, PARAMS, uniform, 0.0, jax.random.key(1), 3, 8).transitions,
    )


def test_a_transformer_sees_what_is_seen_and_the_clipped_action():
    def transform(params, obs, action, key):
        del key
        return params * action + obs

    grounded = GroundedEnv(ENV, transform)
    result = grounded.step(Grounding(PARAMS, 0.5), start(), jnp.asarray([7.0]), jax.random.key(2))
    obs = start().obs
    np.testing.assert_allclose(result.state.obs, obs + GAIN * (0.5 * 1.0 + obs))
    assert (grounded.obs_size, grounded.action_size, grounded.episode_length) == (1, 1, 6)


def transformer_env():
    def reward(params, obs, action, next_obs):
        return (params * jnp.asarray([obs[0], action[0], next_obs[0]])).sum()

    return TransformerEnv(ENV, uniform, lambda action, output: 0.1 * action + output, reward)


def test_the_transformer_is_shown_the_agents_view_and_action():
    env = transformer_env()
    params = TransformerParams(PARAMS, 0.0, jnp.zeros(3))
    states = rollout.reset(env, params, jax.random.key(0), 50)
    obs, action = env.split(states.obs)
    assert (env.obs_size, obs.shape, action.shape) == (2, (50, 1), (50, 1))
    assert np.abs(obs).max() <= 0.1
    assert (action.min(), action.max()) == (-2, 1)  # the agent's wishes, clipped
    assert len(np.unique(action)) > 20


@pytest.mark.parametrize("which", range(3))
def test_the_transformer_is_paid_for_obs_the_agents_action_and_what_followed(which):
    env = transformer_env()
    params = TransformerParams(PARAMS, 0.0, jnp.eye(3)[which])
    state = env.reset(params, jax.random.key(3))
    obs, action = env.split(state.obs)
    result = env.step(params, state, jnp.asarray([0.4]), jax.random.key(4))
    sent = 0.1 * action + 0.4
    assert result.reward == pytest.approx([obs, action, obs + GAIN * sent][which].item(), abs=1e-6)
    np.testing.assert_allclose(env.split(result.state.obs)[0], obs + GAIN * sent, rtol=1e-6)
    assert env.split(result.state.obs)[1] != action


def test_the_agents_parameters_reach_the_agent():
    params = TransformerParams(PARAMS, 100.0, jnp.zeros(3))
    state = transformer_env().reset(params, jax.random.key(0))
    assert state.obs[1] == 1.0


@pytest.mark.parametrize(
    ("output_is", "reach", "action", "output", "sent"),
    [
        ("change", 1.0, 0.0, 0.5, 0.75),
        ("change", 1.0, 0.0, -9.0, -1.5),  # the output is clipped
        ("change", 2.0, 1.0, -0.5, -0.5),
        ("change", 1.0, 0.5, 1.0, 1.0),  # and so is the action
        ("absolute", 1.0, 0.3, 0.0, -0.5),
        ("absolute", 1.0, 0.3, 1.0, 1.0),
        ("absolute", 1.0, 0.3, -1.0, -2.0),
        ("absolute", 0.5, 0.3, 1.0, 0.25),
    ],
)
def test_decoding(output_is, reach, action, output, sent):
    decode = decode_action(ENV, output_is, reach)
    assert decode(jnp.asarray([action]), jnp.asarray([output])) == pytest.approx(sent)


def test_unbounded_actions_are_refused():
    for make in (lambda env: decode_action(env, "change", 1.0), action_noise):
        with pytest.raises(UserError, match="bounded actions: give actuators a ctrlrange"):
            make(transformer_env())


def test_transition_error_is_the_mean_distance():
    recorded = rollout.record(ENV, PARAMS, uniform, 0.0, jax.random.key(5), 4, 7)
    size = np.abs(ENV.clip(recorded.transitions.action)).mean()
    assert transition_error(ENV, PARAMS, recorded).mean < 1e-7
    assert transition_error(ENV, WalkParams(GAIN / 2), recorded).mean == pytest.approx(
        0.1 * size, rel=1e-5
    )


def record_constant(action: float) -> rollout.Recorded:
    def constant(params, obs, key):
        del params, obs, key
        return jnp.full(1, action), jnp.zeros(())

    return rollout.record(ENV, PARAMS, constant, (), jax.random.key(6), 2, 5)


def test_the_error_of_a_constant_action_is_what_it_moves_otherwise():
    recorded = record_constant(0.0)
    assert constant_error(ENV, PARAMS, recorded, 0.0).mean == pytest.approx(0.0, abs=1e-6)
    assert constant_error(ENV, PARAMS, recorded, -1.5).mean == pytest.approx(0.3, rel=1e-5)


@pytest.mark.parametrize("number", [0, 7, CONSTANT_ACTIONS - 1])
def test_the_best_constant_action_is_sought_over_the_whole_range(number):
    action = np.linspace(-2, 1, CONSTANT_ACTIONS)[number]
    recorded = record_constant(float(action))
    assert best_constant(ENV, PARAMS, recorded) == pytest.approx(action)


class Plane(Probe):
    """Moves in the plane by its action."""

    obs_size = 2
    action_low, action_high = np.full(2, -1.0), np.full(2, 1.0)
    episode_length = 5

    def reset(self, params, key):
        return EnvState(None, jnp.zeros(2), jnp.zeros((), jnp.int32))

    def step(self, params, state, action, key):
        after = EnvState(None, state.obs + self.clip(action), state.steps + 1)
        return StepResult(after, jnp.zeros(()), after.steps < 0, after.steps >= 5)


@pytest.mark.parametrize("action", [(0.9, -0.9), (-0.4, 0.7), (0.3, 0.3)])
def test_the_best_constant_action_is_sought_for_each_actuator(action):
    def constant(params, obs, key):
        return jnp.asarray(action), jnp.zeros(())

    recorded = rollout.record(Plane(), None, constant, (), jax.random.key(6), 2, 5)
    found = jax.jit(lambda: best_constant(Plane(), None, recorded))()
    assert found == pytest.approx(np.asarray(action), abs=1e-6)


def test_the_error_is_that_of_the_sound_steps_and_says_how_many_were_not():
    recorded = record_constant(1.0)
    error = transition_error(Bursting(jnp.nan), WalkParams(GAIN / 2), recorded)
    failed = np.asarray(recorded.transitions.obs + GAIN / 2 > 0.5)
    assert 0 < failed.mean() < 1
    assert error.faulty_share == pytest.approx(failed.mean())
    assert error.mean == pytest.approx(GAIN / 2, rel=1e-5)


def test_the_agent_is_paid_for_what_it_asks_for_as_on_the_machine():
    world = make_world(HalfCheetah(), engine="mujoco")
    grounded = GroundedEnv(world.env, lambda scale, obs, action, key: scale * action)
    fixed = TaskEnv(HalfCheetah(), world.params, lambda state, command: 0.5 * command)
    state, action = world.env.reset(world.params, jax.random.key(0)), 1.5 * jnp.ones(6)
    params = Grounding(world.params, jnp.asarray(0.5))
    result = grounded.step(params, state, action, jax.random.key(1))
    same = fixed.step(world.params, state, action, jax.random.key(1))
    sent = world.env.step(world.params, state, 0.5 * jnp.ones(6), jax.random.key(1))
    np.testing.assert_array_equal(result.state.obs, sent.state.obs)
    np.testing.assert_array_equal(result.state.obs, same.state.obs)
    assert result.reward == same.reward
    assert sent.reward - result.reward == pytest.approx(0.1 * 6 * (1.0 - 0.25), rel=1e-4)


def test_through_two_transformers_the_agent_is_paid_for_its_own_action_still():
    world = make_world(HalfCheetah(), engine="mujoco")
    state, action = world.env.reset(world.params, jax.random.key(0)), jnp.ones(6)
    once = GroundedEnv(world.env, lambda scale, obs, action, key: scale * action)
    twice = GroundedEnv(once, once.transform)
    quarter, half = (Grounding(world.params, jnp.asarray(x)) for x in (0.25, 0.5))
    expected = once.step(quarter, state, action, jax.random.key(1))
    found = twice.step(Grounding(half, jnp.asarray(0.5)), state, action, jax.random.key(1))
    np.testing.assert_array_equal(found.state.obs, expected.state.obs)
    assert found.reward == expected.reward


def test_a_grounded_environment_idles_as_its_own_does():
    world = make_world(HalfCheetah(), engine="mujoco")
    grounded = GroundedEnv(world.env, lambda params, obs, action, key: action)
    state = world.env.reset(world.params, jax.random.key(0))
    assert jnp.isnan(grounded.idle(Grounding(world.params, ()), state).physics.time)


def test_a_source_that_is_the_target_is_refused():
    check_differs(np.asarray([1e-9, 2.0]))
    with pytest.raises(UserError, match="there is nothing to ground"):
        check_differs(np.asarray([0.1, 0.0]))
