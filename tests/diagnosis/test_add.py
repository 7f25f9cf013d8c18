"""`garat add`: what is set is written, what is fitted is recovered, what cannot be is refused."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from garat_jax import cli
from garat_jax.commands import models as commands
from garat_jax.diagnosis import load_model
from garat_jax.diagnosis.add import Sized
from garat_jax.diagnosis.diagnose import make_candidates
from garat_jax.diagnosis.hidden import make_recordings
from garat_jax.diagnosis.model_card import save_card
from garat_jax.effects import Backlash, ViscousDamping
from tests import models


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("pendulum") / "pendulum.xml"
    path.write_text(models.PENDULUM)
    return path


@pytest.fixture(scope="module")
def recorded(pendulum):
    made = make_recordings(
        pendulum,
        pendulum.parent / "data",
        3,
        num_recordings=2,
        seconds=3.0,
        rate=125.0,
        kind="coulomb_friction",
    )
    return made, [str(path) for path in (*made.fit, *made.holdout)]


def add(pendulum, *arguments) -> tuple[int, Path]:
    out = pendulum.parent / "new.toml"
    out.unlink(missing_ok=True)
    return cli.main(["add", str(pendulum), *arguments, "--out", str(out)]), out


def test_set_parameters_are_in_the_card(pendulum):
    status, out = add(pendulum, "payload_mass", "--at", "body/pole", "--set", "mass=0.2", "z=-0.3")
    assert status == 0
    (effect,) = load_model(out).effects
    assert (effect.kind, effect.target) == ("payload_mass", "body/pole")
    assert (effect.mass, effect.x, effect.z) == (0.2, 0.0, -0.3)


def test_a_fitted_effect_is_recovered_and_said(pendulum, recorded, capsys):
    made, files = recorded
    status, out = add(pendulum, "coulomb_friction", "--at", "joint/hinge", "--fit", *files)
    assert status == 0
    (effect,) = load_model(out).effects
    assert effect.torque == pytest.approx(made.parameters["torque"], rel=0.05)
    printed = capsys.readouterr().out
    assert f"torque = {effect.torque:.4g} N m (95 %: " in printed
    assert "no effect" not in printed and "bound" not in printed
    before, after = printed.rpartition("spread: ")[2].split()[0:3:2]
    assert float(after) < 0.3 * float(before)


def test_a_size_that_may_be_none_is_said(pendulum, recorded, capsys):
    made, files = recorded
    friction = ["--at", "joint/hinge", "--set", f"torque={made.parameters['torque']}"]
    _, card = add(pendulum, "coulomb_friction", *friction)
    more, fit = ["torque_offset", "--at", "joint/hinge"], ["--fit", *files]
    assert cli.main(["add", str(card), *more, *fit, "--out", str(card.with_name("two.toml"))]) == 0
    assert "); it may as well be no effect" in capsys.readouterr().out


def test_a_size_at_its_bound_is_said(pendulum, recorded, capsys):
    """Commands that count the other way ask for a gain below 0, which no motor has."""
    table = pd.read_csv(recorded[1][0])
    turned = pendulum.parent / "turned.csv"
    table.assign(**{"ctrl.motor": -table["ctrl.motor"]}).to_csv(turned, index=False)
    arguments = ["motor_gain", "--at", "actuator/motor", "--fit", str(turned)]
    assert add(pendulum, *arguments)[0] == 0
    printed = capsys.readouterr().out
    assert "scale = 0.1 (95 %: " in printed
    assert "); it is at its lower bound, so the recordings ask for something else" in printed


def test_a_peak_above_a_friction_that_is_given_is_fitted(pendulum, recorded, capsys):
    """Below the friction in motion it is not felt, and would seem not to be excited."""
    made, files = recorded
    coulomb = f"coulomb={made.parameters['torque']:.4g}"
    arguments = ["stribeck_friction", "--at", "joint/hinge", "--set", coulomb, "--fit", *files]
    assert add(pendulum, *arguments)[0] == 0
    assert "static = " in capsys.readouterr().out


@pytest.mark.parametrize(("after", "says_so"), [(0.1, False), (0.21, True)])
def test_an_error_that_does_not_fall_is_said(after, says_so):
    sized = Sized(ViscousDamping("joint/hinge"), {}, 1.0, 0.2, after)
    assert ("it did not fall" in sized.change) == says_so


def test_a_second_effect_keeps_the_first(pendulum):
    _, first = add(pendulum, "viscous_damping", "--at", "joint/hinge", "--set", "coefficient=0.1")
    second = pendulum.parent / "second.toml"
    arguments = ["torque_offset", "--at", "joint/hinge", "--set", "torque=-0.2"]
    assert cli.main(["add", str(first), *arguments, "--out", str(second)]) == 0
    assert [e.kind for e in load_model(second).effects] == ["viscous_damping", "torque_offset"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            ["coulomb_fricton", "--at", "joint/hinge", "--set", "torque=1"],
            "did you mean coulomb_friction",
        ),
        (["coulomb_fricton", "--at", "joint/hinge"], "did you mean coulomb_friction"),
        (["coulomb_friction", "--at", "joint/hing", "--set", "torque=1"], "did you mean hinge?"),
        (["coulomb_friction", "--at", "hinge", "--set", "torque=1"], "acts on joint/NAME"),
        (["coulomb_friction", "--at", "joint/hinge", "--set", "torqe=1"], "did you mean torque?"),
        (["coulomb_friction", "--at", "joint/hinge", "--set", "torque"], "expected NAME=VALUE"),
        (["coulomb_friction", "--at", "joint/hinge", "--set", "torque=x"], "expected NAME=VALUE"),
        (
            ["payload_mass", "--at", "body/pole", "--set", "mass=1", "--set", "mass=2"],
            "--set gives mass twice; expected it once",
        ),
        (["coulomb_friction", "--at", "joint/hinge", "--set", "torque=nan"], "finite number"),
        (
            ["coulomb_friction", "--at", "joint/hinge", "--set", "torque=-1"],
            "torque = -1 is outside its bounds, 0 to 50 N m",
        ),
        (["coulomb_friction", "--at", "joint/hinge"], "needs a size: give --set NAME=VALUE"),
        (["coulomb_friction", "--at", "joint/hinge", "--fit", "no.csv"], "there is no file no.csv"),
    ],
)
def test_refusals(pendulum, capsys, arguments, said):
    status, out = add(pendulum, *arguments)
    assert status == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert not out.exists()


def test_what_is_there_is_kept_without_force(pendulum, capsys):
    arguments = ["viscous_damping", "--at", "joint/hinge", "--set", "coefficient=0.1"]
    _, out = add(pendulum, *arguments)
    before = out.read_text()
    again = ["add", str(pendulum), *arguments[:-1], "coefficient=0.2", "--out", str(out)]
    assert cli.main(again) == 2
    assert "exists already: give --force to replace it" in capsys.readouterr().err
    assert out.read_text() == before
    assert cli.main([*again, "--force"]) == 0
    assert "0.2" in out.read_text()


def test_an_effect_is_not_added_twice(pendulum, capsys):
    arguments = ["viscous_damping", "--at", "joint/hinge", "--set", "coefficient=0.1"]
    _, out = add(pendulum, *arguments)
    assert cli.main(["add", str(out), *arguments, "--out", str(out), "--force"]) == 2
    assert "has viscous_damping at joint/hinge already" in capsys.readouterr().err
    assert len(load_model(out).effects) == 1


def test_one_gear_is_between_a_motor_and_its_joint(tmp_path, capsys):
    """Each takes the motor's inertia off its joint."""
    (tmp_path / "arm.xml").write_text(models.ARM)
    model = load_model(tmp_path / "arm.xml")
    card = str(save_card(tmp_path / "arm.toml", model, [Backlash("joint/elbow", gap=0.01)]))
    arguments = ["joint_flexibility", "--at", "joint/elbow", "--set", "stiffness=20"]
    assert cli.main(["add", card, *arguments, "--out", str(tmp_path / "both.toml")]) == 2
    said = "has backlash at joint/elbow already; it is that or joint_flexibility at joint/elbow"
    assert said in capsys.readouterr().err
    for name, is_offered in (("arm.xml", True), ("arm.toml", False)):
        offered = make_candidates(load_model(tmp_path / name))
        places = {(effect.kind, effect.target) for effect in offered}
        assert (("joint_flexibility", "joint/elbow") in places) == is_offered


