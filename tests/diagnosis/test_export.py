"""`garat export`: plain MJCF with the same physics, and words for what MJCF cannot say."""

import dataclasses

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from garat_jax import cli, dynamics
from garat_jax.diagnosis import load_model
from garat_jax.diagnosis.export import copy_model, export_mjcf
from garat_jax.diagnosis.model_card import save_card
from garat_jax.dynamics import Override
from garat_jax.effects import CATALOGUE, JointStiffness, ViscousDamping
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
element = "joint"
name = "elbow"
field = "damping"
value = 0.4
"""
TETRAHEDRON = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
WITH_MESH = """
<mujoco>
  <compiler meshdir="parts"/>
  <asset><mesh name="wedge" file="wedge.obj"/></asset>
  <worldbody><body name="link"><joint name="hinge" axis="0 1 0"/>
    <geom type="mesh" mesh="wedge" mass="0.5"/></body></worldbody>
  <include file="motor.xml"/>
</mujoco>
"""
MOTOR = '<mujoco><actuator><motor name="motor" joint="hinge"/></actuator></mujoco>'


def write(folder, card=CARD):
    (folder / "arm.xml").write_text(models.ARM)
    path = folder / "arm.toml"
    path.write_text(card)
    return path


def ctrl_at(k, num):
    return 0.5 * np.sin(0.1 * k + np.arange(num))


def simulate_plain(path, steps=150):
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    for k in range(steps):
        data.ctrl[:] = ctrl_at(k, model.nu)
        mujoco.mj_step(model, data)
    return data.qpos.copy()


def simulate_card(model, steps=150):
    world = model.compile(engine="mujoco")
    host = world.host.model
    state = dynamics.initial_state(world, jnp.zeros(host.nq), jnp.zeros(host.nv))
    for k in range(steps):
        state = dynamics.step(world, state, jnp.asarray(ctrl_at(k, host.nu), jnp.float32))
    return np.asarray(dynamics.sensed(world, state).qpos)


def test_overrides_are_in_the_exported_file(tmp_path, capsys):
    card, out = write(tmp_path), tmp_path / "elsewhere" / "plain.xml"
    assert cli.main(["export", str(card), "--out", str(out)]) == 0
    assert capsys.readouterr().out == f"MJCF: {out}\n"
    exported = mujoco.MjModel.from_xml_path(str(out))
    assert exported.body("forearm").mass[0] == pytest.approx(1.3)
    assert exported.joint("elbow").damping[0] == pytest.approx(0.4)
    np.testing.assert_allclose(simulate_plain(out), simulate_card(load_model(card)), atol=2e-4)


def test_a_motor_leaves_its_joint_before_other_effects_come(tmp_path):
    model = load_model(write(tmp_path))
    effects = [
        CATALOGUE["rotor_inertia"](target="joint/elbow", inertia=0.02),
        CATALOGUE["joint_flexibility"](target="joint/elbow", stiffness=6.0, damping=0.05),
    ]
    card = load_model(save_card(tmp_path / "geared.toml", model, effects))
    exported = export_mjcf(card, tmp_path / "geared.xml")
    (line,) = exported.unsaid
    assert "the tendon elbow_gear is its spring and damper" in line
    plain = mujoco.MjModel.from_xml_path(str(exported.path))
    armature = {name: plain.joint(name).armature[0] for name in ("elbow", "elbow_motor")}
    assert armature == pytest.approx({"elbow": 0.02, "elbow_motor": 0.01})


ROD = """
<mujoco>
  <compiler {compiler}/>
  <worldbody><body name="rod"><joint name="hinge" axis="0 1 0" armature="0.02"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="1"/>
    <body pos="0 0 -0.4"><geom size="0.03" mass="0.2"/></body></body></worldbody>
  <actuator><position name="servo" joint="hinge" kp="20" dampratio="1"/></actuator>
