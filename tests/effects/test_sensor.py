"""Sensors change what is seen, not what is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from garat_jax import dynamics
from garat_jax.effects import EncoderOffset, EncoderScale, SensorDelay
from garat_jax.env import make_world
from garat_jax.envs.inverted_pendulum import InvertedPendulum
from tests.models import PENDULUM, TUMBLER, spec


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True):
        yield


def swing(*effects, num_steps: int = 20, mjcf: str = PENDULUM):
    """Return true and sensed (qpos, qvel) after each step of 6 ms, [num_steps + 1, ...] each."""
    world = dynamics.compile(spec(mjcf), effects=effects, engine="mujoco")
    host = world.host.model
    state = dynamics.initial_state(world, jnp.asarray(host.qpos0) + 0.3, jnp.ones(host.nv))
    step = jax.jit(dynamics.step, static_argnums=3)
    states = [state]
    for _ in range(num_steps):
        states.append(step(world, states[-1], jnp.full(host.nu, 0.2), 3))
    seen = [dynamics.sensed(world, s) for s in states]
    return tuple(
        np.stack([np.concatenate([s.qpos, s.qvel]) for s in part]) for part in (states, seen)
    )


def test_encoders_report_scale_times_angle_plus_offset_and_the_motion_stays():
    plain, _ = swing()
    true, seen = swing(
        EncoderScale("joint/hinge", scale=1.1), EncoderOffset("joint/hinge", offset=0.2)
    )
    np.testing.assert_array_equal(true, plain)
    np.testing.assert_allclose(seen[:, 0], 1.1 * true[:, 0] + 0.2)
    np.testing.assert_allclose(seen[:, 1], 1.1 * true[:, 1])


@pytest.mark.parametrize("steps", [0.0, 1.0, 3.0, 2.25])
def test_a_delay_reports_earlier_states_and_interpolates_between(steps):
    true, seen = swing(SensorDelay("all", delay=0.006 * steps))
    whole, fraction = int(steps), steps % 1
    late = np.concatenate([np.repeat(true[:1], whole + 1, axis=0), true])
    expected = (1 - fraction) * late[1 : len(true) + 1] + fraction * late[: len(true)]
    np.testing.assert_allclose(seen, expected, rtol=1e-9)


def test_a_delay_after_an_offset_delays_the_offset_signal():
    effects = (EncoderOffset("joint/hinge", offset=0.2), SensorDelay("all", delay=0.015))
    (_, first), (_, other) = swing(*effects), swing(*effects[::-1])
    _, plain = swing(effects[1])
    np.testing.assert_allclose(first[:, 0], plain[:, 0] + 0.2)
    np.testing.assert_allclose(other, first)


def test_delayed_quaternions_are_unit():
    _, seen = swing(SensorDelay("all", delay=0.02), mjcf=TUMBLER)
    np.testing.assert_allclose(np.linalg.norm(seen[5:, 3:7], axis=1), 1.0)
    np.testing.assert_allclose(np.linalg.norm(seen[5:, 7:11], axis=1), 1.0)


def test_a_delay_is_not_offered_where_nothing_is_commanded():
    assert SensorDelay.targets(spec(TUMBLER).compile()) == []


def test_a_policy_sees_the_sensors_and_the_task_judges_the_truth():
    effects = (EncoderOffset("joint/hinge", offset=0.5), SensorDelay("all", delay=0.04))
    plain, sensing = (
        make_world(InvertedPendulum(), effects=e, engine="mujoco") for e in ((), effects)
    )
    key, action = jax.random.key(0), jnp.ones(1)
    starts = [w.env.reset(w.params, key) for w in (plain, sensing)]
    results = [
        w.env.step(w.params, s, action, key) for w, s in zip((plain, sensing), starts, strict=True)
    ]
    shift = np.asarray([0, 0.5, 0, 0])
    np.testing.assert_allclose(starts[1].obs, starts[0].obs + shift)
    np.testing.assert_allclose(results[1].state.obs, starts[0].obs + shift, atol=1e-9)
    np.testing.assert_allclose(results[1].state.physics.qpos, results[0].state.physics.qpos)
    assert not results[1].terminated  # 0.5 rad would be fallen
