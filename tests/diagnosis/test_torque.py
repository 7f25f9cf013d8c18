"""Measured torques: equal ones fit, friction that a controller hides in position shows."""

import dataclasses

import mujoco
import numpy as np
import pytest

from garat_jax.diagnosis import torque as module
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.torque import compare_torques
from tests import models

SERVO = models.PENDULUM.replace("<motor", '<position kp="400" kv="20"').replace(
    'ctrlrange="-3 3" ctrllimited="true"', ""
)


def track(friction):
    """A stiff servo follows a sine; the torque that it gives is measured."""
    spec = models.spec(SERVO)
    spec.joints[0].frictionloss = friction
    model = spec.compile()
    data = mujoco.MjData(model)
    rows = []
    for k in range(2000):
        data.ctrl[0] = 0.5 * np.sin(2.0 * k * model.opt.timestep)
        mujoco.mj_step1(model, data)
        state = data.time, data.qpos[0], data.qvel[0], data.ctrl[0]
        mujoco.mj_step2(model, data)
        rows.append((*state, data.qfrc_actuator[0]))
    time, qpos, qvel, ctrl, torque = np.asarray(rows).T
    return Recording(
        "made.csv", time, qpos[:, None], qvel[:, None], ctrl[:, None], {"hinge": torque}, True,
        ((0, len(time)),), (),
    )  # fmt: skip


def test_the_true_model_gives_the_measured_torque():
    model = models.spec(SERVO).compile()
    (error,) = compare_torques(model, [track(0.0)])
    assert (error.joint, error.unit) == ("hinge", "N m")
    assert error.motion_fit_percent > 97
    assert error.actuator_fit_percent > 97


def test_torques_are_smoothed_alike_and_a_constant_one_has_no_fit():
    model = models.spec(models.PENDULUM).compile()
    made = track(0.0)
    ctrl = np.repeat(np.random.default_rng(0).uniform(-1, 1, 80), 25)[:, None]
    moved = dataclasses.replace(made, ctrl=ctrl, torque={"hinge": ctrl[:, 0]})
    (error,) = compare_torques(model, [moved])
    assert error.actuator_fit_percent == pytest.approx(100.0)
    still = dataclasses.replace(moved, torque={"hinge": np.full(len(ctrl), 0.3)})
    (error,) = compare_torques(model, [still])
    assert np.isnan(error.actuator_fit_percent) and error.actuator_rmse > 0.1


def test_hidden_friction_shows_in_the_torque_of_the_motion():
    model = models.spec(SERVO).compile()
    (error,) = compare_torques(model, [track(0.3)])
    assert error.motion_rmse == pytest.approx(0.3, rel=0.1)
    assert error.actuator_rmse < 0.05
    assert "from what the motion takes in the model" in error.sentence


def test_without_measured_torques_there_is_nothing_to_compare():
    model = models.spec(SERVO).compile()
    assert compare_torques(model, [dataclasses.replace(track(0.0), torque={})]) == ()


def tumble():
    """A free box with a ball joint that a known torque turns; two torques are measured."""
    model = models.spec(models.TUMBLER).compile()
    data = mujoco.MjData(model)
    data.qpos[2] = 20.0
    data.qvel[:] = [0.3, -0.2, 1.0, 1.5, -2.0, 1.0, 0.7, 1.1, -0.4]
    rows = []
    for k in range(500):
        data.qfrc_applied[7] = 1e-3 * np.sin(0.05 * k)
        mujoco.mj_step1(model, data)
        rows.append((data.time, data.qpos.copy(), data.qvel.copy(), data.qfrc_applied[7]))
        mujoco.mj_step2(model, data)
    time, qpos, qvel, torque = (np.asarray(column) for column in zip(*rows, strict=True))
    measured = {"ball.1": torque, "free.0": np.zeros(len(time))}
    nothing, spans = np.zeros((len(time), 0)), ((0, len(time)),)
    return model, Recording("made.csv", time, qpos, qvel, nothing, measured, True, spans, ())


def test_each_dof_of_a_ball_joint_is_compared():
    model, recording = tumble()
    errors = compare_torques(model, [recording])
    assert [(e.joint, e.unit) for e in errors] == [("free.0", "N"), ("ball.1", "N m")]
    assert errors[1].motion_fit_percent > 80


def test_the_motion_is_inverted_once_a_span(monkeypatch):
    model, whole = tumble()
    parts = dataclasses.replace(whole, spans=((0, 250), (250, 500)))
    computed = []

    def counted(model, recordings, world):
        computed.extend(span for recording in recordings for span in recording.spans)
        return missing_torque(model, recordings, world)

    missing_torque = module.missing_torque
    monkeypatch.setattr(module, "missing_torque", counted)
    errors = compare_torques(model, [parts, dataclasses.replace(whole, torque={})])
    assert computed == [(0, 250), (250, 500)]
    halves = [dataclasses.replace(whole, spans=(span,)) for span in parts.spans]
    again = compare_torques(model, halves)
    for one, other in zip(again, errors, strict=True):  # NaN is not equal to itself
        np.testing.assert_equal(dataclasses.asdict(one), dataclasses.asdict(other))
    assert [e.joint for e in errors] == ["free.0", "ball.1"]
