"""Segments are as long as a model can be followed, and longer with what was found."""

import dataclasses

import mujoco
import numpy as np
import pytest

from garat_jax.diagnosis.diagnose import diagnose, warn_of_rest
from garat_jax.diagnosis.held_out import longest_errors
from garat_jax.diagnosis.horizon import choose_horizon, cut_longer, cut_longest
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.metric import Errors
from garat_jax.diagnosis.model_card import Model
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.report import diagnosis_lead
from garat_jax.diagnosis.segments import choose_grid, cut
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.diagnosis.starts import settle
from garat_jax.diagnosis.unseen import HELD
from garat_jax.diagnosis.velocity import estimate_velocity
from garat_jax.dynamics import native_model
from garat_jax.effects import CATALOGUE, MotorGain
from garat_jax.errors import UserError
from tests.diagnosis.pendulum import MODEL, record

GAIN, PULL = 0.5, 0.008  # N m


def weaken(spec: mujoco.MjSpec) -> None:
    (motor,) = spec.actuators
    motor.gear = np.asarray(motor.gear) * GAIN


def record_weak(pull: float) -> list[Recording]:
    return [record(weaken, seed, pull=pull) for seed in range(4)]


def test_what_was_found_lets_a_model_be_followed_for_longer():
    recordings = record_weak(0.0)
    grid = choose_grid(recordings, 0.002)
    simulator = Simulator(MODEL, (MotorGain("actuator/motor"),), grid)
    horizon, segments = choose_horizon(simulator, recordings, grid)
    problem = Problem(simulator, segments, segments.recording < 3, 0.004)
    assert problem.horizon == pytest.approx(horizon)
    assert cut_longer(problem, recordings, grid, simulator.base) is None
    found = cut_longer(problem, recordings, grid, np.asarray([GAIN]))
    assert found
    longer, settled = found
    assert longer.horizon > horizon
    assert np.array_equal(longer.fitted, longer.segments.recording < 3)
    without = settle(longer, simulator.base, settled.start)
    assert settled.cost.sum() < 0.1 * without.cost.sum()
    assert cut_longer(longer, recordings, grid, np.asarray([GAIN])) is None


def test_a_gap_that_shows_in_long_segments_alone_is_measured_there():
    recordings = record_weak(0.0)
    grid = choose_grid(recordings, 0.002)
    simulator = Simulator(MODEL, (MotorGain("actuator/motor"),), grid)
    horizon, segments = choose_horizon(simulator, recordings, grid)
    problem = Problem(simulator, segments, segments.recording < 3, 0.004)

    def errors(gain: float) -> Errors | None:
        theta = np.asarray([gain])
        return longest_errors(problem, theta, recordings, grid, "held out")

    right, wrong = errors(GAIN), errors(1.2 * GAIN)
    assert right and wrong
    assert right.horizon == pytest.approx(wrong.horizon)
    assert right.horizon > horizon
    assert right.is_explained and right.is_near_floor
    assert not wrong.is_explained
    assert wrong.before == pytest.approx(right.before, rel=1e-3)
    longest = cut_longest(problem, recordings, grid, simulator.base)
    assert longest and cut_longest(longest, recordings, grid, simulator.base) is None


def test_segments_are_no_longer_than_the_recordings_or_than_leaves_three_to_fit():
    spans = ((0, 300),)
    recordings = [dataclasses.replace(r, spans=spans) for r in record_weak(0.0)]
    grid = choose_grid(recordings, 0.002)
    simulator = Simulator(MODEL, (MotorGain("actuator/motor"),), grid)
    _, segments = choose_horizon(simulator, recordings, grid)
    problem = Problem(simulator, segments, segments.recording < 3, 0.004)
    found = cut_longer(problem, recordings, grid, np.asarray([GAIN]))
    assert found
    assert found[0].horizon == pytest.approx(1.0)
    two = dataclasses.replace(problem, fitted=segments.recording < 2)  # whole segments of 1 s: two
    found = cut_longer(two, recordings, grid, np.asarray([GAIN]))
    assert found
    assert found[0].horizon == pytest.approx(0.5)


