"""Brax's wrappers and training on our environments, and ours on Brax's."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import Env as BraxBase
from brax.envs.base import State
from brax.envs.inverted_pendulum import InvertedPendulum as BraxPendulum
from brax.envs.wrappers import training as wrappers
from brax.training import pmap
from brax.training.agents.ppo import train as brax_ppo

from garat_jax import rollout
from garat_jax.adapters import brax_on_new_jax, from_brax, to_brax
from garat_jax.agents import ppo, trpo
from garat_jax.effects import ActuatorDelay, ViscousDamping
from garat_jax.env import EnvState, StepResult, make_world
from garat_jax.envs.inverted_pendulum import InvertedPendulum
from garat_jax.errors import UserError
from garat_jax.methods.garat import GARAT, GARATConfig
from garat_jax.methods.gat import GAT, GATConfig
from garat_jax.methods.grounded import Grounding
from garat_jax.methods.transition_error import transition_error
from garat_jax.runs import RunDirectory
from garat_jax.train import Trainer
from tests.probe_envs import Bursting, Probe, WalkParams

OLD_BRAX = pytest.mark.filterwarnings("ignore:Accessing .* directly from `Data` is deprecated")
"""Brax 0.14.2 reads MJX's data as older versions had it."""


class Counter(Probe):
    """Counts up from a random start; the reward is the action that arrived, scaled by `params`."""

    obs_size = 2
    action_low = np.asarray([-3.0, -np.inf])
    action_high = np.asarray([1.0, np.inf])
    episode_length = 100

    def reset(self, params, key):
        return EnvState(None, jnp.full(2, jax.random.uniform(key)), jnp.zeros((), jnp.int32))

    def step(self, params, state, action, key):
        after = EnvState(None, state.obs + 1 + 1e-3 * jax.random.uniform(key), state.steps + 1)
        return StepResult(after, params * action[0] + action[1], after.steps >= 3, after.steps < 0)


def test_bounded_actions_span_their_range_and_unbounded_ones_pass():
    env = to_brax(Counter(), jnp.ones(()))
    state = env.reset(jax.random.PRNGKey(0))
    rewards = [
        float(env.step(state, jnp.asarray(action)).reward)
        for action in ([-1.0, 0.0], [1.0, 0.0], [0.0, 0.0], [0.0, 7.0])
    ]
    assert rewards == [-3.0, 1.0, -1.0, 6.0]


def test_steps_are_those_of_the_environment():
    world = make_world(InvertedPendulum(), engine="mujoco")
    env = to_brax(world.env, world.params)
    state = env.reset(jax.random.PRNGKey(3))
    expected = world.env.step(
        world.params, state.pipeline_state, jnp.asarray([1.5]), jax.random.key(0)
    )
    after = env.step(state, jnp.asarray([0.5]))  # of a range of ±3
    np.testing.assert_array_equal(after.obs, expected.state.obs)
    assert (env.observation_size, env.action_size) == (4, 1)
    assert (after.reward, after.done) == (1.0, 0.0)


def test_a_typed_key_starts_the_episode_that_the_same_raw_key_does():
    env = to_brax(Counter(), jnp.ones(()))
    raw, typed = env.reset(jax.random.PRNGKey(3)), env.reset(jax.random.key(3))
    for _ in range(2):
        np.testing.assert_array_equal(raw.obs, typed.obs)
        raw, typed = (env.step(state, jnp.zeros(2)) for state in (raw, typed))


@pytest.fixture(scope="module")
def wrapped():
    """Return what 5 steps in Brax's training wrappers give: states [5], each with a batch of 3."""
    env = wrappers.wrap(to_brax(Counter(), jnp.ones(())), episode_length=2)
    state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 3))
    first = state.obs

    def step(state, _):
        state = env.step(state, jnp.zeros((3, 2)))
        return state, state

    return first, jax.jit(lambda s: jax.lax.scan(step, s, length=5))(state)[1]