</mujoco>
"""


@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass'")
@pytest.mark.parametrize(
    "compiler", ["", 'settotalmass="2"', 'boundinertia="0.005"', 'fusestatic="true"']
)
@pytest.mark.parametrize(
    ("kind", "target", "sizes"),
    [
        ("payload_mass", "body/rod", {"mass": 1.0, "z": -0.4}),
        ("com_offset", "body/rod", {"x": 0.05}),
        ("rotor_inertia", "joint/hinge", {"inertia": 0.1}),
        ("motor_gain", "actuator/servo", {"scale": 0.7}),
        ("back_emf", "actuator/servo", {"coefficient": 0.9}),
        ("joint_flexibility", "joint/hinge", {"stiffness": 40.0}),
    ],
)
def test_what_the_compiler_derives_is_that_of_the_card(tmp_path, kind, target, sizes, compiler):
    """Masses that it scales or bounds, and a servo's damping that follows from them."""
    (tmp_path / "rod.xml").write_text(ROD.format(compiler=compiler))
    model = load_model(tmp_path / "rod.xml")
    effect = CATALOGUE[kind](target=target, **sizes)
    card = load_model(save_card(tmp_path / "card.toml", model, [effect]))
    plain = mujoco.MjModel.from_xml_path(str(export_mjcf(card, tmp_path / "out.xml").path))
    host = dynamics.native_model(card.compile(engine="mujoco"))
    if "bound" not in compiler:  # a payload's own body is bounded while the card is compiled
        assert plain.actuator_biasprm[0] == pytest.approx(host.actuator_biasprm[0], rel=1e-4)
    assert plain.body_mass.sum() == pytest.approx(host.body_mass.sum(), rel=1e-4)
    weights = []
    for each in (plain, host):
        data = mujoco.MjData(each)
        data.joint("hinge").qpos[0] = 0.5
        mujoco.mj_forward(each, data)
        weights.append(data.joint("hinge").qfrc_bias[0])
    assert weights[0] == pytest.approx(weights[1], rel=1e-4)


def push(folder, effects, mjcf=models.ARM):
    """Torque of the exported elbow's motor at rest, without a command, and what is left unsaid."""
    (folder / "model.xml").write_text(mjcf)
    model = load_model(folder / "model.xml")
    exported = export_mjcf(
        load_model(save_card(folder / "card.toml", model, effects)), folder / "out.xml"
    )
    plain = mujoco.MjModel.from_xml_path(str(exported.path))
    data = mujoco.MjData(plain)
    mujoco.mj_forward(plain, data)
    return data.qfrc_actuator[plain.joint("elbow").dofadr[0]], exported.unsaid


def test_what_else_is_at_a_joint_stays_where_it_is_when_its_encoder_counts_from_elsewhere(tmp_path):
    model = load_model(write(tmp_path))
    effects = [
        CATALOGUE["encoder_offset"](target="joint/elbow", offset=0.4),
        CATALOGUE["joint_stiffness"](target="joint/elbow", stiffness=2.0, reference=0.5),
        CATALOGUE["torque_offset"](target="joint/elbow", torque=0.3),
    ]
    card = load_model(save_card(tmp_path / "with.toml", model, effects))
    exported = export_mjcf(card, tmp_path / "with.xml")
    assert not exported.unsaid
    np.testing.assert_allclose(simulate_plain(exported.path), simulate_card(card), atol=3e-4)


def test_an_offset_is_whole_whatever_the_motor_lost(tmp_path):
    offset = CATALOGUE["torque_offset"](target="joint/elbow", torque=1.0)
    gain = CATALOGUE["motor_gain"](target="actuator/elbow", scale=0.5)
    assert push(tmp_path, [offset, gain]) == (pytest.approx(1.0), ())


def test_an_offset_that_a_limit_would_cut_is_said(tmp_path):
    offset = CATALOGUE["torque_offset"](target="joint/elbow", torque=1.0)
    limit = CATALOGUE["torque_saturation"](target="actuator/elbow", limit=0.5)
    clamped = models.ARM.replace('armature="0.01"', 'armature="0.01" actuatorfrcrange="-0.5 0.5"')
    for torque, unsaid in (push(tmp_path, [offset, limit]), push(tmp_path, [offset], clamped)):
        assert torque == 0.0
        assert "no unlimited actuator" in unsaid[0]


