"""Rotations are read alike however they are written: q or -q, within a turn or on and on."""

import mujoco
import numpy as np

from garat_jax.diagnosis.columns import signals
from garat_jax.diagnosis.measurements import Recording, noise
from tests import models
from tests.diagnosis.test_measurements import TUMBLER, columns, save, tumbling


def test_quaternions_of_either_sign_are_read_alike(tmp_path):
    time, qpos, _ = tumbling()
    names = [s.name for s in signals(TUMBLER)][: TUMBLER.nq]
    flipped = qpos.copy()
    flipped[60:, 3:7] *= -1
    flipped[30:100, 7:11] *= -1
    plain, other = (
        Recording.read(
            save(tmp_path, {"time": time, **dict(zip(names, q.T, strict=True))}), TUMBLER
        )
        for q in (qpos, flipped)
    )
    np.testing.assert_array_equal(other.qpos, plain.qpos)
    np.testing.assert_array_equal(other.qvel, plain.qvel)


def test_the_parts_of_a_quaternion_have_one_noise(tmp_path):
    time, qpos, _ = tumbling()
    rng, first = np.random.default_rng(0), (3, 7)
    for start in first:  # level but for noise, of which w shows next to nothing
        qpos[:, start : start + 4] = [1.0, 0.0, 0.0, 0.0] + 1e-3 * rng.normal(size=(len(time), 4))
    names = [s.name for s in signals(TUMBLER)][: TUMBLER.nq]
    file = save(tmp_path, {"time": time, **dict(zip(names, qpos.T, strict=True))})
    recording = Recording.read(file, TUMBLER)
    assert recording.quaternions == first
    assert recording.qpos[:, 3].std() < 1e-5
    for start in first:
        sizes = noise(recording)[start : start + 4]
        np.testing.assert_allclose(sizes, 1e-3, rtol=0.3)
        assert len({*sizes}) == 1


def turning(wrapped: bool):
    """A pendulum that turns round twice, back once and stays there, 4 s at 250 Hz."""
    time = np.arange(1000) / 250
    angle = np.interp(time, [0.0, 2.0, 3.0, 4.0], [0.0, 4 * np.pi, 2 * np.pi, 2 * np.pi + 0.1])
    written = (angle + np.pi) % (2 * np.pi) - np.pi if wrapped else angle
    return columns(1000, time=time, qpos__hinge=written, qvel__hinge=np.gradient(angle, time))


def test_an_angle_that_is_written_within_a_turn_goes_on_turning(tmp_path):
    spec = models.spec(models.PENDULUM)
    spec.joints[0].limited = mujoco.mjtLimited.mjLIMITED_FALSE
    model = spec.compile()
    recording = Recording.read(save(tmp_path, turning(wrapped=True)), model)
    plain = Recording.read(save(tmp_path, turning(wrapped=False)), model)
    np.testing.assert_allclose(recording.qpos, plain.qpos, atol=1e-9)
    assert (
        recording.warnings[0] == "run.csv: qpos.hinge jumps by a turn and is taken to go on turning"
    )
    assert not [line for line in plain.warnings if "turning" in line]


def test_a_joint_that_cannot_turn_is_not_unwrapped(tmp_path):
    spec = models.spec(models.PENDULUM)
    spec.joints[0].limited = mujoco.mjtLimited.mjLIMITED_TRUE
    spec.joints[0].range = [-3.0, 3.0]
    recording = Recording.read(save(tmp_path, turning(wrapped=True)), spec.compile())
    assert np.ptp(recording.qpos) < 2 * np.pi + 1e-9
