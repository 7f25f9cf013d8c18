"""An effect that a model has may have another size in new recordings."""

import dataclasses
import functools
import sys

import jax.numpy as jnp
import pytest

from garat_jax.diagnosis.conditions import diagnose_conditions
from garat_jax.diagnosis.diagnose import diagnose, sizable
from garat_jax.diagnosis.findings import Named
from garat_jax.diagnosis.improve import improve
from garat_jax.diagnosis.report import diagnosis_lead
from garat_jax.diagnosis.report_effects import parameters_section
from garat_jax.diagnosis.view import repaired
from garat_jax.effects import CATALOGUE, CoulombFriction, MotorCurve, ViscousDamping
from tests.diagnosis.pendulum import MODEL, add_damping, record

FEW = {kind: CATALOGUE[kind] for kind in ("viscous_damping", "coulomb_friction")}
DAMPING = Named("viscous_damping", "joint/hinge")
DAMPED = dataclasses.replace(
    MODEL,
    catalogue=FEW,
    effects=(
        ViscousDamping("joint/hinge", coefficient=0.02),
        MotorCurve("actuator/motor", table=((0.0, 0.0), (10.0, 10.0))),
    ),
)


def recordings(size, seeds=range(3)):
    return [record(functools.partial(add_damping, size=size), seed) for seed in seeds]


@pytest.mark.parametrize("size", [0.008, 0.05])
def test_it_is_found_and_takes_the_place_of_the_models(size):
    found = diagnose(DAMPED, recordings(size))
    (damping,) = found.selected
    assert damping.named == DAMPING
    assert damping.parameters["coefficient"].estimate == pytest.approx(size, rel=0.05)
    assert found.verdict == "missing_effect"
    assert found.own == (DAMPING,)
    effects = {e.kind: e for e in repaired(DAMPED, found.selected).effects}
    assert len(effects) == 2
    assert effects["viscous_damping"].coefficient == damping.parameters["coefficient"].estimate
    assert effects["motor_curve"].table == ((0.0, 0.0), (10.0, 10.0))
    assert str(found).startswith(
        "Missing: another size of viscous_damping at joint/hinge; held-out"
    )
    assert "  + another size of viscous_damping at joint/hinge (coefficient 0.0" in str(found)
    (shown,) = parameters_section(found, DAMPED)[0].tables
    assert shown.columns[-1] == "in the model as it is"
    assert [row[-1] for row in shown.rows] == [pytest.approx(0.02)]
    said = "The model needs another size of viscous damping at joint/hinge. With it"
    assert diagnosis_lead(found).startswith(said)


def test_one_that_is_not_there_is_said_to_be_none():
    found = diagnose(DAMPED, recordings(0.0))
    (damping,) = found.selected
    assert damping.parameters["coefficient"].estimate == 0.0
    spelled = "another size (none) of viscous_damping at joint/hinge"
    assert found.sentence.startswith(f"Missing: {spelled}; held-out")
    assert f"  + {spelled} (coefficient 0 " in str(found)
    (effect,) = [e for e in repaired(DAMPED, found.selected).effects if e.kind in FEW]
    assert effect.coefficient == 0.0


def test_of_the_right_size_it_is_left_alone():
    found = diagnose(DAMPED, recordings(0.02))
    assert (found.verdict, found.selected) == ("adequate", ())


def test_what_a_model_has_is_not_listed_as_what_recordings_cannot_show():
    noisy = [record(add_damping, seed, noise=0.2) for seed in range(3)]
    of_plain, of_damped = (
        {Named(one.effect, one.target) for one in diagnose(model, noisy).unseen}
        for model in (dataclasses.replace(MODEL, catalogue=FEW), DAMPED)
    )
    assert DAMPING in of_plain
    assert DAMPING not in of_damped


def test_a_law_of_a_table_has_no_size():
    assert [e.kind for e in sizable(DAMPED)] == ["viscous_damping"]


def test_improving_a_model_replaces_it_and_adds_what_else_is_missing():
    def change(spec):
        add_damping(spec, size=0.05)
        spec.joint("hinge").frictionloss = 0.1

    done = improve(DAMPED, [record(change, seed) for seed in range(3)])
    sizes = {e.kind: e for e in done.model.effects}
    assert sorted(sizes) == ["coulomb_friction", "motor_curve", "viscous_damping"]
    assert len(done.model.effects) == 3
    assert sizes["viscous_damping"].coefficient == pytest.approx(0.05, rel=0.1)
    assert sizes["coulomb_friction"].torque == pytest.approx(0.1, rel=0.1)
    first, *_, last = done.diagnosis.ladder
    assert last.error_holdout < 0.3 * first.error_holdout
    assert "another size of viscous_damping at joint/hinge" in done.card


def test_a_later_round_may_size_an_effect_again(monkeypatch):
    data = recordings(0.008)
    first = diagnose(DAMPED, data)
    (damping,) = first.selected
    size = dataclasses.replace(damping.parameters["coefficient"], estimate=0.009)
    again = dataclasses.replace(damping, parameters={"coefficient": size})
    second, last = (dataclasses.replace(first, selected=found) for found in ((again,), ()))
    rounds = iter([first, second, last])
    module = sys.modules["garat_jax.diagnosis.improve"]
    monkeypatch.setattr(module, "diagnose", lambda *arguments: next(rounds))
    done = improve(DAMPED, data)
    (found,) = done.diagnosis.selected
    assert found.parameters["coefficient"].estimate == 0.009
    assert [rung.added and rung.added.named for rung in done.diagnosis.ladder] == [None, DAMPING]
    assert len(done.model.effects) == 2


def test_only_the_condition_that_shows_another_size_has_it():
    found = diagnose_conditions(DAMPED, recordings(0.02), {"warm": recordings(0.008, (3, 4, 5))})
    assert found.selected == ()
    (warm,) = found.conditions["warm"].selected
    assert warm.parameters["coefficient"].estimate == pytest.approx(0.008, rel=0.05)


def test_an_effect_of_its_own_acts_where_another_condition_changes_it():
    def change(spec, damping):
        add_damping(spec, size=damping)
        spec.joint("hinge").frictionloss = 0.05

    own = CoulombFriction("joint/hinge", torque=0.1)
    cold, warm = (functools.partial(change, damping=size) for size in (0.02, 0.008))
    found = diagnose_conditions(
        DAMPED.with_effects((own,)),
        [record(cold, seed) for seed in range(3)],
        {"warm": [record(warm, seed) for seed in (3, 4, 5)]},
    )
    (friction,), (damping,) = found.selected, found.conditions["warm"].selected
    assert friction.parameters["torque"].estimate == pytest.approx(0.05, rel=0.05)
    assert damping.parameters["coefficient"].estimate == pytest.approx(0.008, rel=0.1)
    assert {own.kind, DAMPING.effect} == {named.effect for named in found.own}


def test_a_kind_that_the_catalogue_lacks_is_left_as_it_is():
    few = {"coulomb_friction": CATALOGUE["coulomb_friction"]}
    assert sizable(dataclasses.replace(DAMPED, catalogue=few)) == ()


def test_a_model_takes_effects_in_the_place_of_its_own():
    friction = CoulombFriction("joint/hinge", torque=0.1)
    more = ViscousDamping("joint/hinge", coefficient=0.03)
    model = DAMPED.with_effects((more, friction))
    assert [e.kind for e in model.effects] == ["motor_curve", "viscous_damping", "coulomb_friction"]
    assert jnp.isclose(model.effects[1].coefficient, 0.03)
    assert [e.kind for e in model.without((more,)).effects] == ["motor_curve", "coulomb_friction"]
