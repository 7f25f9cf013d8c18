"""GAT: its two models and what they make of an action."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from garat_jax import rollout
from garat_jax.methods.gat import GAT, GATConfig
from garat_jax.methods.grounded import Grounding
from garat_jax.methods.transition_error import transition_error
from tests.probe_envs import Bursting, Walk, WalkParams

ENV = Walk()
SOURCE, TARGET = WalkParams(0.2, 0.0), WalkParams(0.1, -0.05)
CONFIG = GATConfig(hidden=(32,), num_envs=16, num_steps=64, num_epochs=20, learning_rate=3e-3)


def agent(params, obs, key):
    """Act at random; GAT is given this agent as the fixed one."""
    del params, obs
    return jax.random.uniform(key, (1,), minval=-2, maxval=1), jnp.zeros(())


@partial(jax.jit, static_argnums=1)
def record(world, seed):
    return rollout.record(ENV, world, agent, (), jax.random.key(seed), 32, 16)


@pytest.fixture(scope="module")
def learned():
    target = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), record(TARGET, 1).transitions)
    gat = GAT(ENV, agent, CONFIG)
    state = gat.init(jax.random.key(0), SOURCE, (), target)
    state, metrics = jax.jit(
        lambda s: jax.lax.scan(lambda s, _: gat.step(s, SOURCE, (), target), s, length=5)
    )(state)
    return gat, state, metrics


def test_both_models_learn(learned):
    _, _, metrics = learned
    for loss in (metrics["forward_loss"], metrics["inverse_loss"]):
        assert loss[-1] < 0.01
        assert loss[-1] < loss[0]


@pytest.mark.parametrize("action", [-1.5, -0.5, 0.0, 0.8])
def test_an_action_becomes_the_one_that_does_the_same_in_the_source(learned, action):
    gat, state, _ = learned
    models = state.transformer.policy
    sent = gat.transform(models, jnp.asarray([0.1]), jnp.asarray([action]), jax.random.key(0))
    wanted = (TARGET.gain * action + TARGET.push) / SOURCE.gain
    assert sent == pytest.approx(wanted, abs=0.1)


def test_it_learns_nothing_from_steps_in_which_physics_failed_and_tells_of_them():
    target = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), record(TARGET, 1).transitions)
    source = WalkParams(0.5)
    gat = GAT(Bursting(jnp.nan), agent, CONFIG)
    state = gat.init(jax.random.key(0), source, (), target)
    assert not state.source.faulty.any()
    change = state.source.next_obs - state.source.obs
    np.testing.assert_allclose(change, source.gain * state.source.action, atol=1e-6)
    shares = []
    for _ in range(2):
        state, metrics = gat.step(state, source, (), target)
        shares.append(float(metrics["source_faulty_share"]))
    assert shares[0] > 0
    assert shares[1] == 0


def test_it_grounds_the_source(learned):
    gat, state, _ = learned
    held_out = record(TARGET, 2)
    before = transition_error(ENV, SOURCE, held_out).mean
    grounding = Grounding(SOURCE, state.transformer.policy)
    after = transition_error(gat.grounded, grounding, held_out).mean
    assert after < 0.1 * before


def test_it_counts_what_it_took_from_the_source(learned):
    _, state, _ = learned
    assert state.transformer.env_steps == 16 * 64
    assert np.isfinite(jax.tree.leaves(state.transformer.policy)[0]).all()
