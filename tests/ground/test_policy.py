"""A given policy's commands are held against the recorded ones."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from garat_jax import cli, presets
from garat_jax.agents.ppo import PPOConfig
from garat_jax.ground import GroundConfig
from garat_jax.ground.learn import warn_of_policy
from garat_jax.ground.source import make_source
from garat_jax.ground.steps import choose_bounds, control_steps
from garat_jax.methods.garat import GARATConfig

SMALL = GroundConfig(
    "garat",
    GARATConfig(
        transformer=PPOConfig(num_envs=8, num_steps=8, num_minibatches=1, num_epochs=1),
        num_minibatches=1,
    ),
    num_updates=1,
    num_transitions=100,
    num_held_out=50,
)


def feedback(params, obs, key):
    """Return the command of a damper and spring."""
    del params, key
    return -0.5 * obs[:1] - 0.1 * obs[1:], jnp.zeros(())


def noisy(params, obs, key):
    """Return the same command with noise."""
    action, log_prob = feedback(params, obs, key)
    return action + 0.3 * jax.random.normal(key, (1,)), log_prob


def warnings(read, policy, recorded, interval: float) -> tuple[str, ...]:
    """Return what is said of a policy where another's commands were recorded, at 125 Hz."""
    model, recordings = read
    made = []
    for recording in recordings:
        state = np.concatenate([recording.qpos, recording.qvel], axis=1, dtype="float32")
        keys = jax.random.split(jax.random.key(1), len(state))
        ctrl = np.asarray(jax.vmap(recorded, (None, 0, 0))((), state, keys)[0])
        made.append(dataclasses.replace(recording, ctrl=ctrl))
    bounds = choose_bounds(model, made, interval)
    steps = control_steps(made, interval)
    env, _ = make_source(model, steps.state, np.zeros(2), bounds, 0.5)
    return warn_of_policy(env, policy, steps)


@pytest.mark.parametrize("policy", [feedback, noisy])
def test_a_policy_whose_commands_were_recorded_at_its_rate_is_no_cause_to_warn(read, policy):
    assert not warnings(read, policy, policy, 0.008)


def test_a_policy_is_warned_of_whose_commands_were_not_the_recorded_ones(read):
    (late,) = warnings(read, feedback, feedback, 0.08)  # means over ten samples
    (other,) = warnings(read, lambda *seen: (0.5 * feedback(*seen)[0], 0.0), feedback, 0.008)
    assert "leave --policy out" in late
    (off,) = warnings(read, noisy, lambda *seen: (noisy(*seen)[0] + 0.2, 0.0), 0.008)
    assert "are 0." in off
    assert "are 0.5 of their standard deviations off" in other


def test_a_run_of_garat_says_that_its_policy_is_not_the_recorded_one(
    recorded, tmp_path, monkeypatch, capsys
):
    monkeypatch.setitem(presets.GROUNDING, "garat", SMALL)
    policy = tmp_path / "mine.py"
    policy.write_text("def policy(obs, key): return 0.5 * obs[:1]\n")
    files, out = [str(file) for file in recorded[1]], tmp_path / "garat"
    acting = ["--policy", str(policy), "--method", "garat", "--out", str(out)]
    assert cli.main(["ground", str(recorded[0]), *files, *acting]) == 0
    (said,) = json.loads((out / "summary.json").read_text())["warnings"]
    assert f"warning: {said}\n" in capsys.readouterr().err
    assert "Warning: the recorded commands" in (out / "report.html").read_text()
