"""The source that begins in recorded states: what networks see of it, and the cloned policy."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from garat_jax.methods.recorded import RecordedEnv, Steps, clone, cloned

MJCF = """<mujoco><worldbody>
  <body><joint name="rail" type="slide"/><geom size="0.1"/>
    <body><joint name="elbow" type="hinge" range="-90 90" limited="true"/><geom size="0.1"/>
      <body><joint name="wheel" type="hinge"/><geom size="0.1"/></body>
    </body>
  </body>
</worldbody></mujoco>"""
WHEEL = 2


@pytest.fixture(scope="module")
def env():
    host = mujoco.MjModel.from_xml_string(MJCF)
    states = np.zeros((1, host.nq + host.nv))
    return RecordedEnv(states, states[0], host, -np.ones(1), np.ones(1), 1, 10)


def test_networks_see_sine_and_cosine_of_joints_that_turn_without_end(env):
    obs = jnp.arange(1.0, 7.0)
    wanted = [1.0, 2.0, np.sin(3.0), 4.0, 5.0, 6.0, np.cos(3.0)]
    np.testing.assert_allclose(env.features(obs), wanted, rtol=1e-6)
    both = jnp.stack([obs, obs.at[WHEEL].add(2 * np.pi)])
    once, turned = env.features(both)
    np.testing.assert_allclose(once, turned, atol=1e-5)


@pytest.mark.parametrize("turns", [0, 2])
def test_the_cloned_policy_does_what_was_done_in_a_state_nearby(env, turns):
    rng = np.random.default_rng(0)
    state = rng.uniform(-1, 1, (500, 6)) * [1e-3, 1e-3, 3.0, 1e-3, 1e-3, 100.0]
    action = np.sign(state[:, WHEEL, None])  # a switch: a mean would be neither
    params = clone(env, Steps(state, action, state))
    keys = jax.random.split(jax.random.key(0), 50)
    for angle in (1.5, -1.5):
        obs = jnp.asarray([0.0, 0.0, angle + 2 * np.pi * turns, 0.0, 0.0, 30.0])
        drawn, _ = jax.vmap(cloned(env), (None, None, 0))(params, obs, keys)
        assert (drawn == np.sign(angle)).all()