def test_a_card_elsewhere_is_refused_before_the_fit(pendulum, recorded, tmp_path, capsys):
    arguments = ["coulomb_friction", "--at", "joint/hinge", "--fit", *recorded[1]]
    out = tmp_path / "new.toml"
    assert cli.main(["add", str(pendulum), *arguments, "--out", str(out)]) == 2
    assert "a card may not leave its folder" in capsys.readouterr().err
    assert not out.exists()


def test_nothing_left_to_fit_is_refused(pendulum, recorded, capsys):
    arguments = ["coulomb_friction", "--at", "joint/hinge", "--set", "torque=1"]
    status, out = add(pendulum, *arguments, "--fit", *recorded[1])
    assert status == 2
    assert "every parameter is set" in capsys.readouterr().err
    assert not out.exists()


def test_what_recordings_do_not_excite_is_refused_and_not_written(pendulum, recorded, capsys):
    still = pendulum.parent / "still.csv"
    rng, time = np.random.default_rng(0), np.arange(300) * 0.008
    columns = [time, *(rng.normal(size=(2, 300)) * [[1e-4], [1e-3]]), 0.0 * time]
    header = "time,qpos.hinge,qvel.hinge,ctrl.motor"
    np.savetxt(still, np.stack(columns, 1), "%.8g", ",", header=header, comments="")
    status, out = add(pendulum, "motor_gain", "--at", "actuator/motor", "--fit", str(still))
    assert status == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert "do not excite motor_gain at actuator/motor: its scale changes no signal" in line
    assert "record what identifies it: commands of several sizes" in line
    assert not out.exists()


