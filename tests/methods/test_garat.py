"""GARAT: the signs of the game, and that playing it grounds a simple source."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from garat_jax import rollout
from garat_jax.agents.ppo import PPOConfig
from garat_jax.errors import UserError
from garat_jax.methods.garat import (
    GARAT,
    GARATConfig,
    Normaliser,
    evidence,
    gradient_penalty,
    weight_penalty,
)
from garat_jax.methods.grounded import Grounding, TransformerParams
from garat_jax.methods.transition_error import transition_error
from tests.probe_envs import Bursting, Walk, WalkParams

ENV = Walk()
SOURCE, TARGET, FAR = (WalkParams(0.2, push) for push in (0.0, -0.1, -0.5))
SMALL = GARATConfig(
    transformer=dataclasses.replace(
        GARATConfig().transformer, num_envs=16, num_steps=32, hidden=(16,), num_minibatches=4
    ),
    hidden=(16,),
    learning_rate=3e-3,
    num_minibatches=16,
    gradient_penalty=1.0,
)


def agent(params, obs, key):
    """Act at random; GARAT is given this agent as the fixed one."""
    del params, obs
    return jax.random.uniform(key, (1,), minval=-2, maxval=1), jnp.zeros(())


@partial(jax.jit, static_argnums=2)
def record(world, seed, num_envs=32):
    return rollout.record(ENV, world, agent, (), jax.random.key(seed), num_envs, 16)


def flat(transitions):
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), transitions)


def start(config: GARATConfig, target):
    garat = GARAT(ENV, agent, config)
    return garat, garat.init(jax.random.key(0), SOURCE, (), target)


def rewards(garat: GARAT, state, transitions):
    reward = partial(garat.reward, state.reward)
    return jax.jit(jax.vmap(reward))(transitions.obs, transitions.action, transitions.next_obs)


@pytest.fixture(scope="module")
def told_apart():
    """Return the game against a far target whose transformer learns nothing, and its metrics."""
    target = flat(record(FAR, 1).transitions)
    lame = dataclasses.replace(SMALL.transformer, learning_rate=0.0)
    garat, state = start(dataclasses.replace(SMALL, transformer=lame), target)

    def step(state, _):
        new, metrics = garat.step(state, SOURCE, (), target)
        # The batch of this update, collected once more.
        params = TransformerParams(SOURCE, (), state.reward)
        batch = flat(garat.transformer.step(state.transformer, params)[2])
        obs, action = garat.env.split(batch.obs)
        shown = batch._replace(obs=obs, action=action, next_obs=garat.env.split(batch.next_obs)[0])
        return new, metrics | {"rewards": rewards(garat, new, shown)}

    final, history = jax.jit(lambda s: jax.lax.scan(step, s, length=20))(state)
    return garat, final, history


def test_the_discriminator_learns_to_tell_them_apart(told_apart):
    _, _, metrics = told_apart
    accuracy, loss = metrics["discriminator_accuracy"], metrics["discriminator_loss"]
    assert accuracy[-1] > 0.9
    assert accuracy[-1] > accuracy[0]
    assert loss[-1] < loss[0] < 2 * np.log(2) + 0.5


def test_what_looks_like_the_target_is_paid_more(told_apart):
    garat, final, _ = told_apart
    like_target, like_source = (
        rewards(garat, final, flat(record(world, 2).transitions)) for world in (FAR, SOURCE)
    )
    assert like_target.mean() > like_source.mean() + 1
    assert (np.median(like_source) < like_target).mean() > 0.9


@pytest.mark.parametrize(
    ("steps", "transformers", "discriminators", "said"),
    [
        (512, 4, 513, r"a batch of 512 steps cannot make 513 minibatches; expected 1 to 512 of th"),
        (3, 4, 1, r"a batch of 3 steps cannot make 4 minibatches; expected 1 to 3 of them, or a l"),
        (512, 0, 16, r"a batch of 512 steps cannot make 0 minibatches"),
    ],
)
def test_minibatches_that_a_batch_cannot_make_are_refused_at_once(
    steps, transformers, discriminators, said
):
    transformer = PPOConfig(num_envs=1, num_steps=steps, num_minibatches=transformers)
    with pytest.raises(UserError, match=said):
        GARATConfig(transformer=transformer, num_minibatches=discriminators)


def test_centred_rewards_have_mean_zero_over_the_batch(told_apart):
    _, final, metrics = told_apart
    np.testing.assert_allclose(metrics["rewards"].mean(axis=1), 0, atol=1e-4)
    assert metrics["rewards"].std() > 0.01
    assert final.reward.offset > 0


def test_the_weights_are_penalised_and_the_biases_are_not():
    weights = {"kernel": jnp.asarray([[1.0, -2.0]]), "bias": jnp.asarray([7.0])}
    assert weight_penalty({"layer": weights}) == pytest.approx(5.0)


def test_the_penalty_on_weights_keeps_the_discriminator_small():
    target = flat(record(FAR, 1).transitions)
    sizes = []
    for penalty in (0.0, 1.0):
        garat, state = start(dataclasses.replace(SMALL, weight_penalty=penalty), target)
        state, _ = jax.jit(garat.step)(state, SOURCE, (), target)
        sizes.append(weight_penalty(state.reward.weights))
    assert sizes[1] < 0.95 * sizes[0]


def test_gradient_penalty_of_a_linear_logit():
    slope = jnp.asarray([3.0, -4.0])
    batches = jax.random.normal(jax.random.key(0), (2, 10, 2))
    penalty = gradient_penalty(lambda x: x @ slope + 1, *batches, jax.random.key(1))
    assert penalty == pytest.approx((5 - 1) ** 2, rel=1e-5)


def test_gradient_penalty_is_taken_between_the_batches():
    def penalty(grounded, wanted):
        points = (jnp.full((200, 1), grounded), jnp.full((200, 1), wanted))
        return gradient_penalty(lambda x: 0.5 * jnp.sum(x**2), *points, jax.random.key(1))

    assert penalty(3.0, 3.0) == pytest.approx(4.0, rel=1e-5)
    assert penalty(1.0, 3.0) == pytest.approx(4 / 3, rel=0.15)  # E[u²] for u between 0 and 2
    assert penalty(0.0, 0.0) == pytest.approx(1.0, rel=1e-4)  # and no NaN where it is flat


def test_features_are_normalised_changes():
    normaliser = Normaliser(jnp.asarray([1.0, 0.0, 0.5]), jnp.asarray([2.0, 1.0, 0.1]))
    seen = evidence(ENV, normaliser, jnp.asarray([3.0]), jnp.asarray([0.5]), jnp.asarray([3.4]))
    np.testing.assert_allclose(seen, [1.0, 0.5, -1.0], rtol=1e-5)
    far = evidence(ENV, normaliser, jnp.asarray([3.0]), jnp.asarray([0.5]), jnp.asarray([99.0]))
    assert far[2] == 10


def test_an_untrained_transformer_changes_almost_nothing():
    target = flat(record(TARGET, 1).transitions)
    garat, state = start(SMALL, target)
    sent = garat.transform(
        state.transformer.policy, jnp.zeros(1), jnp.asarray([0.3]), jax.random.key(0)
    )
    assert sent == pytest.approx(0.3, abs=0.1)


def test_a_short_run_grounds_a_source_in_a_target_that_pushes():
    """Without the penalty, whose slope of 1 keeps the two players circling in so small a game."""
    target, held_out = record(TARGET, 1), record(TARGET, 2)
    batch = flat(target.transitions)
    calm = dataclasses.replace(SMALL.transformer, num_epochs=3, learning_rate=1e-3)
    config = dataclasses.replace(SMALL, transformer=calm, gradient_penalty=0.0, centre_reward=False)
    garat, state = start(config, batch)

    def step(state, _):
        state, _ = garat.step(state, SOURCE, (), batch)
        grounding = Grounding(SOURCE, state.transformer.policy)
        return state, transition_error(garat.grounded, grounding, held_out).mean

    state, errors = jax.jit(lambda s: jax.lax.scan(step, s, length=80))(state)
    assert transition_error(ENV, SOURCE, held_out).mean == pytest.approx(0.1, rel=1e-4)
    assert errors[-20:].mean() < 0.05
    # The paper's reward, -log D as it is, is never negative.
    assert state.reward.offset == 0
    assert rewards(garat, state, batch).min() > 0


def test_the_papers_settings_are_the_defaults_of_ppo():
    config = PPOConfig()  # Desai et al. 2020, appendix
    assert (config.num_envs * config.num_steps, config.hidden) == (5000, (64, 64))
    assert (config.num_minibatches, config.num_epochs) == (2, 1)
    assert (config.trace, config.discount) == (0.95, 0.99)
    assert (config.clip, config.learning_rate) == (0.1, 3e-4)


def test_the_discriminator_never_sees_a_step_in_which_physics_failed(monkeypatch):
    """The features of such a step would have an unchanged observation."""
    target, source = flat(record(TARGET, 1).transitions), WalkParams(0.5)
    garat = GARAT(Bursting(jnp.nan), agent, SMALL)
    state = garat.init(jax.random.key(0), source, (), target)
    seen, update = [], garat._update_discriminator

    def spied(reward, optimiser, grounded, *rest):
        seen.append(grounded[:, 2] * reward.normaliser.std[2] + reward.normaliser.mean[2])
        return update(reward, optimiser, grounded, *rest)

    monkeypatch.setattr(garat, "_update_discriminator", spied)
    _, metrics = garat.step(state, source, (), target)
    assert metrics["transformer_faulty_share"] > 0
    assert np.abs(seen[0]).min() > 1e-5
