"""A limit far below what a servo's range of commands allows, and one that is always felt."""

import dataclasses

import mujoco
import numpy as np
import pytest

from garat_jax.diagnosis.diagnose import diagnose
from garat_jax.diagnosis.localise import missing_torque
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.model_card import Model
from garat_jax.effects import CATALOGUE
from tests.models import spec

SERVO = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody><body name="pole" pos="0 0 1">
    <joint name="hinge" axis="0 1 0" damping="0.1" armature="0.02"/>
    <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.5"
          contype="0" conaffinity="0"/>
  </body></worldbody>
  <actuator>
    <position name="motor" joint="hinge" kp="70" kv="3" ctrlrange="-1.6 1.6"/>
  </actuator>
</mujoco>
"""
KINDS = ("torque_saturation", "viscous_damping", "coulomb_friction", "motor_gain", "rotor_inertia")
TIME = np.arange(1000) * 0.004


def record(limit: float, seed: int) -> tuple[Recording, float]:
    """Record smooth motion at a fine timestep; return it and the share of time at the limit."""
    rng = np.random.default_rng(seed)
    changed = spec(SERVO)
    changed.option.timestep /= 16
    changed.actuator("motor").forcelimited = True
    changed.actuator("motor").forcerange = [-limit, limit]
    model = changed.compile()
    data = mujoco.MjData(model)
    rates = np.asarray([4.3, 6.4, 8.1]) + rng.uniform(-0.2, 0.2, 3)
    command = 1.6 * np.sin(rates * TIME[:, None] + rng.uniform(0, 6, 3)).mean(axis=1)
    data.qpos[0] = command[0]
    states, at_limit = [], []
    for ctrl in command:
        states.append([data.qpos[0], data.qvel[0]])
        data.ctrl[0] = ctrl
        mujoco.mj_step(model, data, 32)
        at_limit.append(abs(data.actuator_force[0]) > 0.999 * limit)
    noisy = np.asarray(states) + rng.normal(size=(len(TIME), 2)) * [1e-3, 1e-2]
    position, velocity = noisy[:, :1], noisy[:, 1:]
    spans = ((0, len(TIME)),)
    recording = Recording(
        f"{limit}, {seed}", TIME, position, velocity, command[:, None], {}, True, spans, ()
    )
    return recording, float(np.mean(at_limit))


def test_what_each_actuator_gives_is_known_and_a_model_without_any_is_fine():
    recording, _ = record(100.0, 0)
    missing = missing_torque(spec(SERVO).compile(), [recording])
    np.testing.assert_allclose(missing.drive, missing.command)
    assert missing.ctrl.shape == missing.drive.shape == (len(missing.time), 1)
    free = spec(SERVO)
    free.delete(free.actuators[0])
    recording = dataclasses.replace(recording, ctrl=recording.ctrl[:, :0])
    missing = missing_torque(free.compile(), [recording])
    assert missing.actuators == ()
    assert missing.drive.shape == (len(missing.time), 0)


@pytest.mark.parametrize(("limit", "least", "most"), [(1.7, 0.05, 0.2), (1.0, 0.4, 0.95)])
def test_a_limit_is_found_however_rarely_it_is_felt(limit, least, most):
    model = Model(
        "servo", __file__, __file__, spec(SERVO), (), (), {k: CATALOGUE[k] for k in KINDS}
    )
    recordings, shares = zip(*(record(limit, seed) for seed in range(4)), strict=True)
    assert least < np.mean(shares) < most
    (found,) = diagnose(model, recordings[:3], recordings[3:]).selected
    assert found.effect == "torque_saturation"
    assert found.parameters["limit"].estimate == pytest.approx(limit, rel=0.01)
