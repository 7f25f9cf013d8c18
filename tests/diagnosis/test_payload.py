"""A payload is found with its mass and place, light or so heavy that no screening is linear."""

import dataclasses
import functools

import pytest

from garat_jax.diagnosis.diagnose import diagnose
from garat_jax.effects import CATALOGUE
from tests.diagnosis.pendulum import MODEL, add_payload, record

RIVALS = ("payload_mass", "com_offset", "gravity_scale", "rotor_inertia", "motor_gain")


@pytest.mark.parametrize(
    ("mass", "x", "z"), [(0.02, 0.0, -0.4), (0.3, 0.05, -0.2), (1.0, 0.0, -0.3)]
)
def test_a_payload_is_found_at_its_place(mass, x, z):
    model = dataclasses.replace(MODEL, catalogue={kind: CATALOGUE[kind] for kind in RIVALS})
    loaded = functools.partial(add_payload, mass=mass, x=x, z=z)
    found = diagnose(model, [record(loaded, seed) for seed in range(4)])
    (payload,) = found.selected
    assert (payload.effect, payload.target) == ("payload_mass", "body/pole")
    sizes = {name: e.estimate for name, e in payload.parameters.items()}
    assert sizes["mass"] == pytest.approx(mass, rel=0.05)
    assert sizes["z"] == pytest.approx(z, abs=0.01)
    assert sizes.get("x", 0.0) == pytest.approx(x, abs=0.01)
    assert found.verdict == "missing_effect"
    assert found.error.after < 1.1 * found.error.noise_floor
