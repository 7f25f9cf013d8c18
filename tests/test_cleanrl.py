"""Training as CleanRL's `ppo_continuous_action.py` does it, on our environments.

CleanRL is a folder of scripts, not a library: what PyPI has of it (0.4.8, 2021) needs Gym and
PyBullet. So the tests make the calls that the script makes (github.com/vwxyzjn/cleanrl): the
wrappers around each environment, vectors that reset within the step, how it reads `infos`.
"""

import warnings

import gymnasium
import numpy as np
import pytest

from garat_jax.adapters import to_gymnasium, to_gymnasium_vector
from garat_jax.env import make_world
from garat_jax.envs.inverted_pendulum import InvertedPendulum
from tests.test_gymnasium import grounded, repaired

with warnings.catch_warnings():  # torch's own deprecations
    warnings.simplefilter("ignore")
    torch = pytest.importorskip("torch", reason="torch is not installed; it comes with make peers")
    from torch import nn
    from torch.distributions.normal import Normal

torch.set_num_threads(1)  # more of them only get into each other's way on networks this small

GAMMA, TRACE, CLIP = 0.99, 0.95, 0.2
ENV_ID = "garat_jax/World-v0"


def pendulum():
    world = make_world(InvertedPendulum(), engine="mujoco")
    return world.env, world.params


def wrapped(env):
    """Wrap one environment as the script's `make_env` does."""
    env = gymnasium.wrappers.FlattenObservation(env)
    env = gymnasium.wrappers.RecordEpisodeStatistics(env)
    env = gymnasium.wrappers.ClipAction(env)
    env = gymnasium.wrappers.NormalizeObservation(env)
    env = gymnasium.wrappers.TransformObservation(env, lambda obs: obs.clip(-10, 10), None)
    env = gymnasium.wrappers.NormalizeReward(env, gamma=GAMMA)
    return gymnasium.wrappers.TransformReward(env, lambda reward: np.clip(reward, -10, 10))


def wrapped_vector(envs):
    """Wrap a vector with the same wrappers' vector forms."""
    vector = gymnasium.wrappers.vector
    envs = vector.RecordEpisodeStatistics(envs)
    envs = vector.ClipAction(envs)
    envs = vector.NormalizeObservation(envs)
    envs = vector.TransformObservation(envs, lambda obs: obs.clip(-10, 10))
    envs = vector.NormalizeReward(envs, gamma=GAMMA)
    return vector.TransformReward(envs, lambda reward: np.clip(reward, -10, 10))


def ended_lengths(infos):
    """Return the lengths of episodes that ended, from where either kind of vector puts them."""
    statistics = infos.get("final_info", {}) if "episode" not in infos else infos
    return statistics["episode"]["l"][statistics["_episode"]] if "episode" in statistics else []


class Agent(nn.Module):
    """A policy and a value, two hidden layers each."""

    def __init__(self, obs_size, action_size):
        super().__init__()
        self.value = mlp(obs_size, 1, 1.0)
        self.mean = mlp(obs_size, action_size, 0.01)
        self.log_std = nn.Parameter(torch.zeros(1, action_size))

    def distribution(self, obs):
        return Normal(self.mean(obs), self.log_std.exp())


def mlp(inputs, outputs, scale):
    layers = [nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh()]
    last = nn.Linear(64, outputs)
    nn.init.orthogonal_(last.weight, scale)
    return nn.Sequential(*layers, last)


def collect(envs, agent, obs, num_steps):
    """Act for some steps; return the batch as tensors [T, B], the next observation, and lengths."""
    rows, lengths = [], []
    for _ in range(num_steps):
        with torch.no_grad():
            distribution = agent.distribution(obs)
            action = distribution.sample()
            log_prob = distribution.log_prob(action).sum(1)
        after, reward, terminated, truncated, infos = envs.step(action.cpu().numpy())
        done = torch.as_tensor(np.logical_or(terminated, truncated), dtype=torch.float32)
        reward = torch.as_tensor(reward, dtype=torch.float32).view(-1)
        rows.append((obs, action, log_prob, reward, done))
        obs = torch.as_tensor(after, dtype=torch.float32)
        lengths += list(ended_lengths(infos))
    return [torch.stack(column) for column in zip(*rows, strict=True)], obs, lengths


