"""Comparison: errors of known size are found, and what a user gets is complete."""

import dataclasses
import json

import numpy as np
import pytest

from garat_jax import cli
from garat_jax.diagnosis import compare, load_model
from garat_jax.diagnosis.hidden import make_recordings
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.replay import Replay, as_recordings, replay
from garat_jax.diagnosis.report import write_comparison
from garat_jax.diagnosis.segments import QUIET, Segments
from garat_jax.dynamics import Override
from garat_jax.runs import RunDirectory
from tests import models


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A model, and recordings without and with dry friction."""
    folder = tmp_path_factory.mktemp("recorded")
    path = folder / "pendulum.xml"
    path.write_text(models.PENDULUM)
    files = {}
    for kind in ("none", "coulomb_friction"):
        made = make_recordings(path, folder / kind, 0, num_recordings=2, seconds=3.0, kind=kind)
        files[kind] = (*made.fit, *made.holdout)
    return path, files


def read(recorded, kind):
    path, files = recorded
    model = load_model(path)
    host = model.compile(engine="mujoco").host.model
    return model, [Recording.read(file, host) for file in files[kind]]


def test_a_true_model_is_at_the_noise_floor(recorded):
    found = compare(*read(recorded, "none"))
    assert found.error.before < 1.2 * found.error.noise_floor
    assert "near the sensors' noise" in found.sentence


def test_another_model_is_scored_at_its_own_timestep(recorded):
    model, recordings = read(recorded, "none")
    coarse = dataclasses.replace(model, overrides=(Override("option", "", "timestep", 0.02),))
    alone, found = compare(model, recordings), compare(coarse, recordings, also=[model])
    assert found.error.before > 1.5 * alone.error.before
    assert found.also[0].error == pytest.approx(alone.error.before, rel=0.01)


def test_missing_friction_is_seen_and_placed(recorded):
    found = compare(*read(recorded, "coulomb_friction"))
    assert found.error.before > 3 * found.error.noise_floor
    assert found.where[0].signal == "hinge"
    assert "Most goes wrong at hinge" in found.sentence
    errors = [h.error for h in found.horizons]
    assert errors == sorted(errors)


def test_velocity_is_left_out_where_it_was_not_measured(recorded):
    model, recordings = read(recorded, "none")
    recordings = [dataclasses.replace(r, velocity_measured=False) for r in recordings]
    assert list(compare(model, recordings).error.per_signal) == ["qpos.hinge"]


def test_command_writes_what_scripts_read(recorded, tmp_path, capsys):
    path, files = recorded
    names = [str(file) for file in files["coulomb_friction"]]
    assert cli.main(["compare", str(path), *names, "--out", str(tmp_path / "run")]) == 0
    content = json.loads((tmp_path / "run" / "compare.json").read_text())
    assert content["format"] == "garat-compare/1"
    assert content["error"]["after"] == content["error"]["before"]
    assert content["error"]["per_signal"]["qvel.hinge"]["unit"] == "rad/s"
    assert {"signal", "share", "regime", "evidence"} == set(content["where"][0])
    whiteness = content["residuals"]["whiteness"]
    assert [w["signal"] for w in whiteness] == ["qpos.hinge", "qvel.hinge"]
    assert not any(w["white"] for w in whiteness)
    assert content["residuals"]["independence"][0]["input"] == "motor"
    assert content["torques"] == []
    quality = content["recordings"][0]
    assert quality["rate"] == pytest.approx(250.0)
    assert (quality["gaps"], quality["velocity"]) == (0, "measured")
    assert abs(quality["command_lag"]["motor"]) < 0.003
    horizons = content["horizons"]
    assert all(h["per_signal"]["qpos.hinge"]["fit_percent"] > 50 for h in horizons)
    page = (tmp_path / "run" / "report.html").read_text()
    assert "Comparison of pendulum" in page
    for heading in ("Measured against simulated", "What the recordings are worth"):
        assert heading in page
    assert "not white: qpos.hinge, qvel.hinge" in page
    assert "report:" in capsys.readouterr().out


def test_what_is_odd_about_recordings_is_in_their_comparison_and_its_report(recorded, tmp_path):
    model, recordings = read(recorded, "none")
    odd = dataclasses.replace(recordings[0], warnings=("run.csv: 1 gap",))
    found = compare(model, [odd, *recordings[1:]])
    assert found.warnings == ("run.csv: 1 gap",)
    run = RunDirectory.create(tmp_path / "run", {}, "garat compare", [])
    page = write_comparison(run, found, model, recordings).read_text()
    assert "Warning: run.csv: 1 gap." in page


def test_no_smaller_timestep_is_asked_for_where_nothing_moves(recorded):
    model, (recording, *_) = read(recorded, "none")
    at = {"qpos": 0.5 + 0 * recording.qpos, "qvel": 0 * recording.qvel}
    found = compare(model, [dataclasses.replace(recording, **at, ctrl=0 * recording.ctrl)])
    assert found.error.is_too_coarse
    assert found.sentence.endswith("it moves, and in these recordings nothing does.")


def test_commands_of_the_wrong_sign_are_told(recorded):
    model, recordings = read(recorded, "none")
    turned = [dataclasses.replace(recording, ctrl=-recording.ctrl) for recording in recordings]
    assert "do these commands count the other way?" in compare(model, turned).warnings[0]


def test_measured_torques_are_compared_where_there_are_any(recorded, tmp_path):
    model, recordings = read(recorded, "coulomb_friction")
    torque = {"hinge": recordings[0].ctrl[:, 0]}
    found = compare(model, [dataclasses.replace(recordings[0], torque=torque)])
    (error,) = found.torques
    assert error.actuator_fit_percent > 95
    assert error.motion_rmse > 3 * error.actuator_rmse
    assert "torque at hinge: measured" in str(found)
    assert found.to_json()["torques"][0]["unit"] == "N m"


def test_command_refuses_a_recording_of_another_model(recorded, tmp_path, capsys):
    _, files = recorded
    arm = tmp_path / "arm.xml"
    arm.write_text(models.ARM)
    status = cli.main(["compare", str(arm), str(files["none"][0]), "--out", str(tmp_path / "run")])
    assert status == 2
    line = capsys.readouterr().err
    assert "its commands are ctrl.motor, and the model's actuators want ctrl.shoulder" in line


def handmade(predicted, measured, weight) -> Replay:
    empty = np.zeros((len(measured), 1))
    segments = Segments(
        measured=measured,
        weight=weight,
        observed=np.ones((len(measured), 1), bool),
        trust=np.ones_like(measured),
        start=empty,
        ctrl=empty,
        place=empty,
        recording=np.zeros(len(measured), int),
        first=np.arange(len(measured)) * measured.shape[1],
        past=empty,
        past_qvel=empty,
        num_past=np.zeros(len(measured), int),
        begins=empty,
        noise=np.asarray([0.1]),
        spread=np.asarray([2.0]),
        start_unit=np.ones(1),
    )
    return Replay(1.0, ("qpos.hinge",), ("rad",), segments, predicted)


def test_sizes_by_hand():
    measured = np.zeros((2, 2, 1))
    predicted = np.asarray([[[3.0], [4.0]], [[0.0], [99.0]]])
    played = handmade(predicted, measured, np.asarray([[1.0, 1.0], [1.0, 0.0]]))
    size = played.sizes()["qpos.hinge"]
    assert size.rmse == pytest.approx(np.sqrt((9 + 16 + 0) / 3))
    assert size.relative == pytest.approx(size.rmse / (QUIET * 0.1))
    assert np.isnan(size.fit_percent)  # nothing moves
    assert played.error() == pytest.approx(size.relative)
    assert played.worst(1) == [0]


def test_the_fit_of_a_signal_is_relative_to_its_standard_deviation():
    measured = np.asarray([[[1.0], [5.0]], [[-3.0], [1.0]]])
    off = np.asarray([[[1.0], [-1.0]]])
    played = handmade(measured + off, measured, np.ones((2, 2)))
    size = played.sizes()["qpos.hinge"]
    assert size.fit_percent == pytest.approx(100 * (1 - 1.0 / np.sqrt(8.0)))


def test_predictions_take_the_place_of_measurements(recorded):
    model, recordings = read(recorded, "none")
    (played,) = replay(model, recordings, {0.5: range(len(recordings))})
    perfect = dataclasses.replace(played, predicted=played.segments.measured)
    host = model.compile(engine="mujoco").host.model
    for made, original in zip(as_recordings(perfect, recordings, host), recordings, strict=True):
        for a, b in made.spans:
            np.testing.assert_array_equal(made.qpos[a:b], original.qpos[a:b])
            np.testing.assert_array_equal(made.qvel[a:b], original.qvel[a:b])
        assert made.spans[0][0] == 0


def test_wrong_input_leaves_the_run_that_it_would_have_replaced(tmp_path, capsys):
    model, data, out = (tmp_path / name for name in ("pendulum.xml", "bad.csv", "run"))
    model.write_text(models.PENDULUM)
    data.write_text("time,nothing\n0,1\n")
    RunDirectory.create(out, {}, "garat compare", []).log(1, error=1.0)
    assert cli.main(["compare", str(model), str(data), "--out", str(out), "--force"]) == 2
    (line,) = RunDirectory.open(out).metrics()
    assert line["error"] == 1.0
    inside = out / "data.csv"
    data.rename(inside)
    assert cli.main(["compare", str(model), str(inside), "--out", str(out), "--force"]) == 2
    assert "which --force replaces" in capsys.readouterr().err
    assert inside.is_file()
