"""Units that cannot be are warned of in words that name the mend; good recordings are not."""

import dataclasses
import itertools

import numpy as np
import pytest

from garat_jax.diagnosis.hidden import make_recordings
from garat_jax.diagnosis.localise import missing_torque
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.oddities import commands_turned, oddities
from garat_jax.diagnosis.velocity import estimate_velocity
from tests import models
from tests.diagnosis import pendulum
from tests.diagnosis.test_measurements import tumbling

MODEL = models.spec(models.PENDULUM).compile()
SLIDER = models.spec(models.SLIDER).compile()
TUMBLER = models.spec(models.TUMBLER).compile()
DEGREE = np.pi / 180


@pytest.fixture(scope="module")
def good() -> Recording:
    """A pendulum that swings by 48 degrees, of which the model lacks most of the damping."""
    return pendulum.record(lambda spec: pendulum.add_damping(spec, 0.1), 1)


def without_velocity(recording: Recording) -> Recording:
    estimate = estimate_velocity(MODEL, recording.time, recording.qpos)
    return dataclasses.replace(recording, qvel=estimate, velocity_measured=False)


def written(recording: Recording, time=1.0, position=1.0, speed=1.0) -> Recording:
    """The same motion in other units."""
    return dataclasses.replace(
        recording,
        time=recording.time * time,
        qpos=recording.qpos * position,
        qvel=recording.qvel * speed,
    )


@pytest.mark.parametrize(
    ("time", "position", "speed", "said"),
    [
        (1 / 60, 1, 1, ["the samples are 6.667e-05 s apart; is time in min?"]),
        (1e3, 1, 1, ["the samples are 4 s apart; is time in ms?"]),
        (1e6, 1, 1, ["the samples are 4000 s apart; is time in us?"]),
        (1, 1, 1 / DEGREE, ["times the derivative of qpos.hinge; is qvel.hinge in deg/s?"]),
        (1, 1, 30 / np.pi, ["times the derivative of qpos.hinge; is qvel.hinge in rpm?"]),
        (1, 1 / DEGREE, 1, ["times the derivative of qpos.hinge; is qpos.hinge in deg?"]),
        (1, 1, 20, ["one of them, or time, is in another unit"]),
        (1, 1, -1, ["one of them counts the other way"]),
        (1, 1 / DEGREE, 1 / DEGREE, ["better in degrees than in radians; is it in degrees?"]),
        (1e3, 1, 1 / DEGREE, ["is time in ms?", "is qvel.hinge in deg/s?"]),
    ],
)
def test_other_units_are_suspected(good, time, position, speed, said):
    lines = oddities(written(good, time, position, speed), MODEL)
    assert len(lines) == len(said)
    for line, words in zip(lines, said, strict=True):
        assert words in line
        assert line.startswith(f"{good.name}: ")
        assert "\n" not in line


def test_the_number_and_the_mend_are_named(good):
    (line,) = oddities(written(good, speed=1 / DEGREE), MODEL)
    factor = float(line.partition("qvel.hinge is ")[2].split()[0])
    assert factor == pytest.approx(57.3, rel=0.02)
    assert line.endswith('give it in rad/s, or unit = "deg/s" in a map file (--map)')


def test_without_velocities_time_and_degrees_are_suspected_too(good):
    (line,) = oddities(without_velocity(written(good, time=1e3)), MODEL)
    assert "is time in ms?" in line
    (line,) = oddities(without_velocity(written(good, position=1 / DEGREE)), MODEL)
    assert "qpos.hinge (up to 47.87 rad): the model makes this motion" in line


def test_fast_samples_in_milliseconds_show_in_the_velocities(good):
    finer = dataclasses.replace(good, time=good.time * 0.05)  # 0.2 ms apart
    recording = written(finer, time=1e3, speed=20)
    (line,) = oddities(recording, MODEL)
    assert "is time in ms?" in line


def slide(speed: float, rate: float = 250.0) -> Recording:
    time = np.arange(500) / rate
    place = np.stack([np.zeros(500), 0.1 * np.sin(8 * time)], axis=1)
    pace = np.stack([np.zeros(500), 0.8 * np.cos(8 * time)], axis=1)
    nothing = np.zeros((500, 1))
    return Recording("run.csv", time, place, speed * pace, nothing, {}, True, ((0, 500),), ())


def test_a_slide_may_be_in_millimetres():
    assert oddities(slide(1.0), SLIDER) == []
    (line,) = oddities(slide(1e3), SLIDER)
    assert "times the derivative of qpos.along; is qvel.along in mm/s?" in line
    (line,) = oddities(written(slide(1.0), position=1e3), SLIDER)
    assert "is qpos.along in mm?" in line


