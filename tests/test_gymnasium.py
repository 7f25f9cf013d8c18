"""Gymnasium's checks and vector convention on our environments."""

import sys
import warnings

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from garat_jax.adapters import to_gymnasium, to_gymnasium_vector
from garat_jax.effects import ActuatorDelay, ViscousDamping
from garat_jax.env import make_world
from garat_jax.envs.half_cheetah import HalfCheetah
from garat_jax.envs.hopper import Hopper
from garat_jax.envs.inverted_pendulum import InvertedPendulum
from garat_jax.envs.pairs import PAIRS
from garat_jax.errors import UserError
from garat_jax.methods.grounded import GroundedEnv, Grounding
from tests.probe_envs import Bursting, Walk, WalkParams

WALK = (Walk(), WalkParams(0.1))


def plain():
    world = make_world(HalfCheetah(), engine="mujoco")
    return world.env, world.params


def repaired():
    effects = (ViscousDamping("joint/hip", coefficient=0.5), ActuatorDelay("actuator/hip", 0.004))
    world = make_world(Hopper(), effects=effects, engine="mujoco")
    return world.env, world.params


def grounded():
    world = make_world(InvertedPendulum(), engine="mujoco")

    def transform(params, obs, action, key):
        return params * action + 0.1 * jax.random.normal(key, action.shape)

    return GroundedEnv(world.env, transform), Grounding(world.params, jnp.asarray(0.7))


def on_mjx():
    world = make_world(InvertedPendulum(), engine="mjx")
    return world.env, world.params


