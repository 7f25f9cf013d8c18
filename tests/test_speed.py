"""The benchmarks of speed: what they count, and that the other libraries see our environments."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.speed import jax_peers, ours
from benchmarks.speed.ours import Size
from benchmarks.speed.parts import NAMES, parts
from benchmarks.speed.sides import RANDOM, RATIOS, Side, measure, with_ratios
from garat_jax.env import make_world
from garat_jax.envs.inverted_pendulum import InvertedPendulum
from tests.probe_envs import Walk, WalkParams


def row_of(agent, **more):
    return {"env": "x", "agent": agent, "engine": "mujoco", "seeds": 1, "envs": 50, **more}


def test_sides_run_in_turns_and_are_compared_with_random_actions():
    order = []
    sides = [
        Side(row_of(name), lambda name=name: order.append(name), steps)
        for name, steps in ((RANDOM, 100), ("trpo", 50))
    ]
    random, trpo = measure(sides, repetitions=3)
    assert order == [RANDOM, "trpo"] * 3
    assert random["share_of_random_actions"] == 1.0
    rates = trpo["steps_per_second"], random["steps_per_second"]
    assert trpo["share_of_random_actions"] == rates[0] / rates[1]
    assert "share_of_engine_alone" not in trpo
    assert trpo["slowest"] <= trpo["steps_per_second"] <= trpo["fastest"]


def test_a_size_that_random_actions_were_not_measured_at_has_no_share():
    sides = [Side(row_of(RANDOM), list, 1), Side(row_of("peer trpo", envs=8), list, 1)]
    assert "share_of_random_actions" not in measure(sides, 1)[1]


def test_peers_are_compared_with_ours_of_the_same_algorithm():
    rates = {(1, 50): 30.0, (1, 250): 40.0, (5, 50): 60.0}
    rows = [
        row_of("trpo", seeds=seeds, envs=envs, steps_per_second=rate)
        for (seeds, envs), rate in rates.items()
    ]
    rows.append(row_of("trpo", steps_per_second=1.0) | {"engine": "mjx"})
    rows.append(row_of("peer trpo", envs=8, version="1", steps_per_second=10.0))
    peer = with_ratios(rows)[-1]
    assert [peer[ratio] for ratio in RATIOS] == [3.0, 4.0, 6.0]


def test_the_engine_alone_takes_the_steps_that_random_actions_took():
    world = make_world(InvertedPendulum(), engine="mujoco")
    states, controls = ours._random_states(world, Size(2, 3, 4, 1))
    assert (states.shape, controls.shape) == ((4, 6, 4), (4, 6, 1))
    assert np.ptp(controls) > 1
    side = ours.engine_alone("inverted_pendulum", world, Size(2, 3, 4, 5))
    assert side.env_steps == 4 * 6 * 5
    side.run()


@pytest.mark.slow
def test_the_parts_of_an_iteration_are_timed():
    world = make_world(InvertedPendulum(), engine="mujoco")
    found = parts("inverted_pendulum", world, Size(2, 4, 64, 1), repetitions=2)
    assert found["seconds"].keys() == {*NAMES, "iteration"}
    assert min(found["seconds"].values()) > 0


@pytest.mark.slow
def test_brax_goes_on_by_one_epoch_at_a_time_and_ends():
    world = make_world(InvertedPendulum(), engine="mujoco")
    training = jax_peers.BraxTraining(world, iterations=1)
    for _ in range(2):
        training.epoch()
    training.close()
    assert not training._thread.is_alive()


@pytest.fixture(scope="module")
def gymnax_walk():
    with warnings.catch_warnings():  # gymnax's own deprecations
        warnings.simplefilter("ignore")
        pytest.importorskip("gymnax", reason="gymnax is not installed; it comes with make peers")
        from benchmarks.speed.gymnax_side import as_gymnax
    return as_gymnax(Walk(), WalkParams(0.1))


def test_gymnax_steps_and_resets_our_environments(gymnax_walk):
    env, params = gymnax_walk
    assert params.max_steps_in_episode == Walk.episode_length
    assert env.observation_space(params).shape == (1,)
    assert float(env.action_space(params).low[0]) == -2.0
    obs, state = env.reset(jax.random.key(0), params)
    ends = []
    for count in range(6):
        before = obs
        obs, state, reward, done, _ = env.step(
            jax.random.key(count), state, jnp.asarray([0.5]), params
        )
        ends.append(bool(done))
    assert ends == [False] * 5 + [True]
    assert float(reward) == pytest.approx(float(before[0]) + 0.05, abs=1e-6)
    assert int(state.steps) == 0
    assert abs(float(obs[0])) <= 0.1


@pytest.mark.slow
def test_rejax_trains_in_our_worlds():
    pytest.importorskip("rejax", reason="rejax is not installed; it comes with make peers")
    world = make_world(InvertedPendulum(), engine="mujoco")
    side = jax_peers.rejax_side("inverted_pendulum", world, 1)
    side.run()
    assert side.env_steps == 5000