def test_one_parameter_that_is_not_excited_stays_at_no_effect(pendulum, recorded, capsys):
    arguments = ["payload_mass", "--at", "body/pole", "--set", "x=0", "z=-0.3"]
    status, out = add(pendulum, *arguments, "--fit", *recorded[1])
    assert status == 0
    (effect,) = load_model(out).effects
    assert effect.y == 0.0  # along the axis
    printed = capsys.readouterr().out
    assert "y = 0: it stays at no effect, the recordings do not excite it" in printed
    assert "mass = " in printed and "do not tell" not in printed


def test_what_is_not_set_keeps_what_the_model_has(tmp_path):
    path = tmp_path / "slider.xml"
    contact = 'solref="0.03 0.4"'
    path.write_text(
        models.SLIDER.replace('solref="0.03 1"', contact).replace(
            '<geom name="floor"', f'<geom name="floor" {contact}'
        )
    )
    setting = ("contact_compliance", "--at", "geom/ball", "--set", "time_constant=0.05")
    status, out = add(path, *setting)
    assert status == 0
    (effect,) = load_model(out).effects
    assert float(effect.time_constant) == 0.05
    assert float(effect.damping_ratio) == pytest.approx(0.4)


def test_the_card_is_written_before_anything_is_said_of_it(pendulum, monkeypatch):
    def fail(message):
        raise BrokenPipeError(message)

    monkeypatch.setattr(commands, "say", fail)
    with pytest.raises(BrokenPipeError):
        add(pendulum, "viscous_damping", "--at", "joint/hinge", "--set", "coefficient=0.1")
    assert load_model(pendulum.parent / "new.toml").effects
