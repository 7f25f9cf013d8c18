"""How recordings are cut: at rates of their own, with the commands that led to each segment."""

import dataclasses

import numpy as np
import pytest

from garat_jax.diagnosis.diagnose import diagnose, split
from garat_jax.diagnosis.findings import Named
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.problem import Problem, block_labels
from garat_jax.diagnosis.segments import WARM_UP, choose_grid, cut
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.errors import UserError
from tests.diagnosis.pendulum import MODEL, add_damping, record

TIMESTEP = 0.002


def sampled(time, name="made", spans=None) -> Recording:
    time = np.asarray(time)
    angle, ctrl = 0.4 * np.sin(3 * time), np.arange(len(time), dtype=float)
    spans = spans or ((0, len(time)),)
    state = angle[:, None], 1.2 * np.cos(3 * time)[:, None]
    return Recording(name, time, *state, ctrl[:, None], {}, True, spans, ())


def seconds_of(segments, grid) -> np.ndarray:
    return grid.interval * (segments.place * segments.weight).max(axis=1)


@pytest.mark.parametrize("horizon", [0.2, 1.0])
def test_recordings_of_several_rates_are_cut_into_segments_that_last_alike(horizon):
    made = [sampled(np.arange(8000) / 1000), sampled(np.arange(800) / 100)]
    for recordings in (made, made[::-1]):
        grid = choose_grid(recordings, TIMESTEP)
        segments = cut(recordings, grid, horizon)
        samples = horizon / np.asarray([r.time[1] for r in recordings])[segments.recording]
        np.testing.assert_array_equal(segments.weight.sum(axis=1), samples)
        assert np.all(np.abs(seconds_of(segments, grid) - horizon) < 0.011)
        assert np.all(segments.is_whole)
        assert np.bincount(segments.recording).tolist() == [round(8 / horizon)] * 2


@pytest.mark.parametrize(("other", "alike"), [(0.004 * (1 + 2e-5), True), (0.00397, False)])
def test_rates_that_differ_a_little_are_not_taken_for_one(other, alike):
    made = [sampled(np.arange(2000) * 0.004), sampled(np.arange(2000) * other)]
    grid = choose_grid(made, TIMESTEP)
    assert grid.uniform == alike
    segments = cut(made, grid, 2.0)
    at = segments.place * grid.interval
    last = [at[segments.recording == r][0].max() for r in (0, 1)]
    assert last == pytest.approx([0.004 * 499, other * (499 if alike else 503)], abs=2e-4)


def test_a_rest_of_a_recording_is_not_whole():
    segments = cut([sampled(np.arange(580) / 250)], choose_grid([sampled([0, 0.004])], 0.002), 0.5)
    assert segments.weight.sum(axis=1).tolist() == [125.0] * 4 + [80.0]
    assert np.all(segments.is_whole)
    segments = cut([sampled(np.arange(560) / 250)], choose_grid([sampled([0, 0.004])], 0.002), 0.5)
    assert segments.is_whole.tolist() == [True] * 4 + [False]


def test_segments_that_follow_each_other_are_a_stretch():
    made = [sampled(np.arange(100) / 100), sampled(np.arange(60) / 100)]
    segments = cut(made, choose_grid(made, 0.005), 0.2)
    assert segments.stretch.tolist() == [0] * 5 + [1] * 3
    assert segments.take(np.asarray([0, 1, 3, 4, 6])).stretch.tolist() == [0, 0, 1, 1, 2]


@pytest.mark.parametrize("jitter", [0.0, 1e-3])
def test_after_a_gap_the_last_command_before_it_was_held(jitter):
    time = np.arange(200) / 100 + jitter * np.random.default_rng(0).uniform(size=200)
    time[100:] += 60.0
    made = sampled(time, spans=((0, 100), (100, 200)))
    grid = choose_grid([made], 0.005)
    assert grid.uniform == (jitter == 0.0)
    segments = cut([made], grid, 0.2)
    warm_up = round(WARM_UP / grid.interval)
    before = segments.ctrl[segments.first == 100, :warm_up, 0]
    assert before.tolist() == [[99.0] * warm_up]
    begin = segments.ctrl[segments.first == 160, :warm_up, 0][0]
    assert begin[0] in (109.0, 110.0)
    assert begin[-1] == 159.0


