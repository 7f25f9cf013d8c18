"""Effects on contacts reach the contacts, in both engines and in both directions."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from garat_jax import dynamics
from garat_jax.effects import ContactCompliance, ContactFriction
from garat_jax.effects.contact import can_any_touch, partners
from garat_jax.errors import UserError
from tests.models import ARM, SLIDER, TUMBLER, spec

PAIRED = """
<mujoco><worldbody>
  <geom type="plane" size="5 5 0.1" friction="1.2" margin="0.002" solref="0.04 1"
        adhesion="2"/>
  <geom name="ice" type="box" size="1 1 0.1" pos="3 0 0" friction="0.1" priority="2"/>
  <body name="puck" pos="0 0 0.0995"><freejoint/>
    <geom name="ball" size="0.1" condim="4" friction="0.4" margin="0.001" solmix="3"
          adhesion="5"/>
    <body pos="0 0 0.25"><joint/><geom name="hat" size="0.1"/></body></body>
  <body name="other" pos="0 3 0.3"><freejoint/><geom name="rock" size="0.1"/></body></worldbody>
  <contact><pair geom1="ball" geom2="rock" friction="0.7 0.7 0.1 0.1 0.1"/></contact></mujoco>
"""


def test_the_pairs_that_are_named_are_those_that_mujoco_would_make():
    model = spec(PAIRED)
    host = model.compile()
    ball = host.geom("ball").id
    assert partners(host, ball) == [0, 1]  # not its child, not the rock, which has a pair
    assert partners(host, host.geom("hat").id) == [0, 1, host.geom("rock").id]
    assert not ContactFriction.targets(spec(ARM).compile())
    with pytest.raises(UserError, match="can touch another"):
        ContactFriction("geom/upper_arm").check(spec(ARM).compile())


def test_where_no_contact_can_be_nothing_can_touch():
    assert can_any_touch(
        spec(
            PAIRED.replace("<contact>", "<contact><!--").replace("</contact>", "--></contact>")
        ).compile()
    )
    assert not can_any_touch(spec(ARM).compile())
    alone = spec(PAIRED)
    for geom in alone.geoms:
        geom.contype = geom.conaffinity = 0
    assert can_any_touch(alone.compile())  # the named pair
    disabled = spec(PAIRED)
    disabled.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    assert not can_any_touch(disabled.compile())


def test_no_effect_is_what_the_model_has():
    host = spec(PAIRED).compile()
    assert ContactFriction.at(host, "geom/ball") == {"sliding": 1.2}
    assert ContactFriction.at(host, "geom/ice") == {"sliding": 0.1}
    assert ContactCompliance.at(host, "geom/ball") == pytest.approx(
        {"time_constant": 0.75 * 0.02 + 0.25 * 0.04, "damping_ratio": 1.0}
    )
    sizes = [start["sliding"] for start in ContactFriction.starts(host, "geom/ice")]
    assert sizes == pytest.approx([0.05, 0.07, 0.14, 0.2])


def test_a_named_contact_has_the_numbers_of_an_unnamed_one():
    effect = ContactFriction("geom/ball", sliding=1.2)
    plain = spec(PAIRED).compile()
    named = dynamics.compile(spec(PAIRED), effects=(effect,), engine="mujoco").host.model
    contacts = []
    for model in (plain, named):
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        assert data.ncon == 1
        contacts.append(data.contact)
    for name in ("friction", "solref", "solimp", "dim", "includemargin", "dist", "adhesion"):
        np.testing.assert_allclose(*(getattr(c, name) for c in contacts), err_msg=name)


FUSED = """
<mujoco><compiler fusestatic="%s"/><worldbody><geom name="floor" type="plane" size="1 1 0.1"/>
  <body pos="0 0 1"><freejoint/><geom name="trunk" size="0.1"/>
    <body pos="0 0 -0.2"><geom name="pad" size="0.05"/></body>
    <body pos="0 0 -0.1"><joint/><geom name="foot" size="0.04" pos="0 0 -0.2"/></body></body>
  <body pos="1 0 0"><geom name="wall" type="box" size="0.1 0.1 1" friction="0.2"/></body>
  <body pos="0 2 1"><freejoint/><geom size="0.1" friction="2"/></body></worldbody></mujoco>
