"""Both agents learn what each probe environment isolates, whatever way they are run."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from garat_jax.agents import actor_critic, ppo, trpo
from garat_jax.agents.ppo import PPOConfig
from garat_jax.agents.trpo import TRPOConfig
from garat_jax.networks import ValueNet, forward
from tests.probe_envs import PROBES, AnyProbe

DISCOUNT = 0.5
ITERATIONS = 60
SHARED = {
    "num_envs": 16,
    "num_steps": 16,
    "hidden": (16,),
    "initial_log_std": -0.7,
    "discount": DISCOUNT,
}
AGENTS = {
    "ppo": ppo.make(
        AnyProbe(),
        PPOConfig(**SHARED, learning_rate=1e-2, num_epochs=4, num_minibatches=4, clip=0.2),
    ),
    "trpo": trpo.make(
        AnyProbe(),
        TRPOConfig(
            **SHARED,
            max_kl=0.02,
            cg_iterations=10,
            value_learning_rate=1e-2,
            value_minibatch=64,
        ),
    ),
}
CONFIGS = {
    "ppo": PPOConfig(**SHARED, num_epochs=2, num_minibatches=2),
    "trpo": TRPOConfig(**SHARED, cg_iterations=5, value_minibatch=64),
}
MAKE = {"ppo": ppo.make, "trpo": trpo.make}
ALGORITHMS = pytest.mark.parametrize("algorithm", AGENTS)


@functools.cache
def program(algorithm: str):
    """Return `(key, probe, iterations) -> (state, metrics of every iteration)`."""
    agent = AGENTS[algorithm]

    def train(key, probe, iterations):
        def step(i, carry):
            state, history = carry
            state, metrics, _ = agent.step(state, probe)
            return state, jax.tree.map(lambda h, m: h.at[i].set(m), history, metrics)

        state = agent.init(key, probe)
        shapes = jax.eval_shape(agent.step, state, probe)[1]
        history = jax.tree.map(lambda m: jnp.zeros((ITERATIONS, *m.shape), m.dtype), shapes)
        return jax.lax.fori_loop(0, iterations, step, (state, history))

    return train


@functools.cache
def compiled(algorithm: str):
    return jax.jit(program(algorithm))


def train(algorithm: str, probe: str, seed: int = 0, iterations: int = ITERATIONS):
    return compiled(algorithm)(jax.random.key(seed), list(PROBES).index(probe), iterations)


def values(state, *observations: float) -> np.ndarray:
    obs = actor_critic.normalise(AnyProbe(), state.policy, jnp.asarray(observations)[:, None])
    return np.asarray(forward(ValueNet(SHARED["hidden"]), state.value, obs))


@ALGORITHMS
@pytest.mark.parametrize(
    ("probe", "expected"),
    [
        ("constant reward", {0.0: 1.0}),
        ("value of obs", {-1.0: -1.0, 1.0: 1.0}),
        ("delayed reward", {0.0: DISCOUNT, 1.0: 1.0}),
        ("truncated", {0.0: 1 / (1 - DISCOUNT)}),
    ],
)
def test_values(algorithm, probe, expected):
    state, _ = train(algorithm, probe)
    np.testing.assert_allclose(values(state, *expected), list(expected.values()), atol=0.1)


@ALGORITHMS
@pytest.mark.parametrize(
    ("probe", "expected"),
    [("action matters", {0.0: 0.5}), ("action and obs matter", {-1.0: -0.5, 1.0: 0.5})],
)
def test_actions(algorithm, probe, expected):
    state, metrics = train(algorithm, probe)
    means = [AGENTS[algorithm].mean(state.policy, jnp.asarray([obs]))[0] for obs in expected]
    np.testing.assert_allclose(means, list(expected.values()), atol=0.15)
    assert metrics["reward"][-1] > metrics["reward"][0]


@ALGORITHMS
def test_the_same_key_gives_the_same_result_and_another_key_another(algorithm):
    first, again, other = (train(algorithm, "action matters", seed)[0] for seed in (1, 1, 2))
    jax.tree.map(np.testing.assert_array_equal, first.policy, again.policy)
    weights = [jax.flatten_util.ravel_pytree(s.policy.weights)[0] for s in (first, other)]
    assert not np.array_equal(*weights)


@ALGORITHMS
def test_seeds_as_rows_are_seeds_one_by_one(algorithm):
    probe = list(PROBES).index("action and obs matter")
    keys = jax.vmap(jax.random.key)(jnp.arange(3))
    rows = jax.jit(jax.vmap(program(algorithm), (0, None, None)))(keys, probe, 3)[0]
    for i in range(3):
        alone = train(algorithm, "action and obs matter", i, 3)[0]
        for row, one in zip(
            jax.tree.leaves((rows.policy, rows.value, rows.env_steps)),
            jax.tree.leaves((alone.policy, alone.value, alone.env_steps)),
            strict=True,
        ):
            np.testing.assert_allclose(row[i], one, rtol=2e-3, atol=2e-4)


@ALGORITHMS
def test_a_step_counts_steps_and_episodes(algorithm):
    state, metrics = train(algorithm, "delayed reward", iterations=2)
    assert AGENTS[algorithm].steps_per_iteration == 256
    assert state.env_steps == 512
    np.testing.assert_array_equal(metrics["episode_length"][:2], [2, 2])
    np.testing.assert_array_equal(metrics["reward"][:2], [0.5, 0.5])


@ALGORITHMS
def test_a_setting_in_a_sweep_is_that_setting_alone(algorithm):
    base = CONFIGS[algorithm]
    numbers = [f.name for f in dataclasses.fields(base) if not f.metadata.get("static")]
    assert {"discount", "trace", "initial_log_std"} < set(numbers)
    swept = [base] + [
        dataclasses.replace(base, **{name: 0.7 * getattr(base, name) + 0.01}) for name in numbers
    ]

    def learn(config, key):
        agent = MAKE[algorithm](AnyProbe(), config)
        state, probe = agent.init(key, 0), list(PROBES).index("delayed reward")
        state, metrics = jax.lax.scan(lambda s, _: agent.step(s, probe)[:2], state, length=2)
        return jax.flatten_util.ravel_pytree((state.policy.weights, state.value))[0], metrics

    key = jax.random.key(0)
    stacked = jax.tree.map(lambda *values: jnp.asarray(values), *swept)
    together, metrics = jax.jit(jax.vmap(learn, (0, None)))(stacked, key)
    one = jax.jit(learn)
    for i, config in enumerate(swept):
        weights, alone = one(config, key)
        np.testing.assert_allclose(together[i], weights, rtol=2e-3, atol=2e-4)
        jax.tree.map(
            lambda m, a, i=i: np.testing.assert_allclose(m[i], a, atol=2e-3), metrics, alone
        )
    assert one._cache_size() == 1  # another number is no other program
    assert len(np.unique(together.round(5), axis=0)) > len(numbers) / 2  # and numbers matter