def test_brax_counts_the_steps_and_resets(wrapped):
    first, states = wrapped
    np.testing.assert_array_equal(states.done[:, 0], [0, 1, 0, 1, 0])
    np.testing.assert_array_equal(states.info["truncation"][:, 0], [0, 1, 0, 1, 0])
    np.testing.assert_array_equal(states.obs[1], first)


def test_an_episode_that_the_task_ends_is_no_truncation():
    env = wrappers.wrap(to_brax(Counter(), jnp.ones(())), episode_length=3)
    state = env.reset(jax.random.split(jax.random.PRNGKey(0), 1))
    for _ in range(3):
        state = env.step(state, jnp.zeros((1, 2)))
    assert (state.done[0], state.info["truncation"][0]) == (1, 0)


def test_randomness_differs_between_environments_and_goes_on_after_a_reset(wrapped):
    first, states = wrapped
    assert len(np.unique(first[:, 0])) == 3
    noise = np.asarray(states.obs[::2, 0, 0] - first[0, 0])  # one step after each reset
    assert len(np.unique(noise)) == 3


@pytest.mark.parametrize("to", [jnp.nan, 1e12])
def test_a_world_that_fails_ends_its_episode_and_brax_counts_it(to):
    env = to_brax(Bursting(to), WalkParams(0.3))
    state = env.reset(jax.random.PRNGKey(0))
    while state.obs[0] <= 0.2:
        state = env.step(state, jnp.ones(1))
        assert (state.done, state.metrics["faulty"]) == (0, 0)
    after = env.step(state, jnp.ones(1))
    np.testing.assert_array_equal(after.obs, state.obs)
    assert (after.reward, after.done, after.metrics["faulty"]) == (0, 1, 1)

    wrapped = wrappers.EvalWrapper(wrappers.wrap(env, episode_length=6))
    state = wrapped.reset(jax.random.split(jax.random.PRNGKey(0), 3))
    for _ in range(6):
        state = wrapped.step(state, jnp.ones((3, 1)))
    metrics = state.info["eval_metrics"]
    np.testing.assert_array_equal(metrics.episode_metrics["faulty"], [1, 1, 1])
    assert np.isfinite(metrics.episode_metrics["reward"]).all()


def test_brax_randomises_our_parameters():
    def randomise(params):
        return params * jnp.asarray([1.0, 10.0]), 0

    env = wrappers.DomainRandomizationVmapWrapper(to_brax(Counter(), jnp.ones(())), randomise)
    state = env.reset(jax.random.split(jax.random.PRNGKey(0), 2))
    state = env.step(state, jnp.asarray([[1.0, 0.0]] * 2))
    np.testing.assert_array_equal(state.reward, [1.0, 10.0])


def test_the_shim_is_needed_and_leaves_nothing_behind():
    """When this fails Brax and JAX get along again: remove `brax_on_new_jax`."""
    with pytest.raises(AttributeError, match="device_put_replicated"):
        pmap.bcast_local_devices(jnp.arange(3))
    with brax_on_new_jax():
        copies = pmap.bcast_local_devices(jnp.arange(3))
    np.testing.assert_array_equal(copies, [[0, 1, 2]])
    assert "device_put_replicated" not in vars(jax)


@pytest.mark.parametrize("engine", ["mujoco", pytest.param("mjx", marks=pytest.mark.slow)])
def test_brax_ppo_learns_on_our_environment(engine):
    world = make_world(InvertedPendulum(), engine=engine)
    history = []
    with brax_on_new_jax():
        brax_ppo.train(
            to_brax(world.env, world.params),
            num_timesteps=40_000,
            episode_length=200,
            num_envs=32,
            num_eval_envs=16,
            num_evals=2,
            unroll_length=16,
            batch_size=32,
            num_minibatches=8,
            num_updates_per_batch=4,
            learning_rate=3e-3,
            normalize_observations=True,
            seed=0,
            progress_fn=lambda steps, metrics: history.append(metrics),
        )
    before, after = (float(metrics["eval/episode_reward"]) for metrics in (history[0], history[-1]))
    assert np.isfinite([before, after]).all()
    assert after > 2 * before
    assert after > 60


