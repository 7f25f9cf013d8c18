"""`garat improve`: a hidden effect ends up in a model card that loads, and the error falls."""

import dataclasses
import json
import re
from pathlib import Path

import pytest

from garat_jax.diagnosis import load_model
from garat_jax.diagnosis.compare import read_recordings
from garat_jax.diagnosis.findings import Drift, Estimate
from garat_jax.diagnosis.held_out import HeldOut
from garat_jax.diagnosis.hidden import make_recordings
from garat_jax.diagnosis.improve import _as_one, _card_section, run_improve
from garat_jax.effects import CATALOGUE
from garat_jax.runs import RunDirectory
from tests import models

FEW = {kind: CATALOGUE[kind] for kind in ("viscous_damping", "coulomb_friction", "torque_offset")}


@pytest.fixture(scope="module")
def improved(tmp_path_factory):
    folder = tmp_path_factory.mktemp("improved")
    path = folder / "pendulum.xml"
    path.write_text(models.PENDULUM)
    made = make_recordings(
        path, folder / "data", 5, num_recordings=3, seconds=3.0, rate=125.0,
        kind="coulomb_friction",
    )  # fmt: skip
    run = RunDirectory.create(folder / "run", {}, "garat improve pendulum.xml", [])
    done = run_improve(path, (*made.fit, *made.holdout), (), run, catalogue=FEW)
    return made, run, done


def test_the_repaired_card_loads_and_has_the_effect(improved):
    made, run, _ = improved
    model = load_model(run.root / "model.toml")
    (effect,) = model.effects
    assert (effect.kind, effect.target) == ("coulomb_friction", "joint/hinge")
    assert effect.torque == pytest.approx(made.parameters["torque"], rel=0.05)
    assert model.mjcf.resolve().is_relative_to(run.root.resolve())
    assert model.mjcf.read_text() == models.PENDULUM


def test_the_ladder_falls_to_the_floor(improved):
    _, run, done = improved
    content = json.loads((run.root / "improve.json").read_text())
    assert content["format"] == "garat-improve/1"
    first, last = content["ladder"]
    assert first["added"] is None
    assert last["added"]["effect"] == "coulomb_friction"
    assert last["error_holdout"] < 0.3 * first["error_holdout"]
    assert content["error"]["after"] == last["error_holdout"]
    assert content["error"]["after"] < 1.25 * content["error"]["noise_floor"]
    assert content["verdict"] == "missing_effect"
    assert [r["verdict"] for r in content["rounds"]] == ["missing_effect", "adequate"]
    assert "+ coulomb_friction at joint/hinge (torque 0.07" in str(done)


CHANGE = Estimate(0.1, 0.05, 0.15, "N m")
DRIFT = Drift("coulomb_friction", "joint/hinge", "torque", 0.1, 0.2, CHANGE, 0.001, 0.5)


def test_a_drift_is_printed_and_written(improved):
    done = improved[2]
    drifting = dataclasses.replace(
        done, diagnosis=dataclasses.replace(done.diagnosis, drifts=(DRIFT,))
    )
    assert "\n  drift: torque of coulomb_friction" in str(drifting)
    (written,) = drifting.to_json()["drifts"]
    assert written["parameter"] == "torque"


def test_warnings_are_those_of_the_repaired_model(improved, monkeypatch):
    done = improved[2]
    first, last = (dataclasses.replace(r, warnings=(f"of {i}",)) for i, r in enumerate(done.rounds))
    measured = ((), HeldOut(first.error), ())
    monkeypatch.setattr("garat_jax.diagnosis.improve._ladder", lambda *given: measured)
    whole = _as_one(done.model, (), (), [first, last], first.selected)
    warned = dataclasses.replace(done, diagnosis=whole)
    assert "\n  warning: of 1" in str(warned)
    assert "of 0" not in str(warned)
    assert warned.to_json()["warnings"] == ["of 1"]


def test_a_gap_that_a_finer_timestep_shows_is_left_by_a_model_that_is_adequate(
    improved, monkeypatch
):
    done = improved[2]
    first, last = done.rounds
    gap = dataclasses.replace(last.error, after=1.0, unexplained_share=0.9, timestep=0.0005)
    measured = ((), HeldOut(done.diagnosis.error, None, gap), ())
    monkeypatch.setattr("garat_jax.diagnosis.improve._ladder", lambda *given: measured)
    whole = _as_one(done.model, (), (), [first, last], first.selected)
    assert (last.verdict, whole.verdict) == ("adequate", "unexplained")
    assert whole.decisive is gap and whole.shown is whole.error
    (line,) = whole.left_lines
    assert line.startswith("it shows at a timestep of 0.0005 s")
    section = _card_section(dataclasses.replace(done, diagnosis=whole))
    assert "adequate at its own timestep; at a finer one a gap stays." in section.text


