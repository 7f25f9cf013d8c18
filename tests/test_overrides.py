"""Changes of a model before it is compiled: what they reach, and each refusal."""

import mujoco
import numpy as np
import pytest

from garat_jax import dynamics
from garat_jax.dynamics import Override
from garat_jax.effects import ViscousDamping
from garat_jax.errors import UserError
from garat_jax.overrides import load_spec
from tests.models import PENDULUM, spec


def compiled(override: Override):
    return dynamics.compile(spec(PENDULUM), (override,), engine="mujoco").host.model


def test_a_mass_override_scales_the_inertia_with_it():
    before = spec(PENDULUM).compile()
    after = compiled(Override("body", "pole", "mass", 1.8))
    np.testing.assert_allclose(after.body("pole").mass, 1.8)
    np.testing.assert_allclose(after.body("pole").inertia, 3 * before.body("pole").inertia)


@pytest.mark.parametrize("name", ["pole", "tip"])
def test_a_mass_override_is_that_of_the_named_body_where_bodies_are_fused(name):
    tip = '<body name="tip" pos="0 0 -0.5"><geom size="0.05" mass="0.4"/></body></body></worldbody>'
    fused, apart = (spec(PENDULUM.replace("</body></worldbody>", tip)) for _ in range(2))
    fused.compiler.fusestatic = True
    override = (Override("body", name, "mass", 1.8),)
    model, whole = (
        dynamics.compile(each, override, engine="mujoco").host.model for each in (fused, apart)
    )
    assert model.nbody == 2
    np.testing.assert_allclose(whole.body(name).mass, 1.8)
    np.testing.assert_allclose(model.body("pole").mass, whole.body_mass.sum())
    np.testing.assert_allclose(model.dof_M0, whole.dof_M0)


def test_options_that_are_words_in_mjcf_take_the_word_or_the_number():
    for value in ("RK4", 1):
        model = compiled(Override("option", "", "integrator", value))
        assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    cone = compiled(Override("option", "", "cone", "elliptic")).opt.cone
    assert cone == mujoco.mjtCone.mjCONE_ELLIPTIC


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (Override("body", "pool", "mass", 1.0), "did you mean pole"),
        (Override("joint", "hinge", "dampling", 1.0), "did you mean damping"),
        (Override("body", "pole", "mass", -1.0), "must be positive"),
        (
            Override("body", "pole", "mass", "heavy"),
            "pole mass = 'heavy'; expected a finite",
        ),
        (Override("body", "pole", "mass", float("nan")), "body/pole mass = nan; expected a finite"),
        (
            Override("body", "pole", "inertia", [1.0, 2.0]),
            "expected 3 finite numbers",
        ),
        (
            Override("option", "", "integrator", "rk5"),
            "unknown option integrator 'rk5'; did you mean rk4",
        ),
        (
            Override("option", "", "iterations", "many"),
            "iterations = 'many'; expected a whole number",
        ),
        (Override("option", "", "timestep", True), "timestep = True; expected a finite number"),
        (Override("option", "", "iterations", True), "iterations = True; expected a whole number"),
        (Override("option", "", "gravity", [0, 0, True]), "expected 3 finite numbers"),
        (
            Override("joint", "hinge", "range", [0.0, float("inf")]),
            "expected 2 finite numbers",
        ),
        (Override("option", "", "gravity", -9.81), "gravity = -9.81; expected 3 finite numbers"),
        (Override("joint", "hinge", "range", 1.0), "expected 2 finite numbers"),
        (Override("joint", "hinge", "damping", []), "a finite number or 3 finite numbers"),
        (Override("joint", "hinge", "parent", 1.0), "unknown joint field 'parent'"),
        (Override("option", "", "timestep", 0.0), "timestep is 0 s; expected more than 0"),
        (Override("option", "", "timestep", -0.1), "timestep is -0.1 s; expected more than 0"),
        (Override("body", "pole", "add_body", 1.0), "unknown body field 'add_body'"),
        (Override("bodi", "pole", "mass", 1.0), "did you mean body"),
    ],
)
def test_a_wrong_override_is_refused_in_one_line(override, message):
    with pytest.raises(UserError, match=message) as error:
        compiled(override)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("effects", [(), (ViscousDamping("joint/hinge", coefficient=0.1),)])
@pytest.mark.parametrize("more", [(), (Override("body", "pole", "mass", 2.0),)])
def test_overrides_with_which_mujoco_cannot_compile_are_refused_in_one_line(effects, more):
    wrong = Override("joint", "hinge", "limited", 1), Override("joint", "hinge", "range", [1, -1])
    with pytest.raises(UserError, match=r"MuJoCo cannot compile the model: .*range") as error:
        dynamics.compile(spec(PENDULUM), (*wrong, *more), effects, "mujoco")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["mount", "world"])
def test_what_has_no_mass_is_not_scaled(name):
    """A mount carries the arm and has no geom of its own, and the world never moves."""
    mounted = """
    <mujoco><worldbody><geom size="0.1"/><body name="mount">
      <body><joint/><geom size="0.1"/></body>
    </body></worldbody></mujoco>"""
    with pytest.raises(UserError, match=f"body/{name} has no mass to scale; name a body that"):
        Override("body", name, "mass", 1.0).apply(spec(mounted))


def test_what_a_springdamper_decides_is_not_overridden():
    sprung = PENDULUM.replace('name="hinge"', 'name="hinge" springdamper="0.5 1"')
    for field in ("damping", "stiffness"):
        with pytest.raises(UserError, match=f"joint/hinge {field} follows from its springdamper"):
            Override("joint", "hinge", field, 3.0).apply(spec(sprung))
    other = spec(sprung)
    Override("joint", "hinge", "springdamper", (1.0, 1.0)).apply(other)
    assert other.compile().jnt_stiffness[0] < spec(sprung).compile().jnt_stiffness[0]


def test_what_is_true_or_false_takes_that():
    for value in (True, False):
        model = compiled(Override("actuator", "motor", "ctrllimited", value))
        assert model.actuator_ctrllimited[0] == value


def test_a_model_that_may_not_be_read_says_so(tmp_path, monkeypatch):
    path = tmp_path / "pendulum.xml"
    path.write_text(PENDULUM)

    def refuse(*arguments):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(type(path), "open", refuse)  # root may read whatever its mode is
    with pytest.raises(UserError, match=r"pendulum\.xml: Permission denied"):
        load_spec(path)