def test_a_good_model_is_not_followed_for_so_long_that_less_than_three_segments_are_left():
    whole = record_weak(0.0)[:2]
    recordings = [dataclasses.replace(r, spans=((0, 550),)) for r in whole]
    grid = choose_grid(recordings, 0.002)
    gain = MotorGain("actuator/motor", scale=GAIN)
    true = Simulator(dataclasses.replace(MODEL, effects=(gain,)), (), grid)
    assert choose_horizon(true, whole, grid)[0] == 2.0
    chosen = [choose_horizon(true, recordings, grid, num) for num in (None, 1)]
    assert [horizon for horizon, _ in chosen] == [1.0, 0.5]
    assert chosen[0][1].is_whole.tolist() == [True, True, False] * 2


def test_recordings_shorter_than_any_horizon_are_followed_whole():
    recordings = [dataclasses.replace(r, spans=((0, 30),)) for r in record_weak(0.0)]
    grid = choose_grid(recordings, 0.002)
    simulator = Simulator(MODEL, (MotorGain("actuator/motor"),), grid)
    horizon, segments = choose_horizon(simulator, recordings, grid)
    assert horizon == 0.2
    assert segments.measured.shape[:2] == (4, 30)
    predicted = simulator.predict(simulator.base[None], segments.start[None], segments)
    assert predicted.shape[1:] == segments.measured.shape


def test_a_diagnosis_of_a_moment_says_that_it_is_too_short():
    model = dataclasses.replace(MODEL, catalogue={"motor_gain": CATALOGUE["motor_gain"]})
    recordings = record_weak(0.0)[:2]
    (warning,) = diagnose(
        model, [dataclasses.replace(recording, spans=((0, 50),)) for recording in recordings]
    ).warnings
    assert warning.startswith("only 1 piece of 0.2 s could be fitted, too few")
    assert not diagnose(model, recordings).warnings


def test_samples_too_far_apart_to_follow_are_refused():
    recordings = [dataclasses.replace(r, time=1e3 * r.time) for r in record_weak(0.0)]
    with pytest.raises(UserError, match=r"4 s apart, too far to follow .* another unit than sec"):
        choose_grid(recordings, 0.002)


def test_a_timestep_much_longer_than_a_sample_is_told():
    recordings = record_weak(0.0)
    slow = MODEL.spec.copy()
    slow.option.timestep = 0.02
    catalogue = {"motor_gain": CATALOGUE["motor_gain"]}
    model = dataclasses.replace(MODEL, spec=slow, catalogue=catalogue)
    found = diagnose(model, recordings)
    assert found.warnings[0].startswith(
        "the model's timestep of 0.02 s is longer than a sample; it is simulated at 0.004 s"
    )


def test_what_is_odd_about_recordings_is_a_warning_of_their_diagnosis():
    model = dataclasses.replace(MODEL, catalogue={"motor_gain": CATALOGUE["motor_gain"]})
    recordings = record_weak(0.0)
    recordings[1] = dataclasses.replace(recordings[1], warnings=("one.csv: is it in degrees?",))
    found = diagnose(model, recordings)
    assert found.warnings == ("one.csv: is it in degrees?",)
    assert diagnosis_lead(found).endswith(" Warning: one.csv: is it in degrees?")


def test_a_small_effect_is_found_that_a_large_one_hid():
    kinds = ("motor_gain", "torque_offset", "viscous_damping", "coulomb_friction")
    model = dataclasses.replace(MODEL, catalogue={kind: CATALOGUE[kind] for kind in kinds})
    found = diagnose(model, record_weak(PULL))
    gain, offset = found.selected
    assert (gain.effect, offset.effect) == ("motor_gain", "torque_offset")
    assert gain.parameters["scale"].estimate == pytest.approx(GAIN, rel=0.01)
    assert offset.parameters["torque"].estimate == pytest.approx(PULL, rel=0.05)
    assert f"+ torque_offset at joint/hinge ({offset.sizes}): fit " in str(found)


