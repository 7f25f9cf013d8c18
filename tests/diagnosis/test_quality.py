"""What a recording is worth: rates, noise and steps as made, command lags as hidden."""

import dataclasses

import numpy as np
import pytest

from garat_jax.diagnosis import Recording
from garat_jax.diagnosis.hidden import ANGLE_NOISE, SPEED_NOISE, make_recordings
from garat_jax.diagnosis.quality import assess, command_lags, torque_per_command
from tests import models

MODEL = models.spec(models.PENDULUM).compile()
ARM = models.spec(models.ARM).compile()


def record(folder, kind="none", seed=1, **size):
    (folder / "pendulum.xml").write_text(models.PENDULUM)
    made = make_recordings(
        folder / "pendulum.xml", folder / "data", seed, kind=kind, num_recordings=2, **size
    )
    return made, [Recording.read(path, MODEL) for path in (*made.fit, *made.holdout)]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_lag_of_commands_is_recovered(tmp_path, seed):
    made, recordings = record(tmp_path, "actuator_delay", seed, seconds=6.0)
    for recording in recordings:
        lag = command_lags(recording, MODEL)["motor"]
        assert lag == pytest.approx(made.parameters["delay"], abs=2e-3)


@pytest.mark.parametrize("kind", ["none", "coulomb_friction", "motor_gain", "viscous_damping"])
def test_commands_in_time_have_no_lag(tmp_path, kind):
    _, recordings = record(tmp_path, kind, seconds=6.0)
    for recording in recordings:
        assert command_lags(recording, MODEL)["motor"] == pytest.approx(0.0, abs=2e-3)


def test_without_excitation_no_lag_is_claimed(tmp_path):
    _, recordings = record(tmp_path, seconds=3.0)
    still = dataclasses.replace(recordings[0], ctrl=np.zeros_like(recordings[0].ctrl))
    assert np.isnan(command_lags(still, MODEL)["motor"])


def test_rate_noise_and_gaps_are_told(tmp_path):
    _, recordings = record(tmp_path, seconds=4.0, rate=200.0)
    quality = assess(dataclasses.replace(recordings[0], spans=((0, 400), (400, 800))), MODEL)
    assert (quality.samples, quality.gaps, quality.velocity) == (800, 1, "measured")
    assert quality.rate == pytest.approx(200.0)
    assert quality.irregularity < 1e-6
    assert quality.channels["qpos.hinge"].noise == pytest.approx(ANGLE_NOISE, rel=0.2)
    assert quality.channels["qvel.hinge"].noise == pytest.approx(SPEED_NOISE, rel=0.2)
    assert quality.channels["qpos.hinge"].unit == "rad"


def test_the_step_of_an_encoder_is_told(tmp_path):
    _, recordings = record(tmp_path, seconds=3.0)
    step = 2 * np.pi / 512
    coarse = dataclasses.replace(
        recordings[0], qpos=np.round(recordings[0].qpos / step) * step, velocity_measured=False
    )
    quality = assess(coarse, MODEL)
    assert quality.channels["qpos.hinge"].step == pytest.approx(step, rel=1e-3)
    assert list(quality.channels) == ["qpos.hinge"]
    assert quality.velocity == "estimated"


def test_torque_per_command_is_gear_and_gain():
    np.testing.assert_allclose(torque_per_command(ARM), [[60.0, 0.0], [0.0, 2.0]], atol=1e-6)
