"""What all conditions share is found once, and what one adds is that condition's own."""

import dataclasses
import functools
import json
import re
import shutil
from typing import cast

import numpy as np
import pytest

from garat_jax.cli import main
from garat_jax.diagnosis import load_model, run_diagnose
from garat_jax.diagnosis import run as diagnosis_run
from garat_jax.diagnosis.conditions import JointSimulator, diagnose_conditions, read_all
from garat_jax.diagnosis.convert import write_csv
from garat_jax.diagnosis.improve import improve, run_improve
from garat_jax.diagnosis.segments import Segments
from garat_jax.diagnosis.simulate import Simulator, Slot
from garat_jax.effects import CATALOGUE, TorqueOffset, ViscousDamping
from garat_jax.errors import UserError
from garat_jax.runs import RunDirectory
from tests import models
from tests.diagnosis.pendulum import MODEL, add_damping, add_payload, record

FEW = {kind: CATALOGUE[kind] for kind in ("viscous_damping", "torque_offset", "payload_mass")}


def improve_under(model, recordings, conditions, say):
    return improve(model, recordings, say=say, conditions=conditions)


def test_damping_is_shared_and_the_pull_is_the_conditions_own():
    model = dataclasses.replace(MODEL, catalogue=FEW)
    base = [record(add_damping, seed) for seed in range(3)]
    pulled = [record(add_damping, seed, pull=0.1) for seed in (3, 4, 5)]
    found = diagnose_conditions(model, base, {"with cable": pulled})
    (damping,) = found.selected
    assert damping.effect == "viscous_damping"
    assert damping.parameters["coefficient"].estimate == pytest.approx(0.02, rel=0.05)
    (pull,) = found.conditions["with cable"].selected
    assert pull.effect == "torque_offset"
    assert pull.parameters["torque"].estimate == pytest.approx(0.1, rel=0.05)
    content = found.to_json()["conditions"]["with cable"]
    assert content["selected"][0]["effect"] == "torque_offset"
    assert content["conditions"] == {}
    assert "Under the condition with cable, with the above: Missing: torque_offset" in str(found)
    cable = dataclasses.replace(found.conditions["with cable"], warnings=("it was cold",))
    warned = dataclasses.replace(found, conditions={"with cable": cable})
    assert "  warning: it was cold" in warned.other_conditions


def test_a_shared_effect_may_be_weaker_under_a_condition():
    model = dataclasses.replace(MODEL, catalogue=FEW)
    base = [record(add_damping, seed) for seed in range(3)]
    weaker = functools.partial(add_damping, size=0.008)
    found = diagnose_conditions(model, base, {"warm": [record(weaker, s) for s in (3, 4, 5)]})
    (cold,), (warm,) = found.selected, found.conditions["warm"].selected
    assert cold.named == warm.named
    assert cold.parameters["coefficient"].estimate == pytest.approx(0.02, rel=0.05)
    assert warm.parameters["coefficient"].estimate == pytest.approx(0.008, rel=0.05)
    assert "viscous_damping at joint/hinge (instead of the shared one): coeff" in str(found)


def test_all_conditions_size_a_shared_effect_and_each_sizes_its_own():
    model = dataclasses.replace(MODEL, catalogue=FEW)

    def loaded(spec):
        add_damping(spec)
        add_payload(spec, mass=0.1, x=0.0, z=-0.4)

    base = [record(add_damping, seed) for seed in range(3)]
    found = diagnose_conditions(model, base, {"loaded": [record(loaded, s) for s in (3, 4, 5)]})
    (payload,) = found.conditions["loaded"].selected
    assert payload.effect == "payload_mass"
    assert payload.parameters["mass"].estimate == pytest.approx(0.1, rel=0.05)
    assert payload.parameters["z"].estimate == pytest.approx(-0.4, abs=0.01)
    shared = found.selected[0].parameters["coefficient"]
    assert shared.low < 0.02 < shared.high
    for one in (found, found.conditions["loaded"]):
        assert [rung.added for rung in one.ladder] == [None, *one.selected]


def test_a_shared_payload_may_be_heavier_under_a_condition():
    model = dataclasses.replace(MODEL, catalogue={"payload_mass": CATALOGUE["payload_mass"]})
    one, three = (functools.partial(add_payload, mass=m, x=0.0, z=-0.4) for m in (0.4, 1.2))
    base = [record(one, seed) for seed in range(3)]
    found = diagnose_conditions(model, base, {"more": [record(three, s) for s in (3, 4, 5)]})
    masses = [d.selected[0].parameters["mass"] for d in (found, found.conditions["more"])]
    assert [m.estimate for m in masses] == pytest.approx([0.4, 1.2], rel=0.05)


class Echo:
    """Stands for a simulator, and predicts each segment's parameters."""

    effects = (ViscousDamping("joint/hinge"), TorqueOffset("joint/hinge"))
    slots = tuple(Slot(i, e.parameters()[0], 0.0) for i, e in enumerate(effects))
    base = np.zeros(2)
    host = None

    def predict(self, theta, start, segments):
        of_each = theta if theta.ndim > 2 else theta[:, None]
        return np.broadcast_to(of_each[:, :, None], (len(theta), *segments.measured.shape))


