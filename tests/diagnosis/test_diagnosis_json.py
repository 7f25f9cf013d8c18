"""The fields of diagnosis.json that scripts read, by name."""

import dataclasses
import json

import pytest

from tests.diagnosis.test_diagnosis_report import ADEQUATE, FRICTION, MISSING

TOP = (
    "format model data holdout versions seconds verdict error where candidates selected ladder "
    "next_experiment"
)
ERROR = "metric unit before after noise_floor unexplained_share per_signal"
CANDIDATE = (
    "effect target parameters share p_value error_after held_out_gain stability "
    "indistinguishable_from passes why"
)


@pytest.fixture(scope="module")
def content():
    """What a script reads: strict JSON, without NaN or infinity."""
    return json.loads(json.dumps(MISSING.to_json(), allow_nan=False))


def test_the_names_are_those_of_the_format(content):
    assert content["format"] == "garat-diagnosis/1"
    assert {*TOP.split()} <= content.keys()
    assert {*ERROR.split()} <= content["error"].keys()
    assert {"signal", "share", "regime", "evidence"} <= content["where"][0].keys()
    for listed in (*content["candidates"], *content["selected"]):
        assert {*CANDIDATE.split()} <= listed.keys()
    for rung in content["ladder"]:
        assert {"added", "error_fit", "error_holdout"} <= rung.keys()
    assert {"separates", "how"} <= content["next_experiment"].keys()


def test_numbers_are_where_they_are_looked_for(content):
    first, other = content["candidates"]
    assert first["parameters"]["torque"] == {
        "estimate": 0.06, "low": 0.055, "high": 0.065, "unit": "N m"
    }  # fmt: skip
    assert first["held_out_gain"] == {"estimate": 0.2, "low": 0.15, "high": 0.25}
    assert first["indistinguishable_from"] == [
        {"effect": "viscous_damping", "target": "joint/hinge"}
    ]
    assert content["selected"] == [first]
    assert (content["ladder"][0]["added"], content["ladder"][1]["added"]) == (None, first)
    assert other["error_after"] is None  # it was not fitted
    assert content["next_experiment"]["separates"][0]["effect"] == FRICTION.effect
    assert content["verdict"] == "missing_effect"


def test_what_there_is_none_of_is_null_or_empty():
    content = dataclasses.replace(ADEQUATE, candidates=()).to_json()
    assert content["next_experiment"] is None
    assert (content["selected"], content["candidates"], content["where"]) == ([], [], [])
    assert [rung["added"] for rung in content["ladder"]] == [None]
