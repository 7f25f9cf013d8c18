"""Recordings that excite nothing, or not everything: what they cannot show is said."""

import json

import numpy as np
import pytest

from garat_jax import cli
from garat_jax.diagnosis.compare import read_recordings
from garat_jax.diagnosis.diagnose import make_candidates
from garat_jax.diagnosis.evidence import Evidence
from garat_jax.diagnosis.findings import Named
from garat_jax.diagnosis.model_card import load_model
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.segments import choose_grid, cut
from garat_jax.diagnosis.simulate import Simulator, columns_of
from garat_jax.diagnosis.starts import settle
from garat_jax.diagnosis.unseen import SEEN, unseen
from garat_jax.effects import CATALOGUE
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


@pytest.fixture(scope="module")
def at_rest(still):
    path, files = still
    model = load_model(path)
    recordings = read_recordings(model, files)
    grid = choose_grid(recordings, 0.002)
    simulator = Simulator(model, make_candidates(model), grid)
    segments = cut(recordings, grid, 0.5)
    everywhere = np.ones(len(segments.start), bool)
    problem = Problem(simulator, segments, everywhere, grid.interval)
    return problem, settle(problem, simulator.base, segments.start)


def test_an_effect_that_explains_much_is_not_called_unseen_nor_what_refines_it(at_rest):
    dry = Named("coulomb_friction", "joint/hinge")
    hidden = {Named(one.effect, one.target) for one in unseen(*at_rest)}
    assert {dry, Named("asymmetric_friction", "joint/hinge")} <= hidden
    left = {Named(one.effect, one.target) for one in unseen(*at_rest, {dry})}
    finer = {kind for kind, law in CATALOGUE.items() if "coulomb_friction" in law.refines}
    assert left == {n for n in hidden if n != dry and n.effect not in finer}


def test_an_effect_is_hidden_up_to_the_size_that_is_said(at_rest):
    problem, settled = at_rest
    sized = [one for one in unseen(problem, settled) if np.isfinite(one.up_to)]
    assert sized
    evidence = Evidence(problem, settled, np.flatnonzero(problem.fitted))
    places = [(effect.kind, effect.target) for effect in problem.simulator.effects]
    for one in sized:
        columns = columns_of(problem.simulator.slots, places.index((one.effect, one.target)))
        which = (
            [*columns.values()] if CATALOGUE[one.effect].independent else [*columns.values()][:1]
        )
        thetas = np.tile(settled.theta, (2, len(which), 1))
        thetas[:, range(len(which)), which] += [[0.45 * one.up_to], [1.001 * one.up_to]]
        sizes = np.linalg.norm(evidence.change(thetas.reshape(-1, thetas.shape[-1])), axis=0)
        below, above = sizes.reshape(2, -1).max(axis=1)
        assert below < SEEN < above, one
