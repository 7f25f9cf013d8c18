"""What a recording is worth: rates, noise and steps as made, command lags as hidden."""

import dataclasses

import mujoco
import numpy as np
import pytest

from garat_jax.diagnosis import Recording
from garat_jax.diagnosis.filters import quantum, white_noise
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


@pytest.mark.parametrize("jitter", [0.0, 1e-3])
@pytest.mark.parametrize("lag", [0.0, 0.012])
def test_lags_are_exact_however_samples_come(lag, jitter):
    """Samples of an exact simulation, at even times or not; commands act as they are or later."""
    fine = models.spec(models.PENDULUM)
    fine.option.timestep = 2.5e-4
    model = fine.compile()
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    time = np.arange(1000) * 0.004 + jitter * rng.uniform(-1, 1, 1000)
    every = np.arange(time[-1], step=2.5e-4)
    ctrl = rng.uniform(-1, 1, 41)[(time / 0.1).astype(int)]
    late = ctrl[np.maximum(np.searchsorted(time, every - lag, side="right") - 1, 0)]
    path = []
    for command in late:
        path.append((data.qpos[0], data.qvel[0]))
        data.ctrl[0] = command
        mujoco.mj_step(model, data)
    qpos, qvel = (np.interp(time, every, column)[:, None] for column in np.transpose(path))
    made = Recording("made", time, qpos, qvel, ctrl[:, None], {}, True, ((0, 1000),), ())
    assert command_lags(made, MODEL)["motor"] == pytest.approx(lag, abs=5e-4)


def test_an_actuator_at_its_limit_does_not_tell_its_lag():
    servo = '<position kp="50" kv="1"'
    free = models.spec(models.PENDULUM.replace("<motor", servo)).compile()
    weak = models.spec(models.PENDULUM.replace("<motor", f'{servo} forcerange="-1 1"')).compile()
    np.testing.assert_allclose(torque_per_command(weak), torque_per_command(free))
    rng = np.random.default_rng(0)
    data = mujoco.MjData(free)
    rows = []
    for target in np.repeat(rng.uniform(-0.3, 0.3, 50), 40):
        rows.append((data.qpos[0], data.qvel[0], target))
        data.ctrl[0] = target
        mujoco.mj_step(free, data)
    qpos, qvel, ctrl = np.asarray(rows).T[..., None]
    time = np.arange(len(rows)) * free.opt.timestep
    made = Recording("made", time, qpos, qvel, ctrl, {}, True, ((0, len(time)),), ())
    assert command_lags(made, free)["motor"] == pytest.approx(0.0, abs=2e-3)
    assert np.isnan(command_lags(made, weak)["motor"])


def test_without_excitation_no_lag_is_claimed(tmp_path):
    _, recordings = record(tmp_path, seconds=3.0)
    still = dataclasses.replace(recordings[0], ctrl=np.zeros_like(recordings[0].ctrl))
    assert np.isnan(command_lags(still, MODEL)["motor"])


def test_rate_noise_and_gaps_are_told(tmp_path):
    _, recordings = record(tmp_path, seconds=4.0, rate=200.0)
    time = recordings[0].time + np.repeat([0.0, 1.0, 2.0], [400, 10, 390])
    split = dataclasses.replace(recordings[0], time=time, spans=((0, 400), (410, 800)))
    quality = assess(split, MODEL)
    assert (quality.samples, quality.gaps, quality.velocity) == (800, 2, "measured")
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


@pytest.mark.parametrize("speed", [0.0, 3.0])
def test_an_encoder_has_noise_where_it_rests_and_where_it_runs(speed):
    """Two counts by turns, or hardly one twice: noise is a step over the square root of 12."""
    step = 2 * np.pi / 4096
    rng = np.random.default_rng(0)
    time = np.arange(1500) * 0.002
    angle = speed * time + 0.3 * (speed > 0) * np.sin(2 * time) + 0.49 * step
    angle = np.round((angle + 0.005 * step * rng.normal(size=1500)) / step) * step
    assert quantum(angle) == pytest.approx(step)
    (noise,) = white_noise(time, angle[:, None])
    assert step / 12**0.5 <= noise * (1 + 1e-9) and noise < step
    assert quantum(np.where(time < 1.0, 0.0, 0.1)) == 0.0  # it moved once
    assert quantum(rng.normal(size=1500)) == 0.0


@pytest.mark.parametrize("bits", [11, 14])
def test_a_steady_run_is_no_coarse_encoder(bits):
    time, step = 0.01 * np.arange(800), 2 * np.pi / 2**bits
    for angle in (5 * time, 5 * time + 0.008 * np.sin(6 * time)):
        assert quantum(np.round(angle / step) * step) <= 1.01 * step
        noisy = angle + 1e-4 * np.random.default_rng(0).normal(size=800)
        assert white_noise(time, noisy[:, None])[0] == pytest.approx(1e-4, rel=0.3)
    assert quantum(np.round(0.05 * time / step) * step) == pytest.approx(step)


@pytest.mark.parametrize("rounded", [np.float32, lambda angle: np.round(angle, 5)])
def test_an_encoder_is_told_in_rounded_numbers_at_a_constant_speed(rounded):
    time, step = 0.001 * np.arange(1600), 2 * np.pi / 2**12
    for speed in np.linspace(0.2, 3.0, 12):
        angle = speed * np.abs((time + 0.3) % 4 - 2)
        coarse = rounded(np.round(angle / step) * step).astype(float)
        assert quantum(coarse) == pytest.approx(step, rel=0.02)


def test_torque_per_command_is_gear_and_gain():
    np.testing.assert_allclose(torque_per_command(ARM), [[60.0, 0.0], [0.0, 2.0]], atol=1e-6)
