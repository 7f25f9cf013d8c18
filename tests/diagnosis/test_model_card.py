"""Model cards: what is read and written, and each refusal in the words that the user sees."""

import pytest

from garat_jax import (
    Recording,
    add,
    compare,
    diagnose,
    diagnose_conditions,
    export_mjcf,
    improve,
    plan,
)
from garat_jax.diagnosis.model_card import load_model, save_card
from garat_jax.dynamics import Override
from garat_jax.effects import CATALOGUE, Backlash
from garat_jax.errors import UserError
from tests import models

CARD = """
format = "garat-model/1"
mjcf = "arm.xml"
[[override]]
element = "body"
name = "forearm"
field = "mass"
value = 1.3
[[override]]
element = "option"
field = "timestep"
value = 0.001
[[effect]]
kind = "coulomb_friction"
target = "joint/elbow"
parameters = { torque = 0.25 }
"""
FRICTION = CARD[CARD.index("[[effect]]") :]
MASS, STEP = (
    "[[override]]" + table for table in CARD.removesuffix(FRICTION).split("[[override]]")[1:]
)
GEARS = "".join(
    f'[[effect]]\nkind = "{kind}"\ntarget = "joint/elbow"\nparameters = {{ {size} }}\n'
    for kind, size in (("backlash", "gap = 0.01"), ("joint_flexibility", "stiffness = 20.0"))
)


def write(folder, text=CARD):
    (folder / "arm.xml").write_text(models.ARM)
    path = folder / "arm.toml"
    path.write_text(text)
    return path


def test_card_is_compiled_with_overrides_and_effects(tmp_path):
    model = load_model(write(tmp_path))
    assert model.name == "arm"
    assert model.overrides[0] == Override("body", "forearm", "mass", 1.3)
    dynamics = model.compile(engine="mujoco")
    host = dynamics.host.model
    assert host.body("forearm").mass[0] == pytest.approx(1.3)
    assert host.opt.timestep == pytest.approx(0.001)
    assert [effect.kind for effect in dynamics.effects] == ["coulomb_friction"]
    extra = CATALOGUE["viscous_damping"](target="joint/elbow")
    assert len(model.compile("mujoco", [extra]).effects) == 2


def test_mjcf_alone_is_a_model(tmp_path):
    write(tmp_path)
    model = load_model(tmp_path / "arm.xml")
    assert (model.name, model.overrides, model.effects) == ("arm", (), ())


def test_saved_card_reads_back_the_same(tmp_path):
    model = load_model(write(tmp_path))
    extra = CATALOGUE["payload_mass"](target="body/forearm", mass=0.1, x=0.3)
    saved = load_model(save_card(tmp_path / "new.toml", model, [extra]))
    assert saved.overrides == model.overrides
    assert saved.effects == (*model.effects, extra)
    assert saved.mjcf.resolve() == model.mjcf.resolve()


def test_every_effect_survives_saving(tmp_path):
    write(tmp_path)
    model = load_model(tmp_path / "arm.xml")
    host = model.compile("mujoco").host.model
    fitting = [cls for cls in CATALOGUE.values() if cls.targets(host)]
    assert len(fitting) >= len(CATALOGUE) - 2 and Backlash in fitting
    # Gears at one joint exclude each other.
    effects = [cls(target=cls.targets(host)[0]) for cls in fitting if cls is not Backlash]
    assert load_model(save_card(tmp_path / "all.toml", model, effects)).effects == tuple(effects)


CURVE = CARD.replace("coulomb_friction", "motor_curve").replace("joint/elbow", "actuator/elbow")
TABLE = "table = [[0, 0], [1.0, 0.9], [2, 1.5]]"


def test_a_card_carries_the_curve_of_a_motor(tmp_path):
    model = load_model(write(tmp_path, CURVE.replace("torque = 0.25", TABLE)))
    (curve,) = model.effects
    assert curve.table == ((0.0, 0.0), (1.0, 0.9), (2.0, 1.5))
    again = load_model(save_card(tmp_path / "new.toml", model))
    assert again.effects == model.effects
    model.compile("mujoco")


@pytest.mark.parametrize(
    ("table", "said"),
    [
        (
            "[[0, 0], [1, 2, 3]]",
            "motor_curve table has [1, 2, 3]; expected pairs of finite numbers",
        ),
        ("[[0, 0], [1, inf]]", "motor_curve table has [1, inf]; expected pairs"),
        ('"linear"', "motor_curve table has 'linear'; expected pairs"),
        ("[[0, 0], [1, 1], [1, 2]]", "expected [linear torque, torque] from [0, 0] on, the first"),
        ("[[0.5, 0], [1, 1]]", "motor_curve table at actuator/elbow: expected [linear torque"),
        ("[[0, 0], [1, -1]]", "neither below 0, not [[0.0, 0.0], [1.0, -1.0]]"),
    ],
)
def test_a_table_that_is_no_curve_is_refused(tmp_path, table, said):
    path = write(tmp_path, CURVE.replace("torque = 0.25", f"table = {table}"))
    with pytest.raises(UserError) as raised:
        load_model(path)
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)


