"""A payload is found with its mass and place, light or so heavy that no screening is linear."""

import dataclasses
import functools

import numpy as np
import pytest

from garat_jax.diagnosis.contend import Contender, complete
from garat_jax.diagnosis.diagnose import diagnose
from garat_jax.diagnosis.fit import fit
from garat_jax.diagnosis.screen import Score
from garat_jax.effects import CATALOGUE, PayloadMass, ViscousDamping
from tests.diagnosis.pendulum import MODEL, add_payload, record
from tests.diagnosis.test_fit import make_problem

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


def test_what_was_left_out_of_a_law_is_fitted_later_and_once():
    loaded = functools.partial(add_payload, mass=0.05, x=0.0, z=-0.4)
    candidates = (PayloadMass("body/pole", z=-0.25), ViscousDamping("joint/hinge"))
    problem = make_problem([record(loaded, seed) for seed in range(2)], candidates)
    names = [slot.parameter.name for slot in problem.simulator.slots]
    mass, damping, z = (names.index(name) for name in ("mass", "coefficient", "z"))
    alone = fit(problem, problem.simulator.base, problem.segments.start, (mass, damping))
    score = Score(0, (mass,), (), {}, 0.0, 0.0, True, np.zeros(0))
    whole = complete(problem, Contender(score, alone), print)
    assert whole.fit.theta[z] == pytest.approx(-0.4, abs=0.01)
    again = complete(problem, dataclasses.replace(whole, score=score), print)
    assert again.fit.free == whole.fit.free
    assert len({*again.fit.free}) == len(again.fit.free)


def test_a_model_with_a_payload_is_diagnosed_again():
    """What the payload's own body adds to the model is no place of its own."""
    kinds = {kind: CATALOGUE[kind] for kind in (*RIVALS, "viscous_damping")}
    payload = PayloadMass("body/pole", mass=0.3, x=0.0, z=-0.2)
    model = dataclasses.replace(MODEL, catalogue=kinds, effects=(payload,))

    def loaded(spec):
        add_payload(spec, mass=0.3, x=0.0, z=-0.2)
        spec.joint("hinge").damping[0] += 0.02

    found = diagnose(model, [record(loaded, seed) for seed in range(4)])
    (damping,) = found.selected
    assert (damping.effect, damping.target) == ("viscous_damping", "joint/hinge")
    assert damping.parameters["coefficient"].estimate == pytest.approx(0.02, rel=0.05)
