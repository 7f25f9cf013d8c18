"""A law that refines another is named where it explains more, and not where it does not."""

import dataclasses

import numpy as np
import pytest

from garat_jax.diagnosis.diagnose import diagnose
from garat_jax.effects import CATALOGUE
from tests import models
from tests.diagnosis.pendulum import MODEL, record

KINDS = ("coulomb_friction", "viscous_damping", "stribeck_friction", "asymmetric_friction")
STATIC, COULOMB, SPEED = 0.15, 0.08, 0.4


def weakening(speed: float) -> float:
    """Return what friction loses in motion [N m]; the joint has its static size."""
    return (STATIC - COULOMB) * np.sign(speed) * (1.0 - np.exp(-((speed / SPEED) ** 2)))


def found_with(friction: float, torque):
    model = dataclasses.replace(MODEL, catalogue={kind: CATALOGUE[kind] for kind in KINDS})

    def rub(spec):
        spec.joint("hinge").frictionloss = friction

    return diagnose(model, [record(rub, seed, torque=torque) for seed in range(4)])


def test_a_peak_at_rest_is_stribeck_friction():
    (found,) = found_with(STATIC, weakening).selected
    assert found.effect == "stribeck_friction"
    assert found.parameters["coulomb"].estimate == pytest.approx(COULOMB, rel=0.1)


def test_constant_dry_friction_is_not_refined():
    (found,) = found_with(COULOMB, lambda speed: 0.0).selected
    assert found.effect == "coulomb_friction"
    assert found.parameters["torque"].estimate == pytest.approx(COULOMB, rel=0.05)


def test_a_parameter_that_explains_little_is_fitted_all_the_same():
    drag = 0.0015  # N m s/rad in the direction in which most of the friction is dry

    def law(speed: float) -> float:
        return -0.04 - (drag if speed > 0 else 20 * drag) * speed

    (found,) = found_with(0.08, law).selected
    assert found.effect == "asymmetric_friction"
    estimate = found.parameters["viscous_positive"]
    assert 0.0 < estimate.low <= drag <= estimate.high


def test_damping_with_a_little_dry_friction_is_not_called_asymmetric():
    model = dataclasses.replace(MODEL, catalogue={kind: CATALOGUE[kind] for kind in KINDS})

    def rub(spec):
        spec.joint("hinge").damping[0] += 0.02
        spec.joint("hinge").frictionloss = 0.01

    found = diagnose(model, [record(rub, seed) for seed in range(4)])
    assert found.selected[0].effect == "viscous_damping"
    assert "asymmetric_friction" not in [c.effect for c in found.selected]


def test_damping_is_refined_whatever_name_it_was_fitted_under():
    kinds = ("back_emf", "viscous_damping", "asymmetric_friction")
    spec = models.spec(models.PENDULUM.replace("Euler", "implicitfast"))
    catalogue = {kind: CATALOGUE[kind] for kind in kinds}
    model = dataclasses.replace(MODEL, spec=spec, catalogue=catalogue)

    def rub(speed: float) -> float:
        return -(0.004 if speed > 0 else 0.04) * speed

    found = diagnose(model, [record(lambda spec: None, seed, torque=rub) for seed in range(4)])
    assert [c.effect for c in found.selected] == ["asymmetric_friction"]