def test_what_recordings_held_out_show_in_longer_segments_alone_is_found():
    """They have no velocities: within 0.2 s they agree with a model that errs in the others."""

    def weaken_much(spec: mujoco.MjSpec) -> None:
        (motor,) = spec.actuators
        motor.gear = np.asarray(motor.gear) * 0.3

    model = dataclasses.replace(MODEL, catalogue={"motor_gain": CATALOGUE["motor_gain"]})
    *recordings, last = (record(weaken_much, seed, noise=0.02) for seed in range(4))
    speed = estimate_velocity(native_model(model.compile()), last.time, last.qpos)
    last = dataclasses.replace(last, qvel=speed, velocity_measured=False)
    grid = choose_grid(recordings, 0.002)
    assert choose_horizon(Simulator(model, (), grid), recordings, grid)[0] == 0.2
    found = diagnose(model, recordings, [last])
    assert found.verdict == "missing_effect"
    assert found.error.horizon > 0.25
    (gain,) = found.selected
    assert gain.parameters["scale"].estimate == pytest.approx(0.3, rel=0.03)


def test_a_gap_that_recordings_held_out_never_show_is_a_warning():
    model = dataclasses.replace(MODEL, catalogue={"motor_gain": CATALOGUE["motor_gain"]})
    recordings = [record(weaken, seed) for seed in range(3)]
    free = record(weaken, 3, control=lambda time, angle, speed: 0.0)
    found = diagnose(model, recordings, [free])
    assert found.verdict == "adequate"
    assert "it does not predict qpos.hinge and qvel.hinge of the others" in " ".join(found.warnings)


def test_it_is_said_where_nothing_moves():
    moves = record(weaken, 0)
    stuck = dataclasses.replace(moves, qpos=0 * moves.qpos, qvel=0 * moves.qvel, name="rest")
    still = dataclasses.replace(stuck, ctrl=0 * moves.ctrl)
    noise = np.random.default_rng(0).normal(size=(len(still.time), 2)) * [1e-3, 1e-2]
    noisy = dataclasses.replace(still, qpos=noise[:, :1], qvel=noise[:, 1:], name="quiet")
    (said,) = warn_of_rest([still, noisy], [moves])
    assert said.startswith("nothing moves in what is to be fitted (rest, quiet): no command")
    assert "so that little can be proved there" in warn_of_rest([moves], [noisy])[0]
    assert not warn_of_rest([noisy], [noisy])
    assert not warn_of_rest([stuck], [moves])  # what commands do not move tells of friction
    assert not warn_of_rest([dataclasses.replace(still, spans=((0, 9),)), moves], [moves])
    begins = dataclasses.replace(moves, spans=((0, 20),), qpos=moves.qpos + 0, ctrl=still.ctrl)
    begins.qpos[:20], begins.qvel[:20] = 0.0, 0.0
    assert warn_of_rest([begins], [moves])  # beyond its span it moves
    fast = dataclasses.replace(still, qvel=moves.qvel, velocity_measured=False)
    assert warn_of_rest([fast], [moves])
    model = dataclasses.replace(MODEL, catalogue={"motor_gain": CATALOGUE["motor_gain"]})
    assert warn_of_rest([moves], [noisy])[0] in diagnose(model, [moves], [noisy]).warnings
    jammed = dataclasses.replace(noisy, qpos=noisy.qpos + 0.8)  # where the model would fall
    found = diagnose(model, [jammed], [jammed])
    assert HELD in found.warnings
    assert "quiet is held out and has the same samples as quiet, which is" in found.warnings[0]
    assert HELD not in diagnose(model, [noisy], [noisy]).warnings


SERVO = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body>
      <joint name="hinge" axis="0 0 1" armature="0.05"/>
      <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.1"/>
    </body>
  </worldbody>
  <actuator><position name="servo" joint="hinge" kp="50" kv="3"/></actuator>
