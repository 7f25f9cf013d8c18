"""What the transfer experiment does with what happens in the target."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from garat_jax import train
from garat_jax.agents import trpo
from garat_jax.agents.ppo import PPOConfig
from garat_jax.agents.trpo import TRPOConfig
from garat_jax.dynamics import Override
from garat_jax.env import EnvState, make_world
from garat_jax.envs.inverted_pendulum import InvertedPendulum
from garat_jax.envs.pairs import PAIRS
from garat_jax.errors import DivergedError, UserError
from garat_jax.methods.garat import GARATConfig
from garat_jax.methods.gat import GATConfig
from garat_jax.presets import GROUNDING, METHODS
from garat_jax.rollout import Recorded, thinned
from garat_jax.runs import RunDirectory
from garat_jax.train import Trainer
from garat_jax.transfer import Experiment, Worlds
from garat_jax.types import Transition


@pytest.mark.parametrize(
    ("wanted", "kept"), [(30, [0, 1, 2, 3, 4, 5]), (15, [0, 2, 4]), (10, [0, 3]), (1, [0])]
)
def test_thinned_keeps_whole_transitions_evenly_in_time(wanted, kept):
    numbers = jnp.arange(2 * 6 * 5).reshape(2, 6, 5)  # seeds, time, environments
    fields = dict.fromkeys(Transition._fields, numbers)
    recorded = Recorded(Transition(**fields), EnvState(*[numbers] * len(EnvState._fields)))
    found = thinned(recorded, wanted)
    for leaf in jax.tree.leaves(found):
        np.testing.assert_array_equal(leaf, numbers[:, kept])


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"seeds": 0}, "seeds is 0; expected 1 or more"),
        ({"num_target_transitions": 49}, "num_target_transitions is 49; expected 50 or more"),
        ({"num_episodes": 0}, "num_episodes is 0; expected 1 or more"),
        ({"num_updates": -1}, "num_updates is -1; expected 0 or more"),
    ],
)
def test_settings_that_would_fail_at_the_end_are_refused_at_once(changed, said):
    config = METHODS["garat"](PAIRS["inverted_pendulum_heavy"])
    with pytest.raises(UserError, match=said):
        dataclasses.replace(config, agent=TRPOConfig(num_envs=50), **changed)


@pytest.mark.parametrize(
    ("config", "changed", "said"),
    [
        (GARATConfig(), {"output": "chnage"}, "unknown output 'chnage'; did you mean change"),
        (GATConfig(), {"num_epochs": 0}, "num_epochs is 0; expected 1 or more"),
        (GATConfig(), {"minibatch": 0}, "minibatch is 0; expected 1 or more"),
        (GATConfig(), {"num_envs": 0}, "num_envs is 0; expected 1 or more"),
        (PPOConfig(), {"num_epochs": 0}, "num_epochs is 0; expected 1 or more"),
        (PPOConfig(), {"num_steps": 0}, "num_steps is 0; expected 1 or more"),
        (GROUNDING["gat"], {"num_updates": 0}, "num_updates is 0; expected 1 or more"),
        (GROUNDING["gat"], {"num_transitions": 0}, "num_transitions is 0; expected 1 or more"),
        (GROUNDING["gat"], {"num_held_out": 0}, "num_held_out is 0; expected 1 or more"),
        (GROUNDING["gat"], {"episode": -1}, "episode is -1; expected 0 or more"),
        (GROUNDING["gat"], {"episode": float("nan")}, "episode is nan; expected 0 or more"),
    ],
)
def test_settings_of_grounding_that_would_fail_in_it_are_refused_at_once(config, changed, said):
    with pytest.raises(UserError, match=said):
        dataclasses.replace(config, **changed)


@pytest.fixture(scope="module")
def failing(tmp_path_factory):
    """Return an experiment of two seeds, its target with a motor that bursts, and its policies."""
    small = TRPOConfig(num_envs=4, num_steps=16, hidden=(8,))
    config = METHODS["garat"](PAIRS["inverted_pendulum_heavy"], seeds=2, engine="mujoco")
    config = dataclasses.replace(config, agent=small, num_target_transitions=160, num_episodes=2)
    strong = Override("actuator", "slide", "gear", 1e13)
    source = make_world(InvertedPendulum(), engine="mujoco")
    target = make_world(InvertedPendulum(), (strong,), engine="mujoco")
    agent = trpo.make(source.env, small)
    run = RunDirectory.create(tmp_path_factory.mktemp("failing") / "run", {}, "", [0, 1])
    keys = jax.vmap(jax.random.key)(jnp.arange(2))
    experiment = Experiment(config, Trainer(run, [0, 1]), Worlds(source, target, agent), keys)
    policies = jax.vmap(lambda key: agent.init(key, source.params).policy)(keys)
    return experiment, policies


def test_an_evaluation_in_a_target_that_bursts_stops_the_run(failing):
    experiment, policies = failing
    with pytest.raises(DivergedError, match=r"^method evaluation: seed 0, 1 saw physics leave"):
        experiment.target_returns(policies, "method")


def test_a_recording_in_a_target_that_bursts_stops_the_run(failing):
    experiment, policies = failing
    with pytest.raises(DivergedError, match=r"^target transitions: seed 0, 1 saw physics leave"):
        experiment.record(policies, "target transitions")


class Blinding(InvertedPendulum):
    """A pendulum whose sensors fail when the pole leans."""

    def observe(self, state):
        return jnp.where(state.qpos[1] > 0.03, jnp.nan, super().observe(state))


def test_below_the_bound_a_failure_is_told_and_not_recorded(failing, monkeypatch, capsys):
    monkeypatch.setattr(train, "LARGEST_FAULTY_SHARE", 0.9)
    experiment, policies = failing
    target = make_world(Blinding(), engine="mujoco")
    worlds = dataclasses.replace(experiment.worlds, target=target)
    experiment = dataclasses.replace(experiment, worlds=worlds)
    transitions, states = experiment.record(policies, "target transitions")
    assert "target transitions: warning: physics left the finite" in capsys.readouterr().err
    assert not transitions.faulty.any()
    assert (transitions.obs != transitions.next_obs).any(axis=-1).all()
    np.testing.assert_array_equal(states.obs, transitions.obs)