def test_delays_add_up(tmp_path):
    model = load_model(write(tmp_path))
    delay = CATALOGUE["actuator_delay"]
    effects = [delay(target="all", delay=0.03), delay(target="actuator/elbow", delay=0.011)]
    card = load_model(save_card(tmp_path / "late.toml", model, effects))
    plain = mujoco.MjModel.from_xml_path(str(export_mjcf(card, tmp_path / "late.xml").path))
    assert plain.actuator_delay.tolist() == pytest.approx([0.03, 0.041])
    assert plain.actuator_history[:, 0].tolist() == [17, 23]


def test_an_exported_payload_may_have_another(tmp_path):
    payload = CATALOGUE["payload_mass"](target="body/forearm", mass=0.2)
    model = load_model(write(tmp_path))
    for number in ("1", "2"):
        card = load_model(save_card(tmp_path / f"{number}.toml", model, [payload]))
        model = load_model(export_mjcf(card, tmp_path / f"{number}.xml").path)
    plain = mujoco.MjModel.from_xml_path(str(model.path))
    assert plain.body("forearm_payload").mass[0] == plain.body("forearm_payload_2").mass[0] == 0.2
    with pytest.raises(UserError, match="a payload_mass at body/forearm already"):
        dataclasses.replace(model, effects=(payload, payload)).compile()


def test_a_motor_takes_a_name_that_is_free(tmp_path):
    taken = models.ARM.replace('name="upper"', 'name="elbow_motor"')
    tendon = '<fixed name="elbow_gear"><joint joint="elbow" coef="1"/></fixed>'
    taken = taken.replace("<actuator>", f"<tendon>{tendon}</tendon><actuator>")
    flexible = CATALOGUE["joint_flexibility"](target="joint/elbow", stiffness=6.0)
    push(tmp_path, [flexible], taken)
    plain = mujoco.MjModel.from_xml_path(str(tmp_path / "out.xml"))
    assert plain.joint("elbow_motor_2").type[0] == mujoco.mjtJoint.mjJNT_HINGE
    stiffness = plain.tendon_stiffness[plain.tendon("elbow_gear_2").id]
    assert np.ravel(stiffness)[0] == pytest.approx(6.0)


@pytest.mark.slow  # a program a kind; tests/effects has the kinds one by one
@pytest.mark.parametrize("kind", CATALOGUE)
def test_what_mjcf_can_say_is_the_same_physics(tmp_path, kind):
    model = load_model(write(tmp_path))
    host = model.compile("mujoco").host.model
    cls = CATALOGUE[kind]
    if not (targets := cls.targets(host)):
        pytest.skip(f"{kind} has no place on this arm")
    target = targets[-1]
    effect = cls(target=target, **cls.starts(host, target)[-1])
    card = load_model(save_card(tmp_path / "with.toml", model, [effect]))
    exported = export_mjcf(card, tmp_path / "with.xml")
    if exported.unsaid:
        (line,) = exported.unsaid
        assert kind in line
        assert "\n" not in line
    else:
        expected = simulate_card(card)
        assert np.abs(expected - simulate_card(model)).max() > 1e-6
        np.testing.assert_allclose(simulate_plain(exported.path), expected, atol=3e-4)


def test_what_mjcf_cannot_say_is_printed(tmp_path, capsys):
    model = load_model(write(tmp_path))
    delay = CATALOGUE["actuator_delay"](target="all", delay=0.01)
    card = save_card(tmp_path / "late.toml", model, [delay])
    assert cli.main(["export", str(card), "--out", str(tmp_path / "late.xml")]) == 0
    first, last = capsys.readouterr().out.splitlines()
    assert first.startswith("not in MJCF: ")
    assert "actuator_delay at all" in first
    assert last == f"MJCF: {tmp_path / 'late.xml'}"


def with_mesh(folder):
    (folder / "parts").mkdir(parents=True)
    (folder / "parts" / "wedge.obj").write_text(TETRAHEDRON)
    (folder / "motor.xml").write_text(MOTOR)
    path = folder / "link.xml"
    path.write_text(WITH_MESH)
    return path


