"""A recording is replayed with an action transformer as the transformer was learned."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from garat_jax.diagnosis import load_model
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.replay import replay
from garat_jax.diagnosis.segments import choose_grid, cut
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.ground.source import make_source
from garat_jax.ground.steps import Bounds, control_paths
from tests import models

INTERVAL = 0.024
"""Three samples of the recordings, in seconds."""


def transform(state, command):
    """Bend a command, and add to it what depends on the state."""
    return 0.8 * command + 0.3 * jnp.sin(5 * command) - 0.4 * state[1:]


def test_a_replay_is_the_path_that_the_learner_sees(read):
    model, (recording, *_) = read
    ctrl = 2 * np.sin(40 * recording.time)[:, None]  # it changes in every sample
    moved = dataclasses.replace(recording, ctrl=ctrl)
    paths = control_paths([moved], INTERVAL, 10)
    bounds = Bounds(INTERVAL, np.full(1, -3.0), np.full(1, 3.0))
    env, world = make_source(model, paths.start, np.zeros(2), bounds, 1.0)
    state, path = env.at(world, jnp.asarray(paths.start[0], jnp.float32)), []
    step = jax.jit(env.step)
    for action in jnp.asarray(paths.action[0], jnp.float32):
        state = step(world, state, transform(state.obs, action), jax.random.key(0)).state
        path.append(state.obs)
    grid = choose_grid([moved], model.compile(engine="mujoco").host.model.opt.timestep)
    segments = cut([moved], grid, 0.25)  # 31 samples: the last command is held for one alone
    grounded = dataclasses.replace(model, transform=transform, interval=INTERVAL)
    simulator = Simulator(grounded, (), grid)
    predicted = simulator.predict(simulator.base[None], segments.start[None], segments)[0]
    np.testing.assert_allclose(predicted[0, 3::3], path, atol=1e-4)


@pytest.fixture(scope="module")
def damped(tmp_path_factory):
    """A model, its recording at 500 Hz where it has 1 N m s/rad more, and what makes up for it."""
    path = tmp_path_factory.mktemp("damped") / "pendulum.xml"
    path.write_text(models.PENDULUM)
    spec = mujoco.MjSpec.from_string(models.PENDULUM)
    spec.joint("hinge").damping[0] = 1.01
    spec.option.timestep = 2e-4
    machine = spec.compile()
    data = mujoco.MjData(machine)
    data.qpos[0] = 1.0
    rng, rows = np.random.default_rng(0), []
    for k in range(1001):
        if k % 50 == 0:
            data.ctrl[0] = rng.uniform(-2, 2)
        rows.append([data.qpos[0], data.qvel[0], data.ctrl[0]])
        mujoco.mj_step(machine, data, 10)
    qpos, qvel, ctrl = np.asarray(rows).T[..., None]
    time = 0.002 * np.arange(len(rows))
    recording = Recording("damped", time, qpos, qvel, ctrl, {}, True, ((0, len(rows)),), ())
    inertia, weight = 0.6 * 0.25 / 3, 0.6 * 9.81 * 0.25

    def inverse(state, command):
        """Return the command that goes as far without the damping, if held for 20 ms."""
        decay = 1.01 * 0.02 / inertia
        part = -jnp.expm1(-decay) / decay
        passive = weight * jnp.sin(state[:1]) + 0.01 * state[1:]
        return part * (command - state[1:] - passive) + passive

    return load_model(path), recording, inverse


def test_an_inverse_for_a_held_command_makes_up_for_damping_at_any_sampling(damped):
    model, recording, inverse = damped
    grounded = dataclasses.replace(model, transform=inverse, interval=0.02)
    often = dataclasses.replace(grounded, interval=0.002)

    def error(model):
        return replay(model, [recording], {0.5: range(1)})[0].error()

    assert error(grounded) < 0.02 < 0.05 < error(often) < 1.0 < error(model)