@pytest.fixture(scope="module")
def braxs():
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Brax System, piplines and environments are not")
        return BraxPendulum(backend="generalized")


@OLD_BRAX
def test_a_brax_environment_steps_as_it_does_in_brax(braxs):
    env = from_brax(braxs, episode_length=3)
    assert (env.obs_size, env.action_size) == (4, 1)
    key, action = jax.random.key(0), jnp.asarray([0.02])
    ours, theirs = jax.jit(env.reset)(None, key), jax.jit(braxs.reset)(jax.random.key_data(key))
    our_step, their_step = jax.jit(env.step), jax.jit(braxs.step)
    for count in range(1, 4):
        result = our_step(None, ours, action, key)
        ours, theirs = result.state, their_step(theirs, action)
        np.testing.assert_array_equal(ours.obs, theirs.obs)
        assert result.reward == theirs.reward
        assert (bool(result.terminated), bool(result.truncated)) == (False, count == 3)
    tilted = theirs.replace(pipeline_state=theirs.pipeline_state.replace(q=jnp.asarray([0.0, 0.5])))
    result = our_step(None, ours._replace(physics=tilted), 100 * action, key)
    assert (bool(result.terminated), bool(result.truncated)) == (True, False)


@pytest.mark.slow
@OLD_BRAX
def test_trpo_learns_on_a_brax_environment(braxs):
    env = from_brax(braxs, episode_length=100)
    agent = trpo.make(env, trpo.TRPOConfig(num_envs=32, num_steps=64))

    def iteration(state, _):
        state, _, transitions = agent.step(state, None)
        return state, transitions.terminated.mean()

    def run(key):
        return jax.lax.scan(iteration, agent.init(key, None), length=12)[1]

    failures = np.asarray(jax.jit(run)(jax.random.key(0)))
    assert failures[-1] < 0.5 * failures[0]


def test_wrapped_brax_environments_are_refused(braxs):
    with pytest.raises(UserError, match="EpisodeWrapper wraps"):
        from_brax(wrappers.EpisodeWrapper(braxs, 10, 1), episode_length=10)


class BraxWalk(BraxBase):
    """A point that moves by a fifth of its action; beyond 0.9 the episode ends, beyond 0.8 at NaN.

    Like environments of Brax, it has plain numbers for rewards, and infinities in what it keeps.
    """

    def __init__(self, push: float = 0.0, bursts: bool = False):
        self.push, self.bursts = push, bursts

    def reset(self, rng):
        obs = jax.random.uniform(rng, (1,), minval=-0.1, maxval=0.1)
        zero = jnp.zeros(())
        return State(None, obs, zero, zero, {"distance": zero}, {"nearest": jnp.full((), jnp.inf)})

    def step(self, state, action):
        obs = state.obs + 0.2 * action + self.push
        if self.bursts:
            obs = jnp.where(obs > 0.8, jnp.nan, obs)
        done = jnp.where(jnp.abs(obs[0]) > 0.9, 1.0, 0.0)
        return state.replace(obs=obs, reward=1.0, done=done, metrics={"distance": obs[0]})

    observation_size = 1
    action_size = 1
    backend = "none"


def random_actions(params, obs, key):
    del params, obs
    return jax.random.uniform(key, (1,), minval=-1.0), jnp.zeros(())


def test_a_brax_environment_that_fails_ends_its_episode_and_nothing_else_does():
    record = jax.jit(rollout.record, static_argnums=(0, 2, 5, 6))
    for bursts in (False, True):
        env = from_brax(BraxWalk(bursts=bursts), episode_length=20)
        transitions = record(env, None, random_actions, (), jax.random.key(0), 8, 60).transitions
        failed = transitions.obs + 0.2 * transitions.action > 0.8
        assert failed.any()
        np.testing.assert_array_equal(transitions.faulty, bursts & failed[..., 0])
        assert transitions.terminated[transitions.faulty].all()
        assert np.isfinite(transitions.next_obs).all()


