"""Exported MJCF, stepped by plain C MuJoCo, is what our dynamics does."""

import jax
import mujoco
import numpy as np
import pytest

from garat_jax.dynamics import compile
from garat_jax.effects import CATALOGUE
from garat_jax.errors import UserError
from tests.effects.truth import RIG, SUBSTEPS, commands, predict
from tests.models import spec

TARGETS = {"joint": "joint/hinge", "actuator": "actuator/motor"}
WHOLE = {
    "viscous_damping": {"coefficient": 0.2},
    "coulomb_friction": {"torque": 0.3},
    "torque_offset": {"torque": -0.4},
    "rotor_inertia": {"inertia": 0.05},
    "joint_stiffness": {"stiffness": 0.8, "reference": 0.5},
    "motor_gain": {"scale": 0.7},
    "torque_saturation": {"limit": 0.4},
    "back_emf": {"coefficient": 0.2},
}
FROM_REST = {"actuator_delay": {"delay": 0.013}}
NEARLY = {"quadratic_drag": {"coefficient": 0.05}, "actuator_lag": {"time_constant": 0.03}}
PARTLY = {
    "asymmetric_friction": ({"coulomb_positive": 0.3, "coulomb_negative": 0.1}, "mean"),
    "stribeck_friction": ({"coulomb": 0.1, "static": 0.3}, "Coulomb"),
    "load_friction": ({"ratio": 0.2}, "no words"),
    "cogging_torque": ({"amplitude": 0.2}, "no words"),
    "motor_deadband": ({"width": 0.1}, "no words"),
    "motor_curve": ({"saturation": 1.0}, "no words"),
    "backlash": ({"gap": 0.1}, "hinge_motor is a body"),
    "joint_flexibility": ({"stiffness": 10.0}, "hinge_motor is a body"),
}


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True):
        yield


def make(kind: str, values: dict[str, float]):
    return CATALOGUE[kind](target=TARGETS[CATALOGUE[kind].elements[0]], **values)


def exported(effect, ctrl: np.ndarray) -> tuple[np.ndarray, str]:
    """Return angle and speed of the exported model after each sample, and what it leaves out."""
    changed = spec(RIG)
    left_out = effect.export(changed)
    changed.compile()
    model = mujoco.MjModel.from_xml_string(changed.to_xml())
    data = mujoco.MjData(model)
    data.qpos[0] = 0.4
    states = []
    for command in ctrl:
        data.ctrl[:] = command
        mujoco.mj_step(model, data, SUBSTEPS)
        states.append([data.qpos[0], data.qvel[0]])
    return np.asarray(states), left_out


@pytest.mark.parametrize("kind", [*WHOLE, *FROM_REST, *NEARLY])
def test_the_exported_model_moves_as_ours(kind):
    effect = make(kind, {**WHOLE, **FROM_REST, **NEARLY}[kind])
    ctrl = np.concatenate([np.zeros(10), commands()])
    path, left_out = exported(effect, ctrl)
    ours, plain = predict(RIG, (effect,), ctrl), predict(RIG, (), ctrl)
    assert bool(left_out) == (kind not in WHOLE)
    assert np.abs(plain - ours).max() > 0.05
    if kind in NEARLY:  # another discretisation of the same law
        assert np.abs(path - ours).max() < 0.1 * np.abs(plain - ours).max()
    else:
        np.testing.assert_allclose(path, ours, atol=1e-6)


@pytest.mark.parametrize("kind", PARTLY)
def test_what_mjcf_cannot_say_is_said(kind):
    values, words = PARTLY[kind]
    left_out = exported(make(kind, values), commands()[:2])[1]
    assert words in left_out
    assert "\n" not in left_out


@pytest.mark.parametrize("kind", ["quadratic_drag", "actuator_delay"])
def test_what_mjx_would_ignore_of_an_exported_model_is_said_and_refused(kind):
    changed = spec(RIG)
    assert "MJX does not" in make(kind, {**NEARLY, **FROM_REST}[kind]).export(changed)
    with pytest.raises(UserError, match="engine mjx cannot step this model: it ignores"):
        compile(changed, engine="mjx")


def test_an_offset_without_an_unlimited_actuator_is_said():
    changed = spec(RIG.replace('gear="2"', 'gear="2" forcerange="-1 1"'))
    assert "no unlimited actuator" in make("torque_offset", {"torque": 0.1}).export(changed)


def test_an_offset_is_not_left_to_an_actuator_that_is_off():
    off = RIG.replace('gear="2"', 'gear="2" group="1"')
    changed = spec(off.replace("<option", '<option actuatorgroupdisable="1"'))
    assert "no unlimited actuator" in make("torque_offset", {"torque": 0.1}).export(changed)
    assert make("torque_offset", {"torque": 0.1}).export(spec(off)) == ""