def test_so_is_one_that_a_finer_timestep_shows_of_what_a_delay_leaves(improved, monkeypatch):
    done = improved[2]
    first, last = done.rounds
    right = dataclasses.replace(last.error, after=0.1, unexplained_share=0.01, timestep=0.0005)
    gap = dataclasses.replace(right, unexplained_share=0.5)
    measured = ((), HeldOut(done.diagnosis.error, None, right, gap), ())
    monkeypatch.setattr("garat_jax.diagnosis.improve._ladder", lambda *given: measured)
    whole = _as_one(done.model, (), (), [first, last], first.selected)
    assert (whole.verdict, whole.gap) == ("unexplained", gap)
    written = dataclasses.replace(done, diagnosis=whole).to_json()
    assert written["on_time"]["unexplained_share"] == 0.5
    (line,) = whole.left_lines
    assert line.startswith("it shows at a timestep of 0.0005 s")


def test_a_drift_that_the_later_rounds_explain_is_not_said(improved, monkeypatch):
    """What drifts is found beside all effects that were added, not beside those of one round."""
    monkeypatch.setattr("garat_jax.diagnosis.improve.is_above", lambda *_: True)
    made, _, done = improved
    first, last = done.rounds
    rounds = [dataclasses.replace(first, drifts=(DRIFT,)), last]
    model = load_model(made.fit[0].parent.parent / "pendulum.xml", FEW)
    recordings = read_recordings(model, (*made.fit, *made.holdout))
    assert _as_one(model, recordings, (), rounds, first.selected).drifts == ()


@pytest.mark.parametrize("num_rounds", [1, 2])
def test_what_is_as_good_may_drift_instead_of_what_one_round_added(
    improved, monkeypatch, num_rounds
):
    done = improved[2]
    instead = dataclasses.replace(DRIFT, instead=True)
    measured = ((), HeldOut(done.diagnosis.error), (DRIFT,))
    monkeypatch.setattr("garat_jax.diagnosis.improve._ladder", lambda *given: measured)
    first, last = dataclasses.replace(done.rounds[0], drifts=(instead,)), done.rounds[-1]
    added = first.selected * num_rounds
    whole = _as_one(done.model, (), (), [first, last], added)
    assert whole.drifts == ((instead,) if num_rounds == 1 else (DRIFT,))


def test_each_recording_alone_shows_the_same_size(improved):
    made, _, done = improved
    (repeated,) = done.diagnosis.repeatability
    assert (repeated.parameter, repeated.unit, repeated.agree) == ("torque", "N m", True)
    assert [s.recording for s in repeated.recordings] == [
        path.name for path in (*made.fit, *made.holdout)
    ]
    for seen in repeated.recordings:
        assert seen.low < seen.estimate < seen.high
        assert seen.estimate == pytest.approx(made.parameters["torque"], rel=0.15)
        assert seen.is_needed
        assert seen.error_with < 0.3 * seen.error_without


def test_the_report_says_what_was_done(improved):
    page = Path(improved[1].root / "report.html").read_text()
    for part in ("Repair of pendulum", "The same in every recording?", "The repaired model"):
        assert part in page
    shown = re.sub(r"<[^>]*>", " ", page.split("Diagnosis after diagnosis</h2>")[1])
    for row in (r"1\s+missing effect\s+coulomb_friction at joint/hinge", r"2\s+adequate\s+nothing"):
        assert re.search(row, shown)
    assert "A last diagnosis of the repaired model found it adequate." in page
    friction = "coulomb friction at joint/hinge"
    assert f"{friction}: every recording by itself asks for this effect first." in page


def test_an_improvement_shows_in_a_notebook(improved):
    done = improved[2]
    assert done._repr_html_().startswith("<pre>Missing: coulomb_friction at joint/hinge")
    assert len(done.plot().data) and len(done.plot("ranking").data)


def test_recordings_of_different_sizes_disagree(tmp_path, improved):
    from garat_jax.diagnosis.measurements import Recording
    from garat_jax.diagnosis.repeat import repeatability

    _, _, done = improved
    model = load_model(done.diagnosis.model, FEW)
    files = []
    for seed in (5, 6):  # other seeds draw other sizes
        made = make_recordings(
            model.path, tmp_path / str(seed), seed, num_recordings=2, seconds=3.0, rate=125.0,
            kind="coulomb_friction",
        )  # fmt: skip
        files.append((made.fit[0], made.parameters["torque"]))
    recordings = [Recording.read(path, model) for path, _ in files]
    (repeated,) = repeatability(model, done.diagnosis, recordings).repeatability
    assert not repeated.agree
    for seen, (_, size) in zip(repeated.recordings, files, strict=True):
        assert seen.estimate == pytest.approx(size, rel=0.15)
