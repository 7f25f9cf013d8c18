"""Control steps and paths cut from recordings, and how far their commands may go."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from garat_jax.diagnosis import load_model
from garat_jax.env import LARGEST
from garat_jax.errors import UserError
from garat_jax.ground.source import make_source
from garat_jax.ground.steps import (
    Bounds,
    choose_bounds,
    control_paths,
    control_steps,
    longest_path,
)
from garat_jax.methods.recorded import (
    Paths,
    Steps,
    as_recorded,
    as_transitions,
    path_error,
)
from garat_jax.methods.transition_error import constant_error
from tests import models


def irregular(read):
    """Return a recording of five samples and a gap, the command one step of a ramp in each."""
    time = np.asarray([0.0, 0.01, 0.03, 0.04, 0.05, 1.0, 1.01])
    state = np.stack([time, 2 * time], axis=1)
    return dataclasses.replace(
        read[1][0],
        time=time,
        qpos=state[:, :1],
        qvel=state[:, 1:],
        ctrl=np.arange(7.0)[:, None],
        spans=((0, 5), (5, 7)),
    )


def test_control_steps_hold_the_mean_command_and_never_cross_a_gap(read):
    steps = control_steps([irregular(read)], 0.02)
    np.testing.assert_allclose(steps.state[:, 0], [0.0, 0.01, 0.03])
    np.testing.assert_allclose(steps.next_state - steps.state, [[0.02, 0.04]] * 3)
    # 10 ms of command 0, then 10 ms of 1; 20 ms of 1; 10 ms of 2, then 10 ms of 3.
    np.testing.assert_allclose(steps.action[:, 0], [0.5, 1.0, 2.5], atol=1e-12)


def test_control_paths_are_steps_that_follow_each_other(read):
    (recording,) = [irregular(read)]
    paths = control_paths([recording], 0.02, 2)
    np.testing.assert_allclose(paths.start[:, 0], [0.0, 0.01])
    np.testing.assert_allclose(paths.state[..., 0], [[0.02, 0.04], [0.03, 0.05]])
    np.testing.assert_allclose(paths.action[..., 0], [[0.5, 1.5], [1.0, 2.5]], atol=1e-12)
    assert longest_path([recording], 0.02) == 2
    assert longest_path([recording], 0.2) == 1


def test_the_error_of_a_path_is_how_far_the_commands_lead_from_it(read):
    model, recordings = read
    bounds = choose_bounds(model, recordings)
    paths = Paths(*(x[::9] for x in control_paths(recordings, bounds.interval, 5)))
    env, world = make_source(model, paths.start, np.zeros(2), bounds, 0.5)

    @jax.jit
    def error(world, push, weight):
        starts = jax.vmap(env.at, (None, 0))(world, jnp.asarray(paths.start, jnp.float32))
        pushed = paths._replace(action=paths.action + push)
        return path_error(env, world, starts, pushed, weight)

    only_angle, only_speed = jnp.asarray([1.0, 0.0]), jnp.asarray([0.0, 1.0])
    angle, speed = error(world, 0.0, only_angle), error(world, 0.0, only_speed)
    both = error(world, 0.0, 4 * (only_angle + only_speed))
    np.testing.assert_allclose(both, 2 * np.hypot(angle, speed), rtol=1e-5)
    assert error(world, 0.5, only_speed) > 2 * speed
    assert error(world, 0.0, jnp.inf * (only_angle + only_speed)) == LARGEST


def test_recordings_shorter_than_a_step_are_refused(read):
    with pytest.raises(UserError, match=r"no recording has 3 s in a row; .* smaller --interval"):
        control_steps(read[1], 3.0)


def test_commands_may_go_half_their_range_beyond_it_within_ctrlrange(read):
    model, recordings = read
    ctrl = np.linspace(-1.0, 2.0, len(recordings[0].time))[:, None]
    bounds = choose_bounds(model, [dataclasses.replace(recordings[0], ctrl=ctrl)])
    assert (bounds.low, bounds.high) == (pytest.approx(-2.5), pytest.approx(3.0))
    assert bounds.interval == pytest.approx(0.016)  # two samples, the nearest to 0.02 s


def test_commands_outside_a_recordings_spans_do_not_count(read):
    model, recordings = read
    ctrl = np.linspace(-1.0, 2.0, len(recordings[0].time))[:, None]
    border = 2 * len(ctrl) // 3
    first = dataclasses.replace(recordings[0], ctrl=ctrl, spans=((0, border),))
    bounds = choose_bounds(model, [first])
    last = ctrl[border - 1, 0]
    assert bounds.low == pytest.approx(-1.0 - (last + 1.0) / 2)
    assert bounds.high == pytest.approx(last + (last + 1.0) / 2)


def test_recorded_commands_beyond_ctrlrange_count_as_its_ends(read):
    model, recordings = read
    for commands, low in ((np.linspace(1.0, 9.0, len(recordings[0].time)), 0.0), (5.0, -3.0)):
        ctrl = np.zeros_like(recordings[0].ctrl) + np.reshape(commands, (-1, 1))
        bounds = choose_bounds(model, [dataclasses.replace(recordings[0], ctrl=ctrl)])
        assert (bounds.low, bounds.high) == (pytest.approx(low), pytest.approx(3.0))


def test_the_source_without_bounds_is_sent_what_was_recorded(read):
    model, recordings = read
    steps = control_steps(recordings, 0.016)
    far = steps._replace(action=np.full_like(steps.action, 2.0))
    bounds = Bounds(0.016, np.asarray([1.0]), np.asarray([1.5]))
    env, world = make_source(model, far.state, np.zeros(2), bounds, 0.2)
    free = env.unbounded()
    assert np.asarray(as_transitions(env, far).action).max() == 1.5
    np.testing.assert_array_equal(as_transitions(free, far).action, far.action)
    seen = as_recorded(free, world, Steps(*(column[:20] for column in far)))
    lowest, nothing = (float(constant_error(free, world, seen, a).mean) for a in (1.0, 0.0))
    assert float(constant_error(env, world, seen, 0.0).mean) == pytest.approx(lowest)
    assert nothing != pytest.approx(lowest, rel=0.1)


def test_what_cannot_be_grounded_is_refused(read, tmp_path):
    model, recordings = read
    slow = dataclasses.replace(recordings[0], time=5 * recordings[0].time)
    with pytest.raises(UserError, match=r"--interval 0.02: .* a sample, 0.04 s, at least"):
        choose_bounds(model, recordings, 0.02, [slow])
    with pytest.raises(UserError, match=r"--interval 0.001: .* a sample, 0.008 s, at least"):
        choose_bounds(model, recordings, 0.001)
    for interval in (np.inf, np.nan):
        with pytest.raises(UserError, match="expected a number of seconds"):
            choose_bounds(model, recordings, interval)
    passive = tmp_path / "passive.xml"
    passive.write_text(models.TUMBLER)
    with pytest.raises(UserError, match=r"passive.xml has no actuator, .* garat diagnose"):
        choose_bounds(load_model(passive), recordings)
    free = tmp_path / "free.xml"
    free.write_text(models.PENDULUM.replace('ctrlrange="-3 3" ctrllimited="true"', ""))
    still = [dataclasses.replace(r, ctrl=0 * r.ctrl) for r in recordings]
    with pytest.raises(UserError, match="'motor' never changes and it has no ctrlrange"):
        choose_bounds(load_model(free), still)