</mujoco>
"""


def test_a_stiff_servo_does_not_shorten_segments():
    """A push of its angle is answered by a fast motion, beside slow ones, that soon dies out."""
    spec = mujoco.MjSpec.from_string(SERVO)
    model = spec.compile()
    data, states, time = mujoco.MjData(model), [], np.arange(2000) * 0.004
    ctrl = np.sin(time)
    for command in ctrl:
        states.append([*data.qpos, *data.qvel])
        data.ctrl[0] = command
        mujoco.mj_step(model, data, 2)
    noise = np.random.default_rng(0).normal(size=(2000, 2)) * [1e-4, 1e-3]
    qpos, qvel = np.split(np.asarray(states) + noise, 2, axis=1)
    spans = ((0, len(time)),)
    recording = Recording("slow", time, qpos, qvel, ctrl[:, None], {}, True, spans, ())
    grid = choose_grid([recording], 0.002)
    simulator = Simulator(Model("servo", __file__, __file__, spec), (), grid)
    assert choose_horizon(simulator, [recording], grid)[0] == 2.0


SLIDER = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <geom type="plane" size="5 5 0.1" friction="0.15 0.005 0.0001"/>
    <body pos="0 0 0.02">
      <joint name="along" type="slide" axis="1 0 0" damping="0.3"/>
      <joint name="height" type="slide" axis="0 0 1"/>
      <geom type="box" size="0.06 0.06 0.02" mass="0.5" friction="0.15 0.005 0.0001"/>
    </body>
  </worldbody>
  <actuator><motor joint="along" ctrlrange="-4 4"/></actuator>
</mujoco>
"""


def test_a_height_that_hardly_moves_does_not_shorten_segments():
    spec = mujoco.MjSpec.from_string(SLIDER)
    rng, time = np.random.default_rng(0), np.arange(1000) * 0.004
    model = spec.compile()
    data, states = mujoco.MjData(model), []
    ctrl = 2.0 * np.sin(4.0 * time) + 0.5 * np.sin(11.0 * time)
    for command in ctrl:
        states.append([*data.qpos, *data.qvel])
        data.ctrl[0] = command
        mujoco.mj_step(model, data, 2)
    noisy = np.asarray(states) + rng.normal(size=(1000, 4)) * [3e-4, 3e-4, 6e-3, 6e-3]
    spans = ((0, len(time)),)
    recording = Recording(
        "slid", time, noisy[:, :2], noisy[:, 2:], ctrl[:, None], {}, True, spans, ()
    )
    grid = choose_grid([recording], 0.002)
    simulator = Simulator(Model("slider", __file__, __file__, spec), (), grid)
    horizon, segments = choose_horizon(simulator, [recording], grid)
    assert horizon >= 1.0
    assert segments.measured.shape[1] == round(horizon / 0.004)
    hopping = 0.05 * np.abs(np.sin(3.0 * time))
    heights = np.stack([hopping, np.gradient(hopping, time)], axis=1)
    lifted = dataclasses.replace(
        recording,
        qpos=noisy[:, :2] + [0, 1] * heights[:, :1],
        qvel=noisy[:, 2:] + [0, 1] * heights[:, 1:],
    )
    assert choose_horizon(simulator, [lifted], grid)[0] == 0.2


def test_segments_last_as_long_as_those_of_a_slow_recording_beside_a_short_fast_one():
    slow = [every(record_weak(0.0)[seed], 5) for seed in range(3)]
    fast = dataclasses.replace(record_weak(0.0)[3], spans=((0, 100),))  # 0.4 s
    recordings = [*slow, fast]
    grid = choose_grid(recordings, 0.002)
    simulator = Simulator(MODEL, (MotorGain("actuator/motor"),), grid)
    segments = cut(recordings, grid, 0.5)
    problem = Problem(simulator, segments, segments.recording > 0, grid.sample)
    assert problem.horizon == pytest.approx(0.5)
    longest = cut_longest(problem, recordings, grid, np.asarray([GAIN]))
    assert longest and longest.horizon == pytest.approx(2.0)


def every(recording: Recording, step: int) -> Recording:
    parts = {name: getattr(recording, name)[::step] for name in ("time", "qpos", "qvel", "ctrl")}
    return dataclasses.replace(recording, **parts, spans=((0, len(parts["time"])),))
