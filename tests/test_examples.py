"""The example gallery runs as it stands and finds what its texts say."""

import runpy
from pathlib import Path

import plotly.graph_objects as go
import pytest

from garat_jax.diagnosis.results import Diagnosis
from garat_jax.errors import UserError

EXAMPLES = Path(__file__).parents[1] / "examples"


def run(name):
    return runpy.run_path(str(EXAMPLES / name))


def test_compare(capsys):
    names = run("01_compare.py")
    assert "times what noise and the integrator alone make" in capsys.readouterr().out
    assert isinstance(names["figure"], go.Figure)
    assert "pendulum" in names["comparison"].model
    assert names["comparison"]._repr_html_().startswith("<pre>The model&#x27;s error is")


def test_find_missing_friction(capsys):
    found: Diagnosis = run("02_find_missing_friction.py")["diagnosis"]
    assert [c.effect for c in found.selected] == ["coulomb_friction"]
    assert "Missing: coulomb_friction" in capsys.readouterr().out
    assert all(len(found.plot(what).data) for what in ("ladder", "ranking", "where"))
    assert "<pre>Missing: coulomb_friction" in found._repr_html_()
    with pytest.raises(UserError, match="did you mean ranking"):
        found.plot("rankin")


def test_export(capsys):
    names = run("03_export.py")
    assert names["repaired"].dof_frictionloss[0] == pytest.approx(0.06)
    assert "not in MJCF: " in capsys.readouterr().out


def test_user_effect():
    added = run("04_user_effect.py")["added"]
    assert float(added.model.effects[0].fade) == pytest.approx(0.5, rel=0.02)
    assert added.sized.error_after < 0.1 * added.sized.error_before


def test_sweep(capsys):
    lengths = run("05_sweep.py")["lengths"]
    assert lengths.shape == (3, 4, 15)
    assert lengths[1:, :, -1].mean() > 3 * lengths[0, :, -1].mean()
    assert "KL at most 0.01: " in capsys.readouterr().out


def test_conditions(capsys):
    names = run("06_conditions.py")
    found, truth = names["diagnosis"], names["truth"]
    for condition, (friction,) in (("cold", found.selected), ("warm", found.under("warm"))):
        assert friction.effect == "coulomb_friction"
        assert friction.parameters["torque"].estimate == pytest.approx(truth[condition], rel=0.05)
    assert "(instead of the shared one)" in capsys.readouterr().out


def test_plan(capsys):
    names = run("07_plan.py")
    planned = names["planned"]
    assert planned.after < planned.before
    assert len(names["figure"].data) == 1
    assert planned._repr_html_().startswith("<pre>viscous_damping at joint/hinge and coulomb")
    assert "300 commands at 100 Hz, time,ctrl." in capsys.readouterr().out


def test_train_in_repaired(capsys):
    errors = run("08_train_in_repaired.py")["errors"]
    assert errors["repaired"] < 0.06
    assert errors["as it is"] > 2 * errors["repaired"]
    assert "trained in the model repaired: " in capsys.readouterr().out


def test_an_own_effect_takes_under_30_lines():
    text = (EXAMPLES / "my_effects.py").read_text(encoding="utf-8")
    assert sum(bool(line.strip()) for line in text.splitlines()) < 30


def test_every_example_is_run_here():
    here = Path(__file__).read_text(encoding="utf-8")
    assert all(f'"{path.name}"' in here for path in EXAMPLES.glob("*.py"))


def test_drone(capsys):
    names = run("09_drone.py")
    found: Diagnosis = names["diagnosis"]
    sizes = {(c.effect, c.target): c.parameters for c in found.selected}
    assert sizes.keys() == {("air_drag", "body/frame"), ("motor_gain", "actuator/thrust")}
    drag = sizes["air_drag", "body/frame"]["coefficient"]
    gain = sizes["motor_gain", "actuator/thrust"]["scale"]
    assert drag.estimate == pytest.approx(names["DRAG"], rel=0.02)
    assert gain.estimate == pytest.approx(names["LOSS"], rel=0.005)
    assert (drag.unit, gain.unit) == ("N s²/m²", "1")
    assert "Missing: " in capsys.readouterr().out