@pytest.mark.parametrize(
    "make", [plain, repaired, grounded, pytest.param(on_mjx, marks=pytest.mark.slow)]
)
def test_gymnasium_finds_nothing_wrong(make):
    with warnings.catch_warnings():
        # Advice: observations are unbounded and actions in the model's units, as they are meant.
        warnings.filterwarnings("ignore", message=".*A Box observation space m.* value is")
        warnings.filterwarnings("ignore", message=".*recommend using a symmetric and normalized")
        check_env(to_gymnasium(*make()), skip_render_check=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", PAIRS)
@pytest.mark.parametrize("which", ["source", "target"])
def test_gymnasium_finds_nothing_wrong_with_any_world(name, which):
    world = PAIRS[name].worlds("mujoco")[which == "target"]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*A Box observation space m.* value is")
        warnings.filterwarnings("ignore", message=".*recommend using a symmetric and normalized")
        check_env(to_gymnasium(world.env, world.params), skip_render_check=True)


def test_spaces_are_the_environments():
    env = to_gymnasium(Walk(), WalkParams(0.3))
    assert env.observation_space == gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    assert env.action_space == gymnasium.spaces.Box(-2.0, 1.0, (1,), np.float32)
    vector = to_gymnasium_vector(Walk(), WalkParams(0.3), 3)
    assert vector.single_observation_space == env.observation_space
    assert vector.action_space.shape == (3, 1)
    assert vector.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP


def test_steps_are_the_environments():
    world = make_world(InvertedPendulum(), engine="mujoco")
    env = to_gymnasium(world.env, world.params)
    obs, _ = env.reset(seed=1)
    state = world.env.reset(world.params, jax.random.key(0))
    physics = state.physics._replace(qpos=jnp.asarray(obs[:2]), qvel=jnp.asarray(obs[2:]))
    action = np.asarray([2.0], np.float32)
    expected = world.env.step(
        world.params, state._replace(physics=physics), jnp.asarray(action), jax.random.key(0)
    )
    after, reward, *_ = env.step(action)
    np.testing.assert_allclose(after, expected.state.obs, atol=1e-6)
    assert reward == 1.0


def test_ends_are_told_apart():
    env = to_gymnasium(Walk(), WalkParams(0.1))
    for action, length, terminates in ((1.0, 6, False), (-2.0, 5, True)):
        env.reset(seed=0)
        ends = [env.step(np.asarray([action]))[2:4] for _ in range(length)]
        assert not np.any(ends[:-1])
        assert ends[-1] == (terminates, not terminates)


@pytest.mark.parametrize("to", [np.nan, 1e12])
def test_a_world_that_fails_ends_its_episode_says_so_and_shows_the_last_sound_state(to):
    env = to_gymnasium(Bursting(to), WalkParams(0.3))
    last = env.reset(seed=0)[0]
    while last[0] <= 0.2:
        last, _, terminated, _, info = env.step(np.ones(1))
        assert (terminated, info) == (False, {})
    with pytest.warns(RuntimeWarning, match="physics left the finite numbers in 1 step"):
        obs, reward, terminated, truncated, info = env.step(np.ones(1))
    np.testing.assert_array_equal(obs, last)
    assert (reward, terminated, truncated, info) == (0.0, True, False, {"faulty": True})


def test_a_seed_fixes_all_that_follows_and_goes_on_without_one():
    def run(env, seeds):
        return [env.reset(seed=seed)[0].copy() for seed in seeds]

    first = run(to_gymnasium(Walk(), WalkParams(0.1)), [7, None, None, 7, None])
    again = run(to_gymnasium(Walk(), WalkParams(0.1)), [7, None, None, 7, None])
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(first[3:], first[:2])
    assert len(np.unique(first[:3])) == 3
    unseeded = run(to_gymnasium(Walk(), WalkParams(0.1)), [None, 8, 7])
    assert len(np.unique(unseeded)) == 3
    np.testing.assert_array_equal(unseeded[2], first[0])


@pytest.mark.filterwarnings("ignore:physics left the finite numbers:RuntimeWarning")
@pytest.mark.parametrize("env", [Walk(), Bursting(np.nan)])
@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_the_vector_does_what_gymnasium_makes_of_single_ones(mode, env):
    params = WalkParams(0.1, push=0.1)

    def single():
        return to_gymnasium(env, params)

    theirs = SyncVectorEnv([single] * 4, autoreset_mode=mode)
    ours = to_gymnasium_vector(env, params, 4, mode == AutoresetMode.SAME_STEP)
    assert ours.metadata["autoreset_mode"] == mode
    random = np.random.default_rng(0)
    for seed in (3, [5, 9, 9, 2], None):
        obs, expected = ours.reset(seed=seed)[0], theirs.reset(seed=seed)[0]
        np.testing.assert_array_equal(obs, expected)
        ends = faults = 0
        for _ in range(20):
            action = random.uniform(-2.0, 1.0, (4, 1)).astype(np.float32)
            *mine, infos = ours.step(action)
            *others, other_infos = theirs.step(action)
            for a, b in zip(mine, others, strict=True):
                np.testing.assert_array_equal(a, b)
                assert a.dtype == b.dtype
            assert infos.keys() == other_infos.keys()
            ends += np.sum(mine[2] | mine[3])
            for told, expected in (
                (infos, other_infos),
                (infos.get("final_info", {}), other_infos.get("final_info", {})),
            ):
                assert told.keys() == expected.keys()
                faults += np.sum(told.get("faulty", False))
                np.testing.assert_array_equal(told.get("faulty"), expected.get("faulty"))
            if "final_obs" in infos:
                done = infos["_final_obs"]
                np.testing.assert_array_equal(done, other_infos["_final_obs"])
                for i in range(4):
                    np.testing.assert_array_equal(
                        infos["final_obs"][i], other_infos["final_obs"][i]
                    )
        assert ends > 8
        assert (faults > 0) == isinstance(env, Bursting)
    theirs.close()


def test_the_final_observation_is_that_before_the_reset():
    env = to_gymnasium_vector(Walk(), WalkParams(0.6), 2)
    env.reset(seed=0)
    env.step(np.asarray([[0.1], [0.1]]))
    obs, _, terminated, truncated, infos = env.step(np.asarray([[0.0], [-2.0]]))
    assert terminated.tolist() == [False, True]
    assert not truncated.any()
    assert infos["_final_obs"].tolist() == [False, True]
    assert infos["final_obs"][0] is None
    assert infos["final_obs"][1][0] < -0.8
    assert abs(obs[1, 0]) <= 0.1


def test_what_they_return_may_be_written_to():
    env, vector = to_gymnasium(*WALK), to_gymnasium_vector(*WALK, 2)
    for found in (
        (env.reset(seed=0)[0], env.step(np.ones(1))[0]),
        (vector.reset(seed=0)[0], *vector.step(np.ones((2, 1)))[:4]),
    ):
        assert all(array.flags.writeable for array in found)


def test_wrappers_of_the_vector_count_episodes():
    env = gymnasium.wrappers.vector.RecordEpisodeStatistics(
        to_gymnasium_vector(Walk(), WalkParams(0.0), 2)
    )
    env.reset(seed=0)
    for _ in range(6):
        *_, truncated, infos = env.step(np.zeros((2, 1), np.float32))
    assert truncated.all()
    assert infos["episode"]["l"].tolist() == [6, 6]


def test_mistakes_are_named():
    env, vector = (
        to_gymnasium(Walk(), WalkParams(0.1)),
        to_gymnasium_vector(Walk(), WalkParams(0.1), 2),
    )
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(1))
    with pytest.raises(gymnasium.error.ResetNeeded):
        vector.step(np.zeros((2, 1)))
    with pytest.raises(ValueError, match="3 seeds for 2 environments"):
        vector.reset(seed=[1, 2, 3])
    with pytest.raises(ValueError, match="no options, not reset_mask"):
        vector.reset(options={"reset_mask": np.ones(2, bool)})
    with pytest.raises(ValueError, match="no options, not low"):
        to_gymnasium(*WALK).reset(options={"low": 1})
    with pytest.raises(ValueError, match="num_envs is 0"):
        to_gymnasium_vector(Walk(), WalkParams(0.1), 0)
    env.reset(seed=0)
    vector.reset(seed=0)
    for action in (0.5, np.zeros(2), np.zeros((1, 1))):
        with pytest.raises(ValueError, match=r"actions of shape .*; expected \(1,\)"):
            env.step(action)
    with pytest.raises(ValueError, match=r"actions of shape \(1, 1\); expected \(2, 1\)"):
        vector.step(np.zeros((1, 1)))


def test_without_gymnasium_the_extra_is_named(monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "gymnasium"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delitem(sys.modules, "garat_jax.adapters.gymnasium_side", raising=False)
    monkeypatch.delattr("garat_jax.adapters.gymnasium_side", raising=False)
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(UserError, match=r"garat_jax\[bench\]"):
        to_gymnasium(Walk(), WalkParams(0.1))
    with pytest.raises(UserError, match=r"garat_jax\[bench\]"):
        to_gymnasium_vector(Walk(), WalkParams(0.1), 2)


def test_the_vector_takes_a_seed_for_some_of_its_environments():
    one = to_gymnasium_vector(Walk(), WalkParams(0.1), 2)
    other = SyncVectorEnv([lambda: to_gymnasium(Walk(), WalkParams(0.1))] * 2)
    for seed in (3, [5, None], None, [None, 8]):
        here, there = one.reset(seed=seed)[0], other.reset(seed=seed)[0]
        np.testing.assert_array_equal(here, there)
        assert one.np_random_seed == other.np_random_seed
