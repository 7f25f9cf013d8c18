"""Which effect does each recording alone ask for? One that has another cause is told apart."""

import dataclasses

import numpy as np

from garat_jax.diagnosis.diagnose import diagnose
from garat_jax.diagnosis.repeat import repeatability
from garat_jax.diagnosis.report_data import repeatability_section
from garat_jax.effects import CATALOGUE
from tests.diagnosis.pendulum import MODEL, add_damping, record

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