"""


@pytest.mark.parametrize("fuses", ["false", "true"])
def test_the_geoms_of_bodies_that_are_fused_are_not_mistaken_for_others(fuses):
    effect = ContactFriction("geom/foot", sliding=1.0)
    host = dynamics.compile(spec(FUSED % fuses), effects=(effect,), engine="mujoco").host.model
    exported = spec(FUSED % fuses)
    effect.export(exported)
    plain = exported.compile()
    for model, stone in ((host, 2.0), (plain, 1.0)):
        pairs = zip(model.pair_geom1, model.pair_geom2, model.pair_friction[:, 0], strict=True)
        found = {frozenset(model.geom(g).name for g in (a, b)): mu for a, b, mu in pairs}
        assert found == {
            frozenset({"foot", "floor"}): stone / 2,
            frozenset({"foot", "wall"}): stone / 2,
            frozenset({"foot", "nameless geom 5"}): stone,
        }


def test_geoms_that_the_compiler_discards_make_no_pairs():
    shell = '<geom type="box" size="0.1 0.1 0.1" contype="0" conaffinity="0" mass="0"/>'
    seen = PAIRED.replace("<freejoint/>", f"<freejoint/>{shell}")
    seen = seen.replace("<worldbody>", '<compiler discardvisual="true"/><worldbody>')
    effect = ContactFriction("geom/ball", sliding=0.6)
    exported = spec(seen)
    effect.export(exported)
    host = dynamics.compile(spec(seen), effects=(effect,), engine="mujoco").host.model
    for model in (host, exported.compile()):
        assert (model.ngeom, model.npair) == (5, 3)


def stopping(sliding: float, engine: str, geoms=("ball",)) -> float:
    """Return how far a puck at 1 m/s slides in 0.1 s."""
    effects = tuple(ContactFriction(f"geom/{name}", sliding=sliding) for name in geoms)
    model = spec(SLIDER)
    model.body("puck").pos = [0, 0, 0.0998]
    world = dynamics.compile(model, effects=effects, engine=engine)
    state = dynamics.initial_state(world, jnp.zeros(2), jnp.asarray([0.0, 1.0]))
    return float(dynamics.step(world, state, jnp.zeros(1), 50).qpos[1])


@pytest.mark.parametrize("engine", [pytest.param("mjx", marks=pytest.mark.slow), "mujoco"])
def test_friction_acts_below_and_above_that_of_the_floor(engine):
    with jax.enable_x64(True):
        travelled = [stopping(sliding, engine) for sliding in (0.1, 0.6, 1.0)]
        assert travelled == pytest.approx([0.1 - 0.5 * mu * 9.81 * 0.01 for mu in (0.1, 0.6, 1.0)],
                                          abs=2e-3)  # fmt: skip
        both = stopping(0.3, engine, ("ball", "floor"))
        assert both == pytest.approx(stopping(0.15, engine), abs=1e-6)  # halved twice


@pytest.mark.parametrize("engine", [pytest.param("mjx", marks=pytest.mark.slow), "mujoco"])
def test_a_contact_is_as_soft_as_it_is_told(engine):
    def depth(time_constant):
        effect = ContactCompliance("geom/brick", time_constant=time_constant, damping_ratio=1.0)
        world = dynamics.compile(spec(TUMBLER), effects=(effect,), engine=engine)
        qpos = jnp.asarray(world.host.model.qpos0).at[2].set(0.03)
        state = dynamics.initial_state(world, qpos, jnp.zeros(world.host.model.nv))
        return 0.03 - float(dynamics.step(world, state, jnp.zeros(0), 250).qpos[2])

    with jax.enable_x64(True):
        hard, model, soft = (depth(value) for value in (0.01, 0.02, 0.04))
    assert 2 < model / hard < 8
    assert 2 < soft / model < 8