def test_each_condition_is_simulated_with_what_is_shared_and_what_is_its_own():
    damping, offset = Echo.effects
    selected = [(damping.replace(coefficient=1.0),), (damping.replace(coefficient=2.0),)]
    selected.append((offset.replace(torque=3.0),))
    joint = JointSimulator(cast(Simulator, Echo()), selected, np.asarray([0, 0, 1, 2]))
    np.testing.assert_array_equal(joint.base, [1.0, 2.0, 3.0])
    many = np.zeros(4)
    segments = Segments(
        measured=np.zeros((4, 1, 2)),
        recording=np.arange(4),
        **dict.fromkeys(
            (
                "weight",
                "observed",
                "trust",
                "start",
                "ctrl",
                "place",
                "first",
                "noise",
                "spread",
                "past",
                "past_qvel",
                "num_past",
                "begins",
            ),
            many,
        ),
        start_unit=many,
    )
    theta = np.stack([joint.base, 10 * joint.base])
    predicted = joint.predict(theta, np.zeros((2, 4, 2)), segments)
    np.testing.assert_array_equal(predicted[0, :, 0], [[1, 0], [1, 0], [2, 0], [1, 3]])
    np.testing.assert_array_equal(predicted[1], 10 * predicted[0])
    each = np.arange(1.0, 5.0)[None, :, None] * joint.base
    of_each = joint.predict(each, np.zeros((1, 4, 2)), segments)
    np.testing.assert_array_equal(of_each[0], np.arange(1, 5)[:, None, None] * predicted[0])


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    (folder / "pendulum.xml").write_text(models.PENDULUM)
    for name, pull in (("base", 0.0), ("pulled", 0.1)):
        for seed in range(3):
            made = record(add_damping, seed, pull)
            columns = {"time": made.time, "qpos.hinge": made.qpos[:, 0]}
            columns |= {"qvel.hinge": made.qvel[:, 0], "ctrl.motor": made.ctrl[:, 0]}
            write_csv(folder / f"{name}_{seed}.csv", columns)
    return folder


@pytest.mark.parametrize("command", ["diagnose", "improve"])
def test_each_condition_has_a_card_traces_and_its_recordings_one_by_one(files, tmp_path, command):
    run = RunDirectory.create(tmp_path / "run", {}, f"garat {command}", [])
    base, pulled = (sorted(files.glob(f"{name}_*.csv")) for name in ("base", "pulled"))
    given = (files / "pendulum.xml", base, (), run)
    if command == "diagnose":
        found = run_diagnose(*given, catalogue=FEW, conditions={"cable": pulled}).diagnosis
        content = json.loads((run.root / "diagnosis.json").read_text())
    else:
        found = run_improve(*given, catalogue=FEW, conditions={"cable": pulled}).diagnosis
        content = json.loads((run.root / "improve.json").read_text())
    shared, cable = (load_model(run.root / f"model{n}.toml").effects for n in ("", "-cable"))
    assert [e.kind for e in shared] == ["viscous_damping"]
    assert [e.kind for e in cable] == ["viscous_damping", "torque_offset"]
    assert float(cable[1].torque) == pytest.approx(0.1, rel=0.05)

    (damping,) = found.repeatability  # in all recordings, the pull in the condition's
    assert [s.recording for s in damping.recordings] == [p.name for p in (*base, *pulled)]
    assert all(s.is_needed for s in damping.recordings)
    (pull,) = found.conditions["cable"].repeatability
    assert [s.recording for s in pull.recordings] == [p.name for p in pulled]
    assert content["conditions"]["cable"]["repeatability"][0]["effect"] == "torque_offset"

    page = re.sub(r"<[^>]*>", " ", (run.root / "report.html").read_text())
    assert "Measured against simulated under the condition cable" in page
    assert "torque offset at joint/hinge (cable): every recording by itself asks" in page


def test_a_condition_without_a_file_is_refused(tmp_path, capsys):
    model, data = tmp_path / "p.xml", tmp_path / "d.csv"
    model.write_text(models.PENDULUM)
    data.write_text("")
    for word, said in (
        ("loaded", "NAME=FILE"),
        ("loaded=none.csv", "there is no file none.csv"),
        (f"a/b={data}", "may hold no folder"),
    ):
        for command in ("diagnose", "improve"):
            assert main([command, str(model), str(data), "--condition", word]) == 2
            assert said in capsys.readouterr().err


def test_files_of_one_name_are_told_apart_in_all_that_is_read(files, tmp_path):
    paths = [tmp_path / day / "run.csv" for day in ("day1", "day2", "day3")]
    for path in paths:
        path.parent.mkdir()
        shutil.copy(files / "base_0.csv", path)
    data, held_out, others = read_all(MODEL, paths[:1], paths[1:2], {"cable": paths[2:]})
    names = [recording.name for recording in (*data, *held_out, *others["cable"])]
    assert names == ["day1/run.csv", "day2/run.csv", "day3/run.csv"]


def test_an_earlier_run_stays_where_a_diagnosis_of_conditions_fails(files, tmp_path, monkeypatch):
    def fail(*_):
        raise UserError("no luck")

    monkeypatch.setattr(diagnosis_run, "diagnose_keeping", fail)
    earlier = RunDirectory.create(tmp_path / "run", {}, "garat diagnose", [])
    earlier.write_json("diagnosis.json", {})
    given = [files / "pendulum.xml", files / "base_0.csv", "--condition"]
    given += [f"cable={files / 'pulled_0.csv'}", "--out", earlier.root, "--force"]
    assert main(["diagnose", *map(str, given)]) == 2
    assert (earlier.root / "diagnosis.json").exists()
    assert not (earlier.root / "model").exists()


@pytest.mark.parametrize("find", [diagnose_conditions, improve_under])
def test_too_short_a_condition_is_refused_before_the_base_is_diagnosed(find):
    short = dataclasses.replace(record(add_damping, 3), name="short", spans=((0, 20),))
    said: list[str] = []
    with pytest.raises(UserError, match="condition warm: short is too short to hold out"):
        find(MODEL, [record(add_damping, 0)], {"warm": [short]}, say=said.append)
    assert not said
