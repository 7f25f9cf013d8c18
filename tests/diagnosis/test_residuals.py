"""Whiteness and independence: white noise passes, what is coloured or driven does not."""

import dataclasses

import numpy as np
import pytest
from scipy import signal

from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.residuals import examine
from tests.diagnosis.test_compare import handmade

NUM, LENGTH = 20, 200


def examined(make, seed=0):
    """Examine residuals [T] that `make(command, rng)` makes."""
    rng = np.random.default_rng(seed)
    total = NUM * LENGTH
    command = signal.lfilter([1.0], [1.0, -0.9], rng.normal(size=total))
    residual = make(command, rng).reshape(NUM, LENGTH, 1)
    measured = np.zeros_like(residual)
    played = handmade(residual, measured, np.ones((NUM, LENGTH)))
    nothing = np.zeros((total, 1))
    recording = Recording(
        "made.csv", np.arange(total) * 0.01, nothing, nothing, command[:, None], {}, True,
        ((0, total),), (),
    )  # fmt: skip
    zeros = np.zeros(NUM, int)
    segments = dataclasses.replace(played.segments, recording=zeros, first=np.arange(NUM) * LENGTH)
    return examine(dataclasses.replace(played, segments=segments), [recording], ["motor"])


def test_white_noise_passes_nearly_always():
    found = [examined(lambda u, rng: rng.normal(size=len(u)), seed) for seed in range(40)]
    assert sum(f.whiteness[0].white for f in found) >= 39
    assert sum(f.independence[0].independent for f in found) >= 39
    assert found[0].sentence(small=True).endswith("it is noise.")
    assert "too large for noise" in found[0].sentence()


def test_coloured_noise_is_not_white_and_still_independent():
    coloured = [
        examined(lambda u, rng: signal.lfilter([1], [1, -0.8], rng.normal(size=len(u))), seed)
        for seed in range(20)
    ]
    assert not any(f.whiteness[0].white for f in coloured)
    assert sum(f.independence[0].independent for f in coloured) >= 18
    assert coloured[0].whiteness[0].correlation[0] == pytest.approx(0.8, abs=0.06)
    assert "not white: qpos.hinge" in coloured[0].sentence()


def test_what_follows_the_command_is_not_independent():
    (with_input,) = examined(
        lambda u, rng: rng.normal(size=len(u)) + 0.3 * np.roll(u, 7)
    ).independence
    assert not with_input.independent
    assert int(np.argmax(with_input.correlation)) == 7
    assert with_input.seconds[7] == pytest.approx(0.07)


def test_velocities_that_only_a_slower_recording_has_are_tested_there():
    """A signal that the fastest recording did not measure has its own rate."""
    rng = np.random.default_rng(0)
    residual = rng.normal(size=(NUM, LENGTH, 2))
    played = handmade(residual, np.zeros_like(residual), np.ones((NUM, LENGTH)))
    recording = np.arange(NUM) % 2
    observed = np.stack([np.ones(NUM, bool), recording == 1], axis=1)
    first = np.arange(NUM) // 2 * LENGTH
    segments = dataclasses.replace(
        played.segments, recording=recording, first=first, observed=observed,
        trust=np.ones_like(residual),
    )  # fmt: skip
    played = dataclasses.replace(
        played, segments=segments, names=("qpos.hinge", "qvel.hinge"), units=("rad", "rad/s")
    )
    total = NUM // 2 * LENGTH
    rest = (np.zeros((total, 1)), np.zeros((total, 1)), rng.normal(size=(total, 1)), {}, True)
    made = [
        Recording(name, np.arange(total) * step, *rest, ((0, total),), ())
        for name, step in (("fast", 0.01), ("slow", 0.04))
    ]
    position, velocity = examine(played, made, ["motor"]).whiteness
    assert (position.seconds[0], velocity.seconds[0]) == pytest.approx((0.01, 0.04))
    assert position.bound == pytest.approx(velocity.bound)
    assert position.white and velocity.white


def test_constant_commands_are_left_out():
    found = examined(lambda u, rng: rng.normal(size=len(u)))
    assert len(found.independence) == 1
    still = examined(lambda u, rng: (u.fill(0.0), rng.normal(size=len(u)))[1])
    assert still.independence == ()
