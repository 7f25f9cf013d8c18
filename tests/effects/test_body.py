"""Effects at bodies and of the world: closed forms, and what the compiler may not undo."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from garat_jax import dynamics
from garat_jax.dynamics import Override
from garat_jax.effects import AirDrag, ComOffset, ContactFriction, GravityTilt, PayloadMass
from garat_jax.effects.base import ModelView
from garat_jax.errors import UserError
from tests.models import ARM, SLIDER, TUMBLER, spec

FALLING = """
<mujoco><option timestep="0.002"/><worldbody><body name="stone" pos="0 0 9">
  <joint name="down" type="slide" axis="0 0 1"/><geom size="0.1" mass="0.5"/>
</body></worldbody></mujoco>
"""
LOOSE = """
<mujoco><compiler %s/><worldbody><body name="ball" pos="0 0 9"><freejoint name="free"/>
  <geom size="0.1" mass="0.5"/>
  <geom type="box" size="0.1 0.05 0.02" mass="0.5"/></body></worldbody></mujoco>
"""


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True):
        yield


def after(world, num_substeps: int, qvel=None):
    host = world.host.model
    qvel = jnp.zeros(host.nv) if qvel is None else jnp.asarray(qvel)
    state = dynamics.initial_state(world, jnp.asarray(host.qpos0), qvel)
    step = jax.jit(dynamics.step, static_argnums=3)
    return step(world, state, jnp.zeros(host.nu), num_substeps)


def test_air_drag_ends_in_the_terminal_velocity():
    world = dynamics.compile(
        spec(FALLING), effects=(AirDrag("body/stone", coefficient=0.8),), engine="mujoco"
    )
    assert after(world, 1500).qvel[0] == pytest.approx(-np.sqrt(0.5 * 9.81 / 0.8), rel=1e-4)


@pytest.mark.parametrize("mjcf", [ARM, TUMBLER], ids=["arm", "tumbler"])
def test_air_drag_pulls_at_the_centre_of_mass_as_mujocos_jacobian_says(mjcf):
    model = spec(mjcf).compile()
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    data.qpos[:] = rng.normal(size=model.nq)
    mujoco.mj_normalizeQuat(model, data.qpos)
    data.qvel[:] = rng.normal(size=model.nv)
    mujoco.mj_forward(model, data)
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jacBodyCom(model, data, jacobian, None, model.nbody - 1)
    velocity = jacobian @ data.qvel
    expected = -0.3 * np.linalg.norm(velocity) * jacobian.T @ velocity
    state = dynamics.PhysicsState(
        *(jnp.zeros(0),), jnp.asarray(data.qpos), jnp.asarray(data.qvel), *(jnp.zeros(0),) * 3, ()
    )
    effect = AirDrag(f"body/{model.body(model.nbody - 1).name}", coefficient=0.3)
    view = ModelView(model, lambda name: jnp.asarray(getattr(model, name)))
    force = effect.apply(view, state, jnp.zeros(model.nu), ())[1]
    np.testing.assert_allclose(force, expected, rtol=1e-9, atol=1e-12)


def test_air_drag_at_rest_has_a_derivative():
    world = dynamics.compile(spec(FALLING), effects=(AirDrag("body/stone"),), engine="mjx")

    def speed(coefficient):
        changed = world.replace(effects=(world.effects[0].replace(coefficient=coefficient),))
        return after(changed, 5).qvel[0]

    assert np.isfinite(jax.jvp(speed, (0.1,), (1.0,))[1])


@pytest.mark.parametrize(("pitch", "sliding", "slides"), [(0.5, 0.3, True), (0.2, 0.5, False)])
def test_a_puck_slides_down_an_inclined_plane(pitch, sliding, slides):
    model = spec(SLIDER)
    model.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    model.body("puck").pos = [0, 0, 0.0999]
    effects = (GravityTilt("world", pitch=pitch), ContactFriction("geom/ball", sliding=sliding))
    speed = after(dynamics.compile(model, effects=effects, engine="mujoco"), 500).qvel[1]
    expected = -9.81 * (np.sin(pitch) - sliding * np.cos(pitch)) * 1.0
    assert speed == pytest.approx(expected if slides else 0.0, rel=0.02, abs=0.02)


@pytest.mark.parametrize("engine", ["mjx", "mujoco"])
@pytest.mark.parametrize(
    "options", ["", 'fusestatic="true"', 'boundinertia="0.001" boundmass="0.2"']
)
@pytest.mark.parametrize("mass", [0.0, 0.3])
def test_a_payload_survives_what_the_compiler_does(options, mass, engine):
    model = spec(LOOSE % options)
    effect = PayloadMass("body/ball", mass=mass, x=0.1)
    found = after(dynamics.compile(model, effects=(effect,), engine=engine), 50, np.arange(6.0))
    if mass:
        model.body("ball").add_geom(size=[1e-3, 0, 0], pos=[0.1, 0, 0], mass=mass)
    expected = after(dynamics.compile(model, engine="mujoco"), 50, np.arange(6.0))
    np.testing.assert_allclose(found.qvel, expected.qvel, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("engine", ["mjx", "mujoco"])
def test_a_com_offset_is_an_inertial_that_lies_elsewhere(engine):
    model = spec(LOOSE % "")
    effect = ComOffset("body/ball", x=0.02, z=-0.03)
    found = after(dynamics.compile(model, effects=(effect,), engine=engine), 50, np.arange(6.0))
    compiled = model.copy().compile().body("ball")
    body = model.body("ball")
    body.explicitinertial = True
    body.mass, body.inertia, body.iquat = compiled.mass[0], compiled.inertia, compiled.iquat
    body.ipos = compiled.ipos + np.asarray([0.02, 0, -0.03])
    expected = after(dynamics.compile(model, engine="mujoco"), 50, np.arange(6.0))
    np.testing.assert_allclose(found.qvel, expected.qvel, rtol=1e-4, atol=1e-4)


def test_a_mocap_body_does_not_move_by_itself():
    host = spec("""
    <mujoco><worldbody><body name="wall"><geom size="0.1"/></body>
      <body name="guide" mocap="true"><geom size="0.1"/>
        <body name="mount"><geom size="0.1"/></body>
        <body name="arm"><joint/><geom size="0.1"/>
          <body name="hand"><geom size="0.1"/></body></body></body></worldbody></mujoco>
    """).compile()
    for kind in (PayloadMass, ComOffset, AirDrag):
        assert kind.targets(host) == ["body/arm", "body/hand"]


@pytest.mark.parametrize("options", ["", 'inertiafromgeom="true"'])
def test_a_mass_override_reaches_a_body_with_both_inertial_and_geoms(options):
    model = spec(LOOSE % options)
    body = model.body("ball")
    body.explicitinertial, body.mass, body.inertia = True, 2.0, [0.1, 0.1, 0.1]
    before = model.copy().compile().body("ball")
    override = Override("body", "ball", "mass", 3.0)
    after = dynamics.compile(model, (override,), engine="mujoco").host.model.body("ball")
    np.testing.assert_allclose(after.mass, 3.0)
    np.testing.assert_allclose(after.inertia, before.inertia * 3.0 / before.mass)


def test_a_mass_override_that_the_compiler_undoes_is_refused():
    override = Override("body", "ball", "mass", 0.05)
    with pytest.raises(UserError, match=r"mass is 0\.2 kg whatever"):
        dynamics.compile(spec(LOOSE % 'boundmass="0.2"'), (override,), engine="mujoco")
