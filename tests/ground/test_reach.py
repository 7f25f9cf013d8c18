"""How far a transformer may have to change commands, and what is made of that."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from garat_jax.diagnosis import load_model
from garat_jax.ground import GroundConfig, ground, learn
from garat_jax.ground.source import make_source
from garat_jax.ground.steps import Bounds, choose_bounds, control_steps
from garat_jax.methods.gat import GATConfig
from garat_jax.methods.recorded import Steps, needed_change
from garat_jax.runs import RunDirectory
from tests import models

NOISE = np.asarray([1e-3, 1e-2])
SMALL = GroundConfig(
    "gat", GATConfig(num_envs=16, num_steps=25), num_updates=1, num_transitions=300, num_held_out=50
)


def needed(model, steps: Steps, noise: np.ndarray, bounds: Bounds) -> np.ndarray:
    """Return the needed change of the commands of some steps, [nu]."""
    env, world = make_source(model, steps.state, noise, bounds, 0.5)
    return np.asarray(jax.jit(lambda w: needed_change(env, w, steps))(world))


def limited(folder, limit: float):
    """Return a pendulum whose motor is saturated at a torque."""
    path = folder / f"limited_to_{limit:g}.xml"
    strong = 'ctrllimited="true"/></actuator>'
    force = f'forcelimited="true" forcerange="-{limit} {limit}" '
    assert strong in models.PENDULUM
    path.write_text(models.PENDULUM.replace(strong, force + strong))
    return load_model(path)


def test_the_needed_change_of_a_command_is_the_hidden_torque(read, recorded):
    model, recordings = read
    bounds = choose_bounds(model, recordings)
    steps = control_steps(recordings, bounds.interval)
    change = needed(model, steps, NOISE, bounds)
    assert change == pytest.approx(abs(recorded[2]), rel=0.25)  # noise is in it


def test_a_step_in_which_the_motor_is_saturated_says_nothing_about_it(read, tmp_path):
    recordings, limit = read[1], 0.6
    model = limited(tmp_path, limit)
    bounds = choose_bounds(model, recordings)
    steps = control_steps(recordings, bounds.interval)
    tried = 0.05 * (bounds.high - bounds.low)  # so much less of the command is tried
    acts = np.abs(steps.action[:, 0]) < limit + tried
    assert 0.5 < acts.mean() < 0.95
    change = needed(model, steps, NOISE, bounds)
    some = needed(model, Steps(*(column[acts] for column in steps)), NOISE, bounds)
    np.testing.assert_allclose(change, some, rtol=0.01)  # its weights differ


def test_a_command_that_hardly_does_anything_needs_its_range_at_most(read, tmp_path):
    model, recordings = limited(tmp_path, 0.6), read[1]
    bounds = choose_bounds(model, recordings)
    steps = control_steps(recordings, bounds.interval)
    tried = 0.05 * (bounds.high - bounds.low)
    almost = steps._replace(action=np.full_like(steps.action, 0.6 + 0.999 * tried))
    np.testing.assert_allclose(
        needed(model, almost, NOISE, bounds), bounds.high - bounds.low, rtol=0.1
    )


def test_the_needed_change_of_each_motor_is_that_of_the_steps_in_which_it_acts(tmp_path):
    path = tmp_path / "arm.xml"
    force = 'gear="2" forcelimited="true" forcerange="-1 1"'
    path.write_text(models.ARM.replace('gear="2"', force))
    rng = np.random.default_rng(0)
    state = rng.uniform(-0.5, 0.5, (60, 4))
    action = rng.uniform(-0.5, 0.5, (60, 2))
    action[20:, 1] = 3.0  # of the elbow, whose motor has no more than 1
    bounds = Bounds(0.02, np.full(2, -4.0), np.full(2, 4.0))
    env, world = make_source(load_model(path), state, np.zeros(4), bounds, 0.5)
    missing = jnp.asarray([0.1, -0.2])

    @jax.jit
    @jax.vmap
    def end(state, action):
        return env.step(world, env.at(world, state), action + missing, jax.random.key(0)).state.obs

    steps = Steps(state, action, np.asarray(end(jnp.asarray(state), jnp.asarray(action))))
    change = jax.jit(lambda w: needed_change(env, w, steps))(world)
    np.testing.assert_allclose(change, np.abs(missing), rtol=0.01)


@pytest.fixture
def noise_of_source(read, tmp_path, monkeypatch):
    """A function that returns the deviation of commands in the source of GAT, in half-ranges."""

    def still(params, obs, key):
        del params, obs, key
        return jnp.zeros(1), jnp.zeros(())

    def stop(env, agent, config):
        raise RuntimeError(env, agent)

    def deviation(model) -> float:
        monkeypatch.setattr(learn, "make_method", stop)
        run = RunDirectory.create(tmp_path / "run", {}, "test", [0])
        with pytest.raises(RuntimeError) as made:
            ground(model, read[1], SMALL, run, holdout=read[1][:1], policy=still)
        env, agent = made.value.args
        keys = jax.random.split(jax.random.key(0), 5000)
        actions = jax.vmap(agent, (None, None, 0))((), jnp.zeros(2), keys)[0]
        return float(actions.std() / ((env.action_high - env.action_low)[0] / 2))

    return deviation


def test_the_source_of_gat_acts_with_noise_of_three_times_the_needed_change(
    read, recorded, noise_of_source
):
    model, recordings = read
    bounds = choose_bounds(model, recordings)
    wanted = 3 * abs(recorded[2]) / ((bounds.high - bounds.low)[0] / 2)
    assert wanted < 0.5
    assert noise_of_source(model) == pytest.approx(wanted, rel=0.25)


def test_a_motor_that_is_saturated_at_times_does_not_make_the_noise_the_whole_range(
    tmp_path, noise_of_source
):
    assert noise_of_source(limited(tmp_path, 0.9)) < 0.8


def test_commands_that_never_do_anything_are_explored_in_all_their_range(tmp_path, noise_of_source):
    path = tmp_path / "idle.xml"
    path.write_text(models.PENDULUM.replace('joint="hinge" ctrl', 'joint="hinge" gear="0" ctrl'))
    assert noise_of_source(load_model(path)) == pytest.approx(1.0, rel=0.05)
