"""What the figures of a report draw: the worst moments, and the law through the missing torque."""

import dataclasses

import numpy as np
import pytest

from garat_jax.diagnosis import figures
from garat_jax.diagnosis.replay import replay
from tests.diagnosis.pendulum import MODEL, add_damping, record
from tests.diagnosis.test_localise import SPEED, TIME, lacking


def test_the_worst_moments_are_marked_where_they_are():
    good, bad = (record(change, 1) for change in (lambda spec: None, add_damping))
    recordings = [good, dataclasses.replace(bad, name="damped")]
    (played,) = replay(MODEL, recordings, {0.5: (0, 1)})
    errors = np.sum(played.deviation**2, axis=(1, 2))
    worst = int(np.argmax(errors))
    assert played.segments.recording[worst] == 1
    figure = figures.traces(recordings[1], 1, 0, played, None, [worst])
    first = played.segments.first[worst]
    for shape in figure.layout.shapes:
        ends = bad.time[first], bad.time[first] + 0.5
        assert (shape.x0, shape.x1) == pytest.approx(ends, abs=0.005)
    assert len(figure.layout.shapes) == 2  # beside the signal, and beside the deviation
    assert {line.name for line in figure.data} == {"measured", "model as it is"}
    assert not figures.traces(recordings[0], 0, 0, played, None, [worst]).layout.shapes


def test_the_law_that_was_found_is_drawn_through_the_missing_torque():
    noise = np.random.default_rng(0).normal(size=len(TIME))
    measured, law = lacking(-0.3 * SPEED + 0.05 * noise), lacking(-0.3 * SPEED)
    figure = figures.missing_torques(measured, law, 0, "rad")
    (means,) = (d for d in figure.data if d.name == "measured, mean" and d.xaxis == "x")
    (drawn,) = (d for d in figure.data if d.name == "law found, mean" and d.xaxis == "x")
    assert (means.mode, drawn.mode) == ("markers", "lines")
    assert figure.layout.xaxis.title.text == "velocity [rad/s]"
    np.testing.assert_allclose(drawn.y, -0.3 * np.asarray(drawn.x), atol=1e-6)
    np.testing.assert_allclose(means.y, drawn.y, atol=0.03)
    without = figures.missing_torques(measured, None, 0, "rad")
    assert not any("law" in line.name for line in without.data)