def test_a_recording_in_another_unit_of_time_is_named():
    made = [sampled(np.arange(1000) / 100, "a.csv"), sampled(np.arange(300) * 10.0, "b.csv")]
    with pytest.raises(UserError, match=r"samples of b\.csv are 10 s apart, too far to follow"):
        choose_grid(made, TIMESTEP)


def test_a_secret_is_found_in_recordings_of_several_rates():
    made = [record(add_damping, seed) for seed in range(3)]
    rows = slice(None, None, 4)
    slow = dataclasses.replace(
        made[1],
        time=made[1].time[rows],
        qpos=made[1].qpos[rows],
        qvel=made[1].qvel[rows],
        ctrl=made[1].ctrl[rows],
        spans=((0, len(made[1].time[rows])),),
    )
    found = diagnose(MODEL, [made[0], slow], [made[2]])
    first = found.selected[0]
    damping = Named("viscous_damping", "joint/hinge")
    assert damping in (first.named, *first.indistinguishable_from)  # as is back EMF
    estimate = first.parameters["coefficient"]
    assert estimate.low < 0.02 < estimate.high


def test_blocks_of_time_last_alike_at_any_rate():
    made = [sampled(np.arange(4000) / 1000), sampled(np.arange(400) / 100)]
    grid = choose_grid(made, TIMESTEP)
    segments = cut(made, grid, 2.0)
    problem = Problem(Simulator(MODEL, (), grid), segments, segments.recording < 1, 0.001)
    blocks = problem.blocks()[:, ::2]
    for s, count in ((0, 2000), (2, 200)):
        assert np.bincount(blocks[s, :count]).tolist() == [count // 8] * 8
    assert np.all(blocks[2, 200:] == 0)


def test_segments_of_a_slow_recording_do_not_make_rests_of_the_others():
    made = [sampled(np.arange(4000) / 1000), sampled(np.arange(80) / 20)]
    segments = cut(made, choose_grid(made, TIMESTEP), 0.2)
    assert np.all(segments.is_whole)
    assert segments.weight.sum(axis=1)[-1] == 10.0


def test_padding_is_no_block_of_time():
    made = [sampled(np.arange(800) / 100), sampled(np.arange(25) / 100)]
    grid = choose_grid(made, TIMESTEP)
    segments = cut(made, grid, 2.0)
    problem = Problem(Simulator(MODEL, (), grid), segments, segments.recording == 0, grid.sample)
    assert len(np.unique(block_labels(problem)[~problem.fitted])) == 1


def test_the_motion_before_what_is_held_out_stays_known():
    whole = sampled(np.arange(900) / 100)
    grid = choose_grid([whole], TIMESTEP)
    (_,), (last,), _ = split([whole], ())
    segments, past = (cut([r], grid, 0.5).past_qvel for r in (last, whole))
    np.testing.assert_array_equal(segments, past)
    assert np.count_nonzero(past) > 890


def test_a_wheel_that_rolls_on_has_the_noise_of_its_encoder():
    rng, time = np.random.default_rng(0), np.arange(800) / 100

    def rolls(speed):
        speeds = speed + 2 * np.sin(3 * time)
        state = np.stack([np.cumsum(speeds) / 100, speeds], axis=1)
        state += rng.normal(size=(800, 2)) * [1e-3, 1e-2]
        return dataclasses.replace(sampled(time), qpos=state[:, :1], qvel=state[:, 1:])

    made = [rolls(speed) for speed in (100.0, -100.0, 100.0)]
    noise = cut(made, choose_grid(made, TIMESTEP), 0.2).noise
    assert noise[0] == pytest.approx(1e-3, rel=0.3)


def test_a_joint_that_stands_elsewhere_in_each_recording_has_some_noise():
    made, nothing = sampled(np.arange(800) / 100), np.zeros((800, 1))
    still = [dataclasses.replace(made, qpos=nothing + k, qvel=nothing) for k in range(2)]
    assert np.all(cut(still, choose_grid(still, TIMESTEP), 0.5).noise > 0)
