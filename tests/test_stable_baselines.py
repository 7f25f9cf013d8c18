"""stable-baselines3 on our environments, and the bridge with which it is timed."""

import warnings

import distrax
import numpy as np
import pytest

from garat_jax.adapters import to_gymnasium, to_gymnasium_vector
from tests.probe_envs import Walk, WalkParams
from tests.test_gymnasium import grounded, plain, repaired

REASON = "stable-baselines3 is not installed; it comes with make peers"

with warnings.catch_warnings():  # torch's own deprecations
    warnings.simplefilter("ignore")
    sb3 = pytest.importorskip("stable_baselines3", reason=REASON)
    contrib = pytest.importorskip("sb3_contrib", reason=REASON)
    import torch
    from stable_baselines3.common.distributions import DiagGaussianDistribution, kl_divergence
    from stable_baselines3.common.env_checker import check_env
    from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

    from benchmarks.speed import torch_peers

torch.set_num_threads(1)  # more of them only get into each other's way on networks this small

WORLDS = pytest.mark.parametrize("make", [plain, repaired, grounded])


@WORLDS
@pytest.mark.filterwarnings("ignore:We recommend you to use a symmetric and normalized Box")
def test_stable_baselines_finds_nothing_wrong(make):
    check_env(to_gymnasium(*make()), warn=True, skip_render_check=True)


@WORLDS
def test_ppo_trains_on_worlds_of_every_kind(make):
    env = to_gymnasium(*make())
    learner = sb3.PPO("MlpPolicy", env, n_steps=128, batch_size=64, n_epochs=2, seed=0)
    before = [p.detach().clone() for p in learner.policy.parameters()]
    learner.learn(384)
    after = list(learner.policy.parameters())
    assert learner.num_timesteps == 384
    assert all(np.isfinite(p.detach().numpy()).all() for p in after)
    assert all((b != a).any() for b, a in zip(before, after, strict=True))
    action, _ = learner.predict(env.reset(seed=0)[0], deterministic=True)
    assert env.action_space.contains(action)


def test_the_vector_for_baselines_does_what_theirs_does_with_single_ones():
    theirs = DummyVecEnv([lambda: to_gymnasium(Walk(), WalkParams(0.1))] * 3)
    ours = torch_peers.VectorForBaselines(to_gymnasium_vector(Walk(), WalkParams(0.1), 3))
    random, ends = np.random.default_rng(0), 0
    for envs in (theirs, ours):
        envs.seed(5)
    np.testing.assert_array_equal(ours.reset(), theirs.reset())
    for _ in range(20):
        action = random.uniform(-2.0, 1.0, (3, 1)).astype(np.float32)
        *mine, infos = ours.step(action)
        *others, other_infos = theirs.step(action)
        for a, b in zip(mine, others, strict=True):
            np.testing.assert_array_equal(a, b)
            assert a.dtype == b.dtype
        for i in np.flatnonzero(mine[2]):
            ends += 1
            assert infos[i].keys() == other_infos[i].keys()
            np.testing.assert_array_equal(
                infos[i]["terminal_observation"], other_infos[i]["terminal_observation"]
            )
            assert infos[i]["TimeLimit.truncated"] == other_infos[i]["TimeLimit.truncated"]
    assert ends > 8


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*mini-batch")  # the paper's does not divide its batch
def test_trpo_learns_with_our_hyper_parameters():
    envs = VecMonitor(torch_peers.VectorForBaselines(to_gymnasium_vector(*grounded(), 50)))
    learner = torch_peers.make_trpo(envs)
    lengths = []
    for _ in range(8):
        learner.learn(torch_peers.BATCH, log_interval=None, reset_num_timesteps=False)
        lengths.append(np.mean([episode["l"] for episode in learner.ep_info_buffer]))
    assert lengths[-1] > 1.5 * lengths[0]


def test_the_peer_averages_over_the_actions_what_ours_sums():
    means, spreads = np.array([[0.1, -0.4, 0.3], [0.0, 0.2, -0.1]]), np.array([1.0, 0.5, 2.0])

    def theirs(mean):
        log_std = torch.log(torch.as_tensor(spreads))
        return DiagGaussianDistribution(3).proba_distribution(torch.as_tensor(mean), log_std)

    def ours(mean):
        return distrax.MultivariateNormalDiag(mean, np.broadcast_to(spreads, mean.shape))

    averaged = kl_divergence(theirs(means), theirs(0 * means)).mean()
    summed = ours(means).kl_divergence(ours(0 * means)).mean()
    assert float(averaged) == pytest.approx(float(summed) / 3, rel=1e-5)
