"""Experience as it was: nothing after a reset leaks into the step before it."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from garat_jax import rollout
from garat_jax.dynamics import Override
from garat_jax.engine import HostModel
from garat_jax.env import make_world
from garat_jax.envs.inverted_pendulum import InvertedPendulum
from tests.probe_envs import Bursting, Walk, WalkParams

GAIN = 0.2
PARAMS = WalkParams(GAIN)


def constant(params, obs, key):
    """Return the action `params`, whatever is seen."""
    del obs, key
    return params[None], jnp.zeros(())


def uniform(params, obs, key):
    del params, obs
    return jax.random.uniform(key, (1,), minval=-3, maxval=3), jnp.asarray(-jnp.log(6.0))


@partial(jax.jit, static_argnums=1)
def walk(action, length):
    """Return where 3 walkers stand after `length` steps, and the transitions, [length, 3]."""
    state = rollout.reset(Walk(), PARAMS, jax.random.key(0), 3)
    return rollout.unroll(Walk(), PARAMS, constant, action, state, jax.random.key(1), length)


@pytest.mark.parametrize(("action", "steps"), [(0.0, 6), (1.0, 5)])
def test_next_obs_is_what_followed_even_where_an_episode_ended(action, steps):
    _, transitions, _ = walk(action, 13)
    np.testing.assert_allclose(
        transitions.next_obs, transitions.obs + GAIN * action, rtol=1e-6, atol=1e-7
    )
    ended = np.asarray(transitions.terminated | transitions.truncated)
    first = int(np.argmax(ended[:, 0]))
    assert first == steps - 1
    assert np.abs(transitions.obs[first + 1]).max() <= 0.1  # a new episode
    assert len(np.unique(transitions.obs[[0, 6], 0])) == 2  # that starts elsewhere


@pytest.mark.parametrize(("action", "terminates"), [(0.0, False), (1.0, True)])
def test_the_end_of_the_task_and_the_end_of_time_are_kept_apart(action, terminates):
    _, transitions, _ = walk(action, 13)
    assert not (transitions.terminated & transitions.truncated).any()
    assert bool(transitions.terminated.any()) == terminates
    assert bool(transitions.truncated.any()) != terminates


def test_an_unroll_goes_on_where_the_last_one_stopped():
    state, first, _ = walk(1.0, 3)
    np.testing.assert_array_equal(state.obs, first.next_obs[-1])
    np.testing.assert_array_equal(state.steps, [3, 3, 3])


@pytest.mark.parametrize("to", [jnp.inf, jnp.nan, 1e11])
def test_a_world_that_fails_ends_its_episode_and_is_kept_as_it_was(to):
    env = Bursting(to)
    start = rollout.reset(env, PARAMS, jax.random.key(0), 3)
    state, transitions, fault = jax.jit(
        lambda: rollout.unroll(env, PARAMS, constant, jnp.ones(()), start, jax.random.key(1), 13)
    )()
    failed = np.asarray(transitions.obs + GAIN > 0.5)[..., 0]
    assert failed.any(axis=0).all()
    np.testing.assert_array_equal(transitions.terminated, failed)
    assert not transitions.truncated.any()
    np.testing.assert_array_equal(transitions.reward[failed], 0)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((state, transitions)))
    assert fault.num_steps == failed.sum()
    first = np.argwhere(failed)[0]
    np.testing.assert_array_equal(fault.before.obs, transitions.obs[tuple(first)])
    np.testing.assert_array_equal(fault.action, [1.0])
    np.testing.assert_array_equal(fault.after.obs, [np.float32(to)])


def test_a_batch_without_failure_has_an_empty_record():
    *_, fault = walk(1.0, 13)
    assert fault.num_steps == 0
    np.testing.assert_array_equal(fault.before.obs, [0.0])


def test_evaluate_counts_only_the_first_episode():
    env, params, key = Walk(), WalkParams(0.5), jax.random.key(4)
    returns = rollout.evaluate(env, params, constant, jnp.asarray(1.0), key, 5).returns
    start = rollout.reset(env, params, jax.random.split(key)[0], 5).obs[:, 0]
    positions = start[:, None] + params.gain * jnp.arange(1, 7)
    alive = jnp.concatenate([jnp.ones((5, 1)), positions[:, :-1] <= Walk.limit], axis=1)
    expected = (positions * jnp.cumprod(alive, axis=1)).sum(axis=1)
    np.testing.assert_allclose(returns, expected, rtol=1e-5)
    np.testing.assert_array_equal(alive.sum(axis=1), 2)  # of 6 steps, a new episode after them


def test_evaluate_pays_nothing_for_a_failure_and_counts_it():
    key, params = jax.random.key(4), WalkParams(0.2)
    sound = rollout.evaluate(Walk(), params, constant, jnp.asarray(1.0), key, 5)
    assert sound.faulty_share == 0
    found = rollout.evaluate(Bursting(jnp.nan), params, constant, jnp.asarray(1.0), key, 5)
    start = rollout.reset(Walk(), params, jax.random.split(key)[0], 5).obs[:, 0]
    positions = start[:, None] + params.gain * jnp.arange(1, 7)
    np.testing.assert_allclose(found.returns, (positions * (positions <= 0.5)).sum(1), rtol=1e-5)
    lengths = 1 + (positions <= 0.5).sum(axis=1)
    assert found.faulty_share == pytest.approx(5 / lengths.sum())


def test_an_evaluation_that_is_not_wanted_has_no_failures():
    env, key = Bursting(jnp.nan), jax.random.key(4)
    found = rollout.evaluate(env, PARAMS, constant, jnp.ones(()), key, 5, False)
    np.testing.assert_array_equal(found.returns, np.zeros(5))
    assert found.faulty_share == 0


@pytest.fixture(scope="module")
def bursting():
    """Return transitions of walks that fail, [13, 3], as they were recorded."""
    record = jax.jit(
        lambda: rollout.record(
            Bursting(jnp.nan), PARAMS, constant, jnp.ones(()), jax.random.key(0), 3, 13
        )
    )
    return record()


def test_recorded_failures_are_marked_and_a_sound_step_can_take_their_place(bursting):
    transitions = bursting.transitions
    faulty = np.asarray(transitions.obs + GAIN > 0.5)[..., 0]
    assert 0 < faulty.mean() < 1
    np.testing.assert_array_equal(transitions.faulty, faulty)
    cleaned = rollout.without_faults(bursting, transitions.faulty)
    found = cleaned.transitions
    np.testing.assert_allclose(found.next_obs, found.obs + GAIN, rtol=1e-6)
    assert not found.faulty.any()
    np.testing.assert_array_equal(cleaned.states.obs, found.obs)
    for before, after in zip(transitions, found, strict=True):
        np.testing.assert_array_equal(before[~faulty], after[~faulty])


def test_a_failure_before_any_sound_step_gives_way_to_the_first():
    faulty = jnp.asarray([[True, True], [False, True], [False, False]])
    found = rollout.without_faults(jnp.arange(6).reshape(3, 2), faulty)
    np.testing.assert_array_equal(found, [[2, 2], [2, 2], [4, 5]])


def test_replay_says_where_a_world_failed(bursting):
    env = Bursting(jnp.nan)
    next_obs, faulty = rollout.replay(env, PARAMS, bursting, jax.random.key(0))
    np.testing.assert_array_equal(faulty, bursting.transitions.faulty.reshape(-1))
    np.testing.assert_array_equal(next_obs, bursting.transitions.next_obs.reshape(-1, 1))


def test_evaluate_steps_no_episode_beyond_its_end(monkeypatch):
    steps = []
    advance = HostModel._advance_batch

    def counted(self, num_substeps, batch, controls, finite):
        steps.append(len(controls) if finite is None else int(finite.sum()))
        return advance(self, num_substeps, batch, controls, finite)

    monkeypatch.setattr(HostModel, "_advance_batch", counted)
    world = make_world(InvertedPendulum(), engine="mujoco")

    @jax.jit
    @jax.vmap
    def evaluate(key, wanted):
        return rollout.evaluate(world.env, world.params, uniform, (), key, 6, wanted).returns

    @jax.jit
    def unroll(key):
        reset_key, key = jax.random.split(key)
        start = rollout.reset(world.env, world.params, reset_key, 6)
        return rollout.unroll(world.env, world.params, uniform, (), start, key, 60)[1]

    keys = jax.random.split(jax.random.key(2))
    returns = jax.block_until_ready(evaluate(keys, jnp.asarray([True, True])))
    assert sum(steps) == returns.sum()  # every step is paid 1
    steps.clear()
    one = jax.block_until_ready(evaluate(keys, jnp.asarray([False, True])))
    np.testing.assert_array_equal(one, [np.zeros(6), returns[1]])
    assert sum(steps) == one.sum()
    transitions = jax.vmap(unroll)(keys)
    assert transitions.terminated.any(axis=1).all()
    np.testing.assert_array_equal(returns, 1 + transitions.terminated.argmax(axis=1))


@pytest.fixture(scope="module")
def recorded():
    """Transitions of a pendulum, [20, 3], in which poles fall."""
    world = make_world(InvertedPendulum(), engine="mujoco")
    record = jax.jit(lambda key: rollout.record(world.env, world.params, uniform, (), key, 3, 20))
    return world, record(jax.random.key(0))


def test_recorded_states_are_those_the_steps_began_in(recorded):
    _, data = recorded
    np.testing.assert_array_equal(
        data.transitions.obs,
        jnp.concatenate([data.states.physics.qpos, data.states.physics.qvel], axis=-1),
    )
    assert data.transitions.terminated.any()
    assert np.abs(data.transitions.action).max() <= 3


def test_replay_in_the_same_world_is_exact_and_in_another_is_not(recorded):
    world, data = recorded
    wanted = data.transitions.next_obs.reshape(-1, 4)
    heavy = make_world(InvertedPendulum(), (Override("body", "pole", "mass", 50.0),), (), "mujoco")
    same, other = (
        jax.jit(partial(rollout.replay, w.env))(w.params, data, jax.random.key(9))[0]
        for w in (world, heavy)
    )
    np.testing.assert_array_equal(same, wanted)
    assert np.abs(other - wanted).max(axis=1).min() > 1e-5
