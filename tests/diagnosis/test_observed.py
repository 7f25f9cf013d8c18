"""Velocities that were measured in some recordings count there, and estimated ones nowhere."""

import dataclasses

import numpy as np
import pytest

from garat_jax.diagnosis.compare import compare
from garat_jax.diagnosis.metric import make_metric
from garat_jax.diagnosis.noise import signal_noise
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.replay import as_recordings, replay
from garat_jax.diagnosis.report import traces
from garat_jax.diagnosis.segments import choose_grid, cut
from garat_jax.diagnosis.velocity import estimate_velocity
from garat_jax.diagnosis.view import look
from tests.diagnosis.pendulum import MODEL, add_damping, record

HOST = MODEL.compile(engine="mujoco").host.model


@pytest.fixture(scope="module")
def measured():
    return [record(lambda spec: add_damping(spec), seed) for seed in (1, 2)]


def without_velocity(recording):
    estimate = estimate_velocity(HOST, recording.time, recording.qpos)
    return dataclasses.replace(recording, qvel=estimate, velocity_measured=False)


@pytest.fixture(scope="module")
def mixed(measured):
    return [measured[0], without_velocity(measured[1])]


def problem(recordings):
    grid = choose_grid(recordings, HOST.opt.timestep)
    segments = cut(recordings, grid, 0.5)
    return Problem(None, segments, segments.recording == 0, grid.interval)  # pyright: ignore


def test_measured_velocities_count_beside_a_recording_without(measured, mixed):
    segments = problem(mixed).segments
    assert segments.measured.shape[2] == 2
    np.testing.assert_array_equal(segments.observed[:, 0], True)
    np.testing.assert_array_equal(segments.observed[:, 1], segments.recording == 0)
    assert segments.noise[1] == pytest.approx(signal_noise(measured[0])[1])
    alone = problem([without_velocity(r) for r in measured]).segments
    assert alone.measured.shape[2] == 1


def test_estimated_velocities_count_nowhere(mixed):
    made = problem(mixed)
    off = made.segments.measured + np.asarray([0.0, 1.0])
    residual = made.whiten(off).reshape(off.shape)
    of_second = made.segments.recording == 1
    assert np.all(residual[of_second] == 0.0)
    assert np.all(residual[~of_second][..., 1][made.segments.weight[~of_second] > 0] > 0.0)
    metric = make_metric(made)
    assert metric.count(of_second) == made.segments.weight[of_second].sum()
    assert metric.count(~of_second) == 2 * made.segments.weight[~of_second].sum()


def test_a_comparison_tells_the_error_of_velocities_where_they_were_measured(measured, mixed):
    (both,), (one,) = (replay(MODEL, data, {0.5: [0, 1]}) for data in (mixed, measured[:1] * 2))
    sizes = both.sizes()
    assert list(sizes) == ["qpos.hinge", "qvel.hinge"]
    assert sizes["qvel.hinge"].rmse == pytest.approx(one.sizes()["qvel.hinge"].rmse, rel=0.03)
    assert list(both.only([1]).sizes()) == ["qpos.hinge"]
    played = as_recordings(both, mixed, HOST)[1]
    a, b = played.spans[0]
    from_positions = estimate_velocity(HOST, played.time[a:b], played.qpos[a:b])
    np.testing.assert_array_equal(played.qvel[a:b], from_positions)


def test_a_report_of_mixed_recordings_is_finite(mixed):
    said = compare(MODEL, mixed)
    assert all(np.isfinite(row["before"]) for row in said.error.per_signal.values())
    assert set(said.error.per_signal) == {"qpos.hinge", "qvel.hinge"}


def test_a_replay_of_recordings_without_velocity_shows_none(mixed):
    for chosen, names in (([0], ("qpos.hinge", "qvel.hinge")), ([1], ("qpos.hinge",))):
        (shown,) = replay(MODEL, mixed, {0.5: chosen})
        assert shown.names == names
        assert np.isfinite(shown.error())


def test_estimated_velocities_are_not_drawn_as_measured(measured):
    worse = without_velocity(record(lambda spec: add_damping(spec, 0.2), 3))
    drawn = traces(look(MODEL, [measured[0], worse], [0, 1]))
    assert worse.name in drawn.text
    assert [figure.title for figure in drawn.figures] == ["qpos.hinge"]
    assert len(traces(look(MODEL, [*measured, worse], [0, 1])).figures) == 2