def test_what_a_brax_environment_keeps_may_be_infinite_in_training_too(tmp_path):
    env = from_brax(BraxWalk(), episode_length=20)
    agent = ppo.make(env, ppo.PPOConfig(num_envs=4, num_steps=8, hidden=(8,)))
    start = jax.vmap(lambda key: agent.init(key, None))(jax.random.split(jax.random.key(0), 2))
    step = jax.vmap(lambda state, params: agent.step(state, params)[:2], (0, None))
    run = RunDirectory.create(tmp_path / "run", {}, "garat test", [0, 1])
    state = Trainer(run, [0, 1]).train("walk", step, start, None, 2)
    assert np.isinf(state.env.physics.info["nearest"]).all()
    assert [line["faulty_share"] for line in run.metrics()] == [[0.0, 0.0]] * 2


SMALL = {"num_envs": 8, "num_steps": 16, "hidden": (8,)}


@pytest.mark.parametrize(
    ("method", "config"),
    [
        (GAT, GATConfig(**SMALL, minibatch=32, num_epochs=20, learning_rate=1e-2)),
        (GARAT, GARATConfig(transformer=ppo.PPOConfig(**SMALL), num_minibatches=4)),
    ],
)
def test_methods_ground_a_brax_environment(method, config):
    source, target = (from_brax(BraxWalk(push), episode_length=20) for push in (0.0, -0.1))
    recorded = rollout.record(target, None, random_actions, (), jax.random.key(1), 8, 16)
    seen = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), recorded.transitions)
    learner = method(source, random_actions, config)
    state = jax.jit(lambda: learner.init(jax.random.key(0), None, (), seen))()
    step = jax.jit(lambda state: learner.step(state, None, (), seen))
    for _ in range(3):
        state, metrics = step(state)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(metrics))
    grounding = Grounding(None, state.transformer.policy)
    error = transition_error(learner.grounded, grounding, recorded)
    assert error.faulty_share == 0
    assert error.mean < 0.15
    if method is GAT:
        assert error.mean < transition_error(source, None, recorded).mean == pytest.approx(0.1)
    agent = trpo.make(learner.grounded, trpo.TRPOConfig(**SMALL, value_minibatch=32))
    trained, metrics, _ = jax.jit(agent.step)(agent.init(jax.random.key(2), grounding), grounding)
    assert np.isfinite(metrics["reward"])
    assert trained.env_steps == 8 * 16


def grounded_pendulum():
    """Return an environment whose actions an untrained GARAT changes, and its parameters."""
    world = make_world(InvertedPendulum(), engine="mujoco")
    config = GARATConfig(transformer=ppo.PPOConfig(**SMALL), num_minibatches=4)

    def uniform(params, obs, key):
        return jax.random.uniform(key, (1,), minval=-3, maxval=3), jnp.zeros(())

    recorded = rollout.record(world.env, world.params, uniform, (), jax.random.key(1), 4, 8)
    seen = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), recorded.transitions)
    method = GARAT(world.env, uniform, config)
    state = method.init(jax.random.key(0), world.params, (), seen)
    return method.grounded, Grounding(world.params, state.transformer.policy)


def repaired_pendulum():
    effects = (
        ViscousDamping("joint/hinge", coefficient=0.5),
        ActuatorDelay("actuator/slide", 0.04),
    )
    world = make_world(InvertedPendulum(), effects=effects, engine="mujoco")
    return world.env, world.params


@pytest.mark.parametrize("make", [grounded_pendulum, repaired_pendulum])
def test_brax_trains_on_grounded_and_repaired_worlds(make):
    history = []
    with brax_on_new_jax():
        brax_ppo.train(
            to_brax(*make()),
            num_timesteps=256,
            episode_length=20,
            num_envs=8,
            num_eval_envs=4,
            num_evals=2,
            unroll_length=4,
            batch_size=8,
            num_minibatches=4,
            num_updates_per_batch=1,
            seed=0,
            progress_fn=lambda steps, metrics: history.append(metrics),
        )
    for metrics in history:
        assert 1 <= metrics["eval/episode_reward"] <= 20
        assert metrics["eval/episode_faulty"] == 0
