"""Sizes to try that the missing torque suggests."""

import numpy as np
import pytest

from garat_jax.diagnosis.diagnose import diagnose
from garat_jax.diagnosis.suggest import suggest
from garat_jax.effects import CoggingTorque, JointStiffness, ViscousDamping
from tests.diagnosis.pendulum import MODEL, add_damping, record

HOST = MODEL.spec.copy().compile()
COGGING = CoggingTorque("joint/hinge")


@pytest.mark.parametrize("periods", [3.0, 17.3, 42.0, 168.0])
def test_any_number_of_periods_stands_out_of_the_spectrum(periods):
    rng = np.random.default_rng(0)
    angle = np.concatenate([np.linspace(-2, 3, 3000), 3 - 4 * np.linspace(0, 1, 2000) ** 2])
    torque = 0.3 * np.sin(periods * angle - 1.2) + 0.3 * rng.normal(size=len(angle))
    start = CoggingTorque.suggested(angle, torque, torque[None]).starts[0]
    assert start["periods"] == pytest.approx(periods, abs=0.15)
    assert start["amplitude"] == pytest.approx(0.3, rel=0.15)
    wave = np.sin(start["periods"] * angle + start["phase"])
    assert np.corrcoef(wave, np.sin(periods * angle - 1.2))[0, 1] > 0.9


def test_a_second_ripple_stands_out_before_the_sidelobes_of_the_first():
    angle = 2.0 * np.sin(np.linspace(0, 20, 8000))
    torque = 0.1 * np.sin(6 * angle) + 0.02 * np.sin(42 * angle + 0.3)
    first, second, _ = CoggingTorque.suggested(angle, torque, torque[None]).starts
    assert (first["periods"], second["periods"]) == pytest.approx((6, 42), abs=0.05)
    assert (first["amplitude"], second["amplitude"]) == pytest.approx((0.1, 0.02), rel=0.05)


def test_what_is_left_of_slower_laws_does_not_hide_a_ripple():
    angle = np.linspace(-1, 1, 4000)
    torque = 0.2 * angle**3 + 0.02 * np.sin(17 * angle)
    starts = CoggingTorque.suggested(angle, torque, torque[None]).starts
    assert min(abs(start["periods"] - 17) for start in starts) < 0.3


@pytest.mark.parametrize("periods", [3.3, 4.7, 6.0])
def test_a_ripple_of_one_or_two_periods_in_the_range_is_suggested_beside_a_spring(periods):
    rng = np.random.default_rng(0)
    angle = np.sin(np.linspace(0, 40, 4000))
    torque = 0.1 * np.sin(periods * angle - 2.5) - 0.4 * angle + 0.1 * rng.normal(size=len(angle))
    slow = CoggingTorque.suggested(angle, torque, torque[None]).starts[-1]
    wave = slow["amplitude"] * np.sin(slow["periods"] * angle + slow["phase"])
    assert slow["periods"] == pytest.approx(periods, abs=0.6)
    assert np.corrcoef(wave, np.sin(periods * angle - 2.5))[0, 1] > 0.9


def test_a_few_samples_suggest_no_slow_ripple():
    angle = np.linspace(-1, 1, 15)
    starts = CoggingTorque.suggested(angle, angle, np.sin(5 * angle)[None]).starts
    assert all(start["periods"] > 6.0 for start in starts)


def test_a_slow_ripple_is_one_in_the_range_in_which_the_torque_is_known():
    rng = np.random.default_rng(0)
    angle = np.sin(np.linspace(0, 40, 4000))
    torque = 0.01 * rng.normal(size=len(angle))
    rest = np.where(np.abs(angle) < 0.1, torque, np.nan)
    starts = CoggingTorque.suggested(angle, torque, rest[None]).starts
    assert max(start["amplitude"] for start in starts) < 0.02


def test_no_ripple_is_suggested_beyond_what_the_law_allows():
    angle = np.sin(np.linspace(0, 40, 4000))
    torque = 1e3 * np.sin(20 * angle)
    starts = CoggingTorque.suggested(angle, torque, torque[None]).starts
    assert max(start["amplitude"] for start in starts) == CoggingTorque.parameters()[0].high


