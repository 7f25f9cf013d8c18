"""Recordings that excite nothing, or not everything: what they cannot show is said."""

import json

import numpy as np
import pytest

from garat_jax import cli
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
    unseen = {(one["effect"], one["target"]): one["parameters"] for one in content["unseen"]}
    assert unseen["motor_gain", "actuator/motor"] == ["scale"]
    assert ("viscous_damping", "joint/hinge") in unseen
    assert ("encoder_offset", "joint/hinge") not in unseen  # at rest it hangs straight down
    page = (out / "report.html").read_text()
    assert "but the recordings excite nothing" in page
    assert "<h2>What these recordings cannot show</h2>" in page
    assert "<h2>Where it fails</h2>" not in page


def test_a_comparison_with_still_recordings_says_that_it_means_little(still, tmp_path, capsys):
    model, files = still
    assert cli.main(["compare", model, *files, "--out", str(tmp_path / "run")]) == 0
    assert "warning: the recordings excite nothing" in capsys.readouterr().out
