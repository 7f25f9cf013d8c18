"""Which effect does each recording alone ask for? One that has another cause is told apart."""

import dataclasses

import numpy as np

from garat_jax.diagnosis.diagnose import diagnose
from garat_jax.diagnosis.findings import Named, Repeated, Sighting
from garat_jax.diagnosis.repeat import repeatability
from garat_jax.diagnosis.report_data import conditions_section, repeatability_section
from garat_jax.effects import CATALOGUE
from tests.diagnosis.pendulum import MODEL, add_damping, record
from tests.diagnosis.test_diagnosis_report import ADEQUATE, FRICTION, MISSING

FEW = {kind: CATALOGUE[kind] for kind in ("viscous_damping", "torque_offset", "coulomb_friction")}


def test_a_recording_that_asks_for_another_effect_is_named():
    model = dataclasses.replace(MODEL, catalogue=FEW)
    found = diagnose(model, [record(add_damping, seed) for seed in range(3)])
    assert [c.effect for c in found.selected] == ["viscous_damping"]
    odd = dataclasses.replace(record(lambda spec: None, 7, pull=0.1), name="odd")
    again = repeatability(model, found, [record(add_damping, 0), odd, record(add_damping, 1)])
    (damping,) = again.repeatability
    by_name = {seen.recording: seen for seen in damping.recordings}
    stranger = by_name.pop("odd")
    assert [rival.effect for rival in stranger.ahead] == ["torque_offset"]
    assert all(seen.is_needed for seen in by_name.values())
    assert stranger.error_with > 0.8 * stranger.error_without
    (section,) = repeatability_section(again)
    assert "2 of 3 recordings ask for it; odd for torque offset at joint/hinge." in section.text
    (table,) = section.tables
    assert f"followed for {stranger.horizon:.2g} s at a time" in table.caption
    assert np.isclose(table.rows[0][4], 100 * damping.recordings[0].error_without)
    assert again.to_json()["repeatability"][0]["recordings"][1]["ahead"] == [
        {"effect": "torque_offset", "target": "joint/hinge"}
    ]


def test_names_stay_as_they_are_and_nothing_is_compared_that_no_two_recordings_tell():
    inf = float("inf")
    rival = Named("torque_offset", "joint/left_knee")
    told = Sighting("long", 0.02, 0.019, 0.021, 0.4, 0.1, (), 0.5)
    untold = Sighting("short", 0.02, -inf, inf, 0.4, 0.1, (rival,), 0.5)
    place = ("viscous_damping", "joint/left_knee", "coefficient", "N m s/rad")
    found = Repeated(*place, recordings=(told, untold), p_value=1.0, agree=True)
    diagnosis = dataclasses.replace(ADEQUATE, repeatability=(found,))
    (section,) = repeatability_section(diagnosis)
    damping = "viscous damping at joint/left_knee"
    assert (
        f"{damping}: 1 of 2 recordings ask for it; short for torque offset at joint/left_knee"
        in (section.text)
    )
    assert f"coefficient of {damping}: no two recordings tell its size" in section.text
    (table,) = section.tables
    assert [row[3] for row in table.rows] == ["0.019 to 0.021", "–"]
    assert table.rows[1][6] == "torque offset at joint/left_knee"

    both = dataclasses.replace(found, recordings=(told, told))
    (section,) = repeatability_section(dataclasses.replace(ADEQUATE, repeatability=(both,)))
    assert "the recordings agree within their intervals" in section.text

    shown = dataclasses.replace(MISSING, conditions={"warm": ADEQUATE})
    shown = dataclasses.replace(
        shown, selected=(dataclasses.replace(FRICTION, target="joint/left_knee"),)
    )
    (section,) = conditions_section(shown)
    assert section.tables[0].rows[0][1] == "coulomb friction at joint/left_knee"