def test_rotations_of_free_and_ball_joints_are_compared():
    time, qpos, qvel = tumbling()
    nothing = np.zeros((len(time), 0))
    recording = Recording("run.csv", time, qpos, qvel, nothing, {}, True, ((0, len(time)),), ())
    assert oddities(recording, TUMBLER) == []
    qvel = qvel.copy()
    qvel[:, [0, 8]] /= DEGREE
    lines = oddities(dataclasses.replace(recording, qvel=qvel), TUMBLER)
    assert ["qvel.free.0" in lines[0], "the derivative of qpos.free.0;" in lines[0]] == [True, True]
    assert "the derivative of the rotation in qpos.ball; is qvel.ball.2 in deg/s?" in lines[1]


def changed(recording: Recording, **columns: np.ndarray) -> Recording:
    return dataclasses.replace(recording, **columns)


def test_a_position_that_jumps_for_a_sample_is_told_from_motion(good):
    qpos = good.qpos.copy()
    qpos[[100, 300]] += [[0.5], [-1.0]]
    (line,) = oddities(changed(good, qpos=qpos), MODEL)
    assert (
        "qpos.hinge is -1 rad off its neighbours for a sample, 0.4, 1.2 s after the start: leave"
        in line
    )
    coarse = changed(good, qpos=0.01 * np.round(good.qpos / 0.01))
    kinked = changed(good, qpos=np.abs(good.qpos), qvel=np.sign(good.qpos) * good.qvel)
    assert oddities(coarse, MODEL) == oddities(kinked, MODEL) == []
    held = np.zeros_like(good.qpos)
    held[[100, 300, 500]] = 1e-3  # an encoder flickers by a tick
    flickers = changed(good, qpos=held, qvel=0 * held)
    creeps = changed(good, qpos=np.where(good.time[:, None] > 1.5, 1e-3, 0.0), qvel=0 * held)
    assert oddities(flickers, MODEL) == oddities(creeps, MODEL) == []


def test_a_velocity_that_is_none_is_told_from_one_that_is_noisy(good):
    nothing, swapped = np.zeros_like(good.qvel), changed(good, qpos=good.qvel, qvel=good.qpos)
    (line,) = oddities(changed(good, qvel=nothing), MODEL)
    assert "qvel.hinge is 0 throughout, which is not the derivative of qpos.hinge: leave" in line
    (line,) = oddities(swapped, MODEL)
    assert "qvel.hinge is not the derivative of qpos.hinge" in line
    noise = np.random.default_rng(0).normal(size=good.qvel.shape)
    noisy = changed(good, qvel=good.qvel + 2.0 * good.qvel.std() * noise)
    rests = changed(good, qpos=1e-3 * noise, qvel=np.zeros_like(good.qvel))
    other_unit = changed(good, qvel=(good.qvel + 2.0 * good.qvel.std() * noise) / DEGREE)
    drowned = changed(good, qpos=0.01 * good.qpos, qvel=0.01 * good.qvel + noise)
    for odd in (noisy, rests, other_unit, drowned):
        assert oddities(odd, MODEL) == []


def test_commands_that_count_the_other_way_are_told_from_a_weak_motor(good):
    def lines(of: Recording) -> list[str]:
        return commands_turned(missing_torque(MODEL, [of]))

    (line,) = lines(changed(good, ctrl=-good.ctrl))
    assert line.startswith("the torque that the model lacks at hinge is -")
    assert lines(good) == lines(changed(good, ctrl=2.0 * good.ctrl)) == []
    assert lines(changed(good, ctrl=0.0 * good.ctrl)) == []
    swing = 0.3 * np.sin(2.0 * good.time)
    slow = changed(good, qpos=swing[:, None], qvel=(0.6 * np.cos(2.0 * good.time))[:, None])
    load = missing_torque(MODEL, [changed(slow, ctrl=0.0 * good.ctrl)])
    pushed = np.interp(good.time, load.time, load.torque[:, 0] - 2.0 * load.torque[:, 0])
    assert lines(changed(slow, ctrl=pushed[:, None])) == []  # a spring of twice the stiffness


def test_good_recordings_pass_without_a_word(good, tmp_path):
    assert oddities(good, MODEL) == oddities(without_velocity(good), MODEL) == []
    (tmp_path / "pendulum.xml").write_text(models.PENDULUM)
    for kind in ("none", "coulomb_friction", "actuator_delay"):
        made = make_recordings(
            tmp_path / "pendulum.xml", tmp_path / kind, 1, kind=kind, seconds=4.0
        )
        for path in (*made.fit, *made.holdout):
            assert Recording.read(path, MODEL).warnings == ()


def test_a_motor_that_spins_is_no_angle_in_degrees(good):
    """Several turns in radians, of which the model lacks a lot, stay without a word."""
    spinning = pendulum.record(lambda spec: pendulum.add_damping(spec, 0.1), 1, pull=4.5)
    assert np.abs(spinning.qpos).max() > 2 * np.pi
    near = itertools.takewhile(lambda k: abs(spinning.qpos[k, 0]) < 49, range(len(spinning.time)))
    stop = max(near) + 1
    cut = {name: getattr(spinning, name)[:stop] for name in ("time", "qpos", "qvel", "ctrl")}
    assert oddities(dataclasses.replace(spinning, **cut, spans=((0, stop),)), MODEL) == []