@pytest.mark.parametrize("where", [".", "below", "../beside"])
def test_meshes_are_found_and_includes_are_part_of_the_file(tmp_path, where):
    model = load_model(with_mesh(tmp_path / "model"))
    folder = tmp_path / "model" / where
    folder.mkdir(exist_ok=True)
    exported = mujoco.MjModel.from_xml_path(str(export_mjcf(model, folder / "plain.xml").path))
    assert (exported.nmesh, exported.nu) == (1, 1)
    assert exported.body("link").mass[0] == pytest.approx(0.5)


def test_a_copied_model_has_all_its_files(tmp_path):
    model = load_model(with_mesh(tmp_path / "model"))
    copied = copy_model(model, tmp_path / "copy")
    assert mujoco.MjModel.from_xml_path(str(copied)).nu == 1
    assert sorted(p.name for p in (tmp_path / "copy").rglob("*.*")) == [
        "link.xml", "motor.xml", "wedge.obj",
    ]  # fmt: skip


def test_a_model_that_needs_files_elsewhere_is_copied_once_it_is_exported_above_them(tmp_path):
    path = with_mesh(tmp_path / "model")
    (tmp_path / "model" / "parts" / "wedge.obj").rename(tmp_path / "wedge.obj")
    path.write_text(WITH_MESH.replace('"wedge.obj"', '"../../wedge.obj"'))
    with pytest.raises(UserError, match="outside its folder, so it cannot be copied") as refused:
        copy_model(load_model(path), tmp_path / "copy")
    command = str(refused.value).partition("garat ")[2].removesuffix(" writes").split()
    assert cli.main(command) == 0
    copied = copy_model(load_model(command[-1]), tmp_path / "copy")
    assert mujoco.MjModel.from_xml_path(str(copied)).nmesh == 1


@pytest.mark.parametrize(
    ("out", "said"),
    [("arm.xml", "exists already: give --force"), ("plain.txt", "a name that ends in .xml")],
)
def test_refusals(tmp_path, capsys, out, said):
    card = write(tmp_path)
    assert cli.main(["export", str(card), "--out", str(tmp_path / out)]) == 2
    assert said in capsys.readouterr().err


def test_the_model_itself_is_not_written_over(tmp_path, capsys):
    write(tmp_path)
    path = str(tmp_path / "arm.xml")
    assert cli.main(["export", path, "--out", path, "--force"]) == 2
    assert "is what the model is made of" in capsys.readouterr().err


def test_the_mjcf_of_a_card_is_not_written_over(tmp_path, capsys):
    card, path = write(tmp_path), tmp_path / "arm.xml"
    before = path.read_text()
    assert cli.main(["export", str(card), "--out", str(path), "--force"]) == 2
    assert "is what the model is made of" in capsys.readouterr().err
    assert path.read_text() == before
    assert (tmp_path / "arm.xml").read_text() == models.ARM


def test_an_override_that_mjcf_does_not_know_is_refused(tmp_path):
    model = load_model(write(tmp_path))
    bad = Override("joint", "elbow", "dampin", 1.0)
    with pytest.raises(UserError, match="did you mean damping"):
        export_mjcf(
            type(model)(model.name, model.path, model.mjcf, model.spec, (bad,)),
            tmp_path / "x.xml",
        )


@pytest.mark.parametrize(
    "effect",
    [
        ViscousDamping("joint/hinge", coefficient=0.2),
        JointStiffness("joint/hinge", stiffness=2.0, reference=0.3),
    ],
    ids=["damping", "stiffness"],
)
def test_what_is_added_to_a_springdamper_stays(tmp_path, effect):
    mjcf = tmp_path / "sprung.xml"
    mjcf.write_text(models.PENDULUM.replace('name="hinge"', 'name="hinge" springdamper="0.5 1"'))
    model = load_model(mjcf)
    card = load_model(save_card(tmp_path / "with.toml", model, [effect]))
    exported = export_mjcf(card, tmp_path / "with.xml")
    assert not exported.unsaid
    expected = simulate_card(card)
    assert np.abs(expected - simulate_card(model)).max() > 1e-3
    np.testing.assert_allclose(simulate_plain(exported.path), expected, atol=3e-4)