def test_a_controller_that_fights_the_ripple_does_not_hide_it():
    def control(time, angle, speed):
        return 50.0 * (0.8 + np.sin(1.5 * time) - angle) - 2.0 * speed

    def held(seed):
        def ripple(angle):
            return 0.1 * np.sin(17 * angle + 1)

        return record(lambda spec: None, seed, ripple=ripple, control=control)

    found = suggest([COGGING], HOST, [held(seed) for seed in (0, 1)])
    start = min(found[0].starts, key=lambda start: abs(start["periods"] - 17))
    assert start["periods"] == pytest.approx(17, abs=0.2)
    assert start["amplitude"] == pytest.approx(0.1, rel=0.2)


def test_a_joint_that_hardly_moves_suggests_nothing():
    still = 1.0 + 1e-3 * np.sin(np.arange(1000.0))
    assert CoggingTorque.suggested(still, still, np.sin(100 * still)[None]) is None
    assert CoggingTorque.suggested(np.full(10, 0.3), np.ones(10), np.ones((1, 10))) is None


def test_a_ripple_is_suggested_beside_friction_and_only_to_the_law_that_asks():
    def rippled(seed):
        return record(add_damping, seed, ripple=lambda angle: 0.03 * np.sin(11 * angle + 0.4))

    recordings = [rippled(seed) for seed in (0, 1)]
    found = suggest([ViscousDamping("joint/hinge"), COGGING], HOST, recordings)
    assert list(found) == [1]
    assert min(abs(start["periods"] - 11) for start in found[1].starts) < 0.3
    assert found[1].num_tried > 100


def test_a_ripple_with_an_uncommon_number_of_periods_is_found():
    def rippled(seed):
        return record(lambda spec: None, seed, ripple=lambda angle: 0.1 * np.sin(17 * angle + 1))

    found = diagnose(MODEL, [rippled(seed) for seed in (0, 1, 2)], [rippled(3)])
    (ripple,) = found.selected
    assert ripple.effect == "cogging_torque"
    assert ripple.parameters["periods"].estimate == pytest.approx(17, rel=0.01)
    assert ripple.parameters["amplitude"].estimate == pytest.approx(0.1, rel=0.05)


def test_a_spring_is_suggested_however_contacts_spoil_some_torques():
    rng = np.random.default_rng(1)
    angle = np.sin(np.linspace(0, 30, 3000)) - 0.8
    torque = -2.5 * (angle - 0.4) + 0.3 * rng.normal(size=3000)
    torque[::7] += 500.0 * rng.normal(size=len(torque[::7])) + 100.0
    (start,) = JointStiffness.suggested(angle, torque, torque[None]).starts
    assert (start["stiffness"], start["reference"]) == pytest.approx((2.5, 0.4), rel=0.1)


def test_dry_friction_suggests_no_spring_and_does_not_bend_one():
    def rubbed(stiffness: float, seed: int):
        def pull(angle: float) -> float:
            return -stiffness * (angle - 0.3)

        return record(
            lambda spec: None, seed, ripple=pull, torque=lambda speed: -0.1 * np.tanh(100 * speed)
        )

    spring = JointStiffness("joint/hinge")
    assert suggest([spring], HOST, [rubbed(0.0, seed) for seed in range(3)]) == {}
    (start,) = suggest([spring], HOST, [rubbed(0.4, seed) for seed in range(3)])[0].starts
    assert start["stiffness"] == pytest.approx(0.4, rel=0.1)
    assert start["reference"] == pytest.approx(0.3, abs=0.05)


def test_what_is_no_spring_suggests_none():
    angle = np.sin(np.linspace(0, 30, 3000))
    scatter = 0.3 * np.random.default_rng(2).normal(size=3000)
    assert JointStiffness.suggested(angle, 0.5 * angle, angle[None]) is None
    assert JointStiffness.suggested(angle, 5.0 + scatter, angle[None]) is None
    assert JointStiffness.suggested(1e-4 * angle, scatter, angle[None]) is None
    assert JointStiffness.suggested(np.full(9, 0.3), np.ones(9), np.ones((1, 9))) is None