def test_card_elsewhere_is_refused(tmp_path):
    model = load_model(write(tmp_path))
    other = tmp_path / "other"
    other.mkdir()
    with pytest.raises(UserError, match=r"may not leave its folder, and .* is not in it; write"):
        save_card(other / "new.toml", model)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("garat-model/1", "garat-model/9", "format is 'garat-model/9'; expected 'garat-model/1'"),
        ('format = "garat-model/1"', "", "format is None"),
        ('mjcf = "arm.xml"', "", "mjcf is missing"),
        ('mjcf = "arm.xml"', 'mjfc = "arm.xml"', "unknown key 'mjfc'; did you mean mjcf?"),
        ('"arm.xml"', '"../arm.xml"', "leaves the card's folder; put the model beside it"),
        ('"arm.xml"', '"/etc/arm.xml"', "leaves the card's folder"),
        ('"arm.xml"', '"leg.xml"', "no such model file"),
        ('"arm.xml"', '"arm.toml"', "mjcf = 'arm.toml'; expected an MJCF file (.xml)"),
        ("[[override]]", "[override]", "no valid TOML"),
        ('"forearm"', '"forarm"', "unknown body 'forarm'; did you mean forearm?"),
        ('field = "mass"', 'field = "mas"', "did you mean mass"),
        ('field = "mass"', 'feild = "mass"', "unknown key of an override 'feild'"),
        ("value = 1.3", "", "[[override]] lacks value"),
        ('"coulomb_friction"', '"coulomb"', "unknown effect 'coulomb'"),
        ('"coulomb_friction"', '"coulomb_fricton"', "did you mean coulomb_friction"),
        ("joint/elbow", "joint/elbo", "unknown joint 'elbo'; did you mean elbow?"),
        ("joint/elbow", "body/forearm", "coulomb_friction acts on joint/NAME"),
        ("{ torque =", "{ torqe =", "unknown parameter of coulomb_friction 'torqe'"),
        ("0.25", '"0.25"', "coulomb_friction torque = '0.25'; expected a finite number"),
        ("0.25", "nan", "coulomb_friction torque = nan; expected a finite number"),
        ("parameters = { torque = 0.25 }", "", "[[effect]] lacks parameters"),
        ("value = 1.3", "value = nan", "body/forearm mass = nan; expected a finite number"),
        ("value = 1.3", "value = true", "body/forearm mass = True; expected a finite number"),
        ("[[effect]]", MASS + "[[effect]]", "body/forearm mass is overridden twice; write it once"),
        ("[[effect]]", STEP + "[[effect]]", "option timestep is overridden twice; write it once"),
        ("[[effect]]", FRICTION + "[[effect]]", "is at joint/elbow twice; write it once"),
        (
            "[[effect]]",
            GEARS + "[[effect]]",
            "backlash at joint/elbow and joint_flexibility at joint/elbow exclude each other",
        ),
    ],
)
def test_refusals(tmp_path, old, new, said):
    assert old in CARD
    path = write(tmp_path, CARD.replace(old, new, 1))
    with pytest.raises(UserError) as raised:
        load_model(path)
    assert said in str(raised.value)
    assert str(path.parent) in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_link_out_of_the_folder_is_refused(tmp_path):
    inside = tmp_path / "inside"
    inside.mkdir()
    (tmp_path / "secret.xml").write_text(models.ARM)
    (inside / "arm.xml").symlink_to(tmp_path / "secret.xml")
    (inside / "arm.toml").write_text(CARD)
    with pytest.raises(UserError, match="leaves the card's folder"):
        load_model(inside / "arm.toml")


def test_other_kinds_of_file_are_refused(tmp_path):
    with pytest.raises(UserError, match=r"expected an MJCF file \(.xml\) or a model card"):
        load_model(tmp_path / "arm.urdf")


@pytest.mark.parametrize(
    "use",
    [
        lambda path: Recording.read("run.csv", path),
        lambda path: diagnose(path, []),
        lambda path: compare(path, []),
        lambda path: compare(load_model(path), [], also=[path]),
        lambda path: add(path, "viscous_damping", "joint/elbow", {"coefficient": 0.1}),
        lambda path: improve(path, []),
        lambda path: diagnose_conditions(path, [], {}),
        lambda path: plan(path, "viscous_damping", "coulomb_friction"),
        lambda path: save_card("new.toml", path),
        lambda path: export_mjcf(path, "new.xml"),
    ],
)
def test_a_path_for_a_model_is_refused(tmp_path, use):
    path = str(write(tmp_path))
    with pytest.raises(
        UserError, match=r"expected a model, not '.*'; load_model\(path\) reads one"
    ):
        use(path)
