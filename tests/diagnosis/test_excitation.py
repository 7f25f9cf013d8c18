"""Recordings that excite nothing, or not everything: what they cannot show is said."""

import json

import numpy as np
import pytest

from garat_jax import cli
from garat_jax.diagnosis.compare import read_recordings
from garat_jax.diagnosis.diagnose import make_candidates
from garat_jax.diagnosis.findings import Named
from garat_jax.diagnosis.model_card import load_model
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.segments import choose_grid, cut
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.diagnosis.starts import settle
from garat_jax.diagnosis.unseen import unseen
from tests import models


def write(folder):
    """Write a pendulum, and two recordings of it that hold noise."""
    path = folder / "pendulum.xml"
    path.write_text(models.PENDULUM)
    rng, time, files = np.random.default_rng(0), np.arange(600) * 0.005, []
    for name in ("a", "b"):
        noise = rng.normal(size=(2, 600)) * [[1e-4], [1e-3]]
        columns = [time, *noise, 0.0 * time]
        files.append(str(folder / f"{name}.csv"))
        header = "time,qpos.hinge,qvel.hinge,ctrl.motor"
        np.savetxt(files[-1], np.stack(columns, 1), "%.8g", ",", header=header, comments="")
    return str(path), files


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    return write(tmp_path_factory.mktemp("still"))


def test_a_diagnosis_of_still_recordings_says_what_they_cannot_show(still, tmp_path, capsys):
    model, files = still
    out = tmp_path / "run"
    assert cli.main(["diagnose", model, *files, "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    sentence = printed.splitlines()[0]
    assert "but the recordings excite nothing" in sentence
    assert "cannot show motor_deadband (width) at actuator/motor, " in sentence
    assert "where:" not in printed  # what torque is missing is noise
    content = json.loads((out / "diagnosis.json").read_text())
    assert content["verdict"] == "adequate" and content["still"]
    hidden = {(one["effect"], one["target"]): one["parameters"] for one in content["unseen"]}
    assert hidden["motor_gain", "actuator/motor"] == ["scale"]
    assert ("viscous_damping", "joint/hinge") in hidden
    assert ("encoder_offset", "joint/hinge") not in hidden  # at rest it hangs straight down
    page = (out / "report.html").read_text()
    assert "but the recordings excite nothing" in page
    assert "<h2>What these recordings cannot show</h2>" in page
    assert "<h2>Where it fails</h2>" not in page


def test_a_comparison_with_still_recordings_says_that_it_means_little(still, tmp_path, capsys):
    model, files = still
    assert cli.main(["compare", model, *files, "--out", str(tmp_path / "run")]) == 0
    assert "warning: the recordings excite nothing" in capsys.readouterr().out


def test_an_effect_that_explains_much_is_not_called_unseen(still):
    path, files = still
    model = load_model(path)
    recordings = read_recordings(model, files)
    grid = choose_grid(recordings, 0.002)
    simulator = Simulator(model, make_candidates(model), grid)
    segments = cut(recordings, grid, 0.5)
    everywhere = np.ones(len(segments.start), bool)
    problem = Problem(simulator, simulator, segments, everywhere, grid.interval)
    settled = settle(problem, simulator.base, segments.start)
    damping = Named("viscous_damping", "joint/hinge")
    hidden = {Named(one.effect, one.target) for one in unseen(problem, settled)}
    assert damping in hidden
    seen = unseen(problem, settled, {damping})
    assert {Named(one.effect, one.target) for one in seen} == hidden - {damping}
