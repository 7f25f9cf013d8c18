"""A model that is unstable at its timestep: shorter segments, said aloud, and no false verdict."""

import dataclasses
import json
import re

import numpy as np
import pytest

from garat_jax import cli
from garat_jax.diagnosis import Recording, compare, diagnose, load_model
from garat_jax.diagnosis.report import diagnosis_lead
from garat_jax.dynamics import Override
from garat_jax.effects import CATALOGUE

SERVO = """
<mujoco model="servo">
  <option timestep="0.01"/>
  <worldbody><body name="arm"><joint name="hinge" type="hinge" axis="0 1 0"/>
    <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.5"/>
  </body></worldbody>
  <actuator><position name="motor" joint="hinge" kp="{kp}"/></actuator>
</mujoco>
"""
SOFT, SLOWLY, AT_ONCE = 200, 1110, 3000  # above about 1065 the integrator cannot hold the servo


def write(folder, kp):
    """Write a model, and recordings of a servo that follows its commands."""
    path = folder / "servo.xml"
    path.write_text(SERVO.format(kp=kp))
    rng, time, files = np.random.default_rng(0), np.arange(400) * 0.01, []
    for frequency in (0.5, 0.8):
        angle = 0.5 * np.sin(2 * np.pi * frequency * time)
        noise = rng.normal(size=(2, 400)) * [[1e-4], [1e-3]]
        columns = [time, angle + noise[0], np.gradient(angle, time) + noise[1], angle]
        files.append(folder / f"{frequency}.csv")
        header = "time,qpos.hinge,qvel.hinge,ctrl.motor"
        np.savetxt(
            files[-1], np.stack(columns, 1), "%.8g", delimiter=",", header=header, comments=""
        )
    return path, files


@pytest.mark.parametrize("command", ["compare", "diagnose", "improve"])
def test_what_diverges_within_the_shortest_segments_is_refused_in_a_line(tmp_path, capsys, command):
    model, files = write(tmp_path, AT_ONCE)
    out = tmp_path / "run"
    arguments = [command, str(model), *map(str, files), "--out", str(out)]
    for _ in range(2):  # the first leaves nothing that blocks the second
        assert cli.main(arguments) == 2
        line = capsys.readouterr().err.splitlines()[-1]
        assert "error: the model diverges within 0.05 s of a measured state" in line
        assert "at a timestep of 0.01 s" in line and "smaller timestep" in line
        assert not out.exists()


def test_what_diverges_later_is_said_with_the_segments_that_are_left(tmp_path, capsys):
    model, files = write(tmp_path, SLOWLY)
    out = tmp_path / "run"
    assert cli.main(["compare", str(model), *map(str, files), "--out", str(out)]) == 0
    printed = capsys.readouterr()
    assert "segments were shortened to 0.2 s" in printed.err
    text = (out / "compare.json").read_text()
    content = json.loads(text, parse_constant=pytest.fail)  # neither NaN nor infinity
    (warning,) = content["warnings"]
    assert "s of a measured state at a timestep of 0.01 s" in warning
    assert warning.endswith("segments were shortened to 0.2 s")
    assert f"warning: {warning}" in printed.out
    page = (out / "report.html").read_text()
    assert warning[1:] in page
    assert not re.search(r"\bnan\b", re.sub(r"<script>.*?</script>", "", page, flags=re.S), re.I)


def test_an_integrator_that_errs_more_than_the_signals_move_makes_no_verdict(tmp_path):
    path, files = write(tmp_path, SLOWLY)
    kinds = ("motor_gain", "viscous_damping")
    model = load_model(path, {kind: CATALOGUE[kind] for kind in kinds})
    recordings = [Recording.read(file, model) for file in files]
    compared, found = compare(model, recordings), diagnose(model, recordings)
    for result in (compared, found):
        assert result.error.is_too_coarse
        assert "cannot be judged at a timestep of 0.01 s" in str(result)
        assert "near the" not in result.sentence and "Missing" not in result.sentence
    assert not compared.near_noise
    assert found.verdict == "unexplained"
    assert found.error.unexplained_share == 1.0
    json.dumps(found.to_json(), allow_nan=False)
    assert "cannot be judged at a timestep of 0.01 s" in diagnosis_lead(found)
    assert diagnosis_lead(found).endswith("segments were shortened to 0.2 s.")
    finer = dataclasses.replace(found.error, integrator=0.1)
    assert not finer.is_too_coarse


def test_a_timestep_that_errs_beyond_the_noise_is_warned_of(tmp_path):
    path, files = write(tmp_path, SOFT)
    model = load_model(path, {"viscous_damping": CATALOGUE["viscous_damping"]})
    recordings = [Recording.read(file, model) for file in files]
    finer = dataclasses.replace(model, overrides=(Override("option", "", "timestep", 1e-4),))
    (warning,) = diagnose(model, recordings).warnings
    assert "at a timestep of 0.01 s the engine's own error is" in warning
    assert "times the noise of qvel.hinge; give the model a smaller timestep" in warning
    assert not any("timestep" in line for line in diagnose(finer, recordings).warnings)