def advantages_of(agent, batch, last_obs):
    """Estimate advantages and targets [T, B]; an end of any kind is an end, as in the script."""
    obs, _, _, reward, done = batch
    with torch.no_grad():
        value = agent.value(obs)[..., 0]
        following = torch.cat([value[1:], agent.value(last_obs)[None, :, 0]])
    advantage, trace = torch.zeros_like(reward), 0.0
    for t in reversed(range(len(reward))):
        delta = reward[t] + GAMMA * following[t] * (1 - done[t]) - value[t]
        trace = delta + GAMMA * TRACE * (1 - done[t]) * trace
        advantage[t] = trace
    return advantage, advantage + value


def learn(agent, optimiser, batch, advantage, target):
    """Take ten epochs of minibatches of the clipped surrogate."""
    flat = [x.reshape(-1, *x.shape[2:]) for x in (*batch[:3], advantage, target)]
    for _ in range(10):
        for rows in torch.randperm(len(flat[0])).split(128):
            obs, action, log_prob, gain, wanted = (x[rows] for x in flat)
            gain = (gain - gain.mean()) / (gain.std() + 1e-8)
            ratio = (agent.distribution(obs).log_prob(action).sum(1) - log_prob).exp()
            surrogate = torch.min(ratio * gain, ratio.clamp(1 - CLIP, 1 + CLIP) * gain)
            error = (agent.value(obs)[:, 0] - wanted) ** 2
            loss = 0.25 * error.mean() - surrogate.mean()
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
            optimiser.step()


def train(envs, iterations, num_steps):
    """Train as the script does; return the mean length of the episodes in each batch."""
    torch.manual_seed(1)
    agent = Agent(envs.single_observation_space.shape[0], envs.single_action_space.shape[0])
    optimiser = torch.optim.Adam(agent.parameters(), lr=3e-4, eps=1e-5)
    obs = torch.as_tensor(envs.reset(seed=1)[0], dtype=torch.float32)
    history = []
    for _ in range(iterations):
        batch, obs, lengths = collect(envs, agent, obs, num_steps)
        learn(agent, optimiser, batch, *advantages_of(agent, batch, obs))
        history.append(np.mean(lengths) if lengths else np.nan)
    assert all(torch.isfinite(p).all() for p in agent.parameters())
    envs.close()
    return history


@pytest.fixture
def vector():
    return wrapped_vector(to_gymnasium_vector(*pendulum(), 8, same_step=False))


def test_it_trains_on_our_vector(vector):
    assert np.isfinite(train(vector, iterations=2, num_steps=64)).all()


@pytest.mark.slow
def test_it_learns_on_our_vector(vector):
    history = train(vector, iterations=12, num_steps=128)
    assert history[-1] > 2 * history[0]


@pytest.fixture
def registered():
    """Register a world under an id, from which the script makes its environments."""

    def register(make):
        gymnasium.register(ENV_ID, entry_point=lambda: to_gymnasium(*make()))
        return ENV_ID

    yield register
    gymnasium.registry.pop(ENV_ID, None)


@pytest.mark.parametrize("make", [repaired, grounded])
@pytest.mark.filterwarnings("ignore:.*A Box observation space m.* value is")
@pytest.mark.filterwarnings("ignore:.*recommend using a symmetric and normalized")
def test_it_trains_on_registered_worlds_one_by_one(make, registered):
    env_id = registered(make)
    envs = gymnasium.vector.SyncVectorEnv(
        [lambda: wrapped(gymnasium.make(env_id))] * 2,
        autoreset_mode=gymnasium.vector.AutoresetMode.SAME_STEP,
    )
    history = train(envs, iterations=2, num_steps=128)
    assert np.isfinite(history).all()
