"""What holds for the arm at hand and not in general: wheels, booms, planes, slow drives."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from garat_jax import dynamics
from garat_jax.diagnosis.add import choose_effect
from garat_jax.diagnosis.diagnose import make_candidates
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.model_card import Model
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.screen import Score, screen
from garat_jax.diagnosis.segments import choose_grid, cut
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.diagnosis.starts import settle
from garat_jax.diagnosis.unseen import unseen
from garat_jax.effects import (
    ActuatorLag,
    CoggingTorque,
    ContactCompliance,
    ContactFriction,
    JointFlexibility,
    PayloadMass,
    StribeckFriction,
)
from tests import models
from tests.diagnosis import pendulum
from tests.diagnosis.test_fit import UNIFORM, make_problem, record

ONE_JOINT = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody><body name="link" pos="0 0 1">
    <joint name="hinge" axis="0 1 0" damping="{damping}"/>
    <geom name="link" {geom} contype="0" conaffinity="0"/>
  </body></worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""
WHEEL = ONE_JOINT.format(
    damping=0.005, geom='type="cylinder" euler="90 0 0" size="0.15 0.01" mass="1"'
)
BOOM = ONE_JOINT.format(
    damping=5, geom='type="capsule" fromto="0 0 0 0 0 -1.5" size="0.1" mass="80"'
)
PUCK = """
<mujoco>
  <worldbody><geom name="floor" type="plane" size="5 5 0.1" friction="0.8"/>
  <body name="puck" pos="0 0 0.05">
    <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
    <geom name="box" type="box" size="0.1 0.1 0.05" mass="0.5" friction="0.8"/>
  </body></worldbody>
</mujoco>
"""


def as_model(mjcf: str, effects=()) -> Model:
    return Model("one joint", models.__file__, models.__file__, models.spec(mjcf), effects=effects)


def drive(mjcf: str, size: float, change=lambda spec: None, torque=lambda q: 0.0) -> Recording:
    """Record the one joint under a random command of a size, made at an eighth of the timestep."""
    rng = np.random.default_rng(0)
    spec = models.spec(mjcf)
    change(spec)
    spec.option.timestep /= 8
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[0] = 0.8
    ctrl = size * (rng.uniform(-1, 1, 8)[(UNIFORM / 0.4).astype(int)] + 0.5 * np.sin(9 * UNIFORM))
    states = []
    for command in ctrl:
        states.append([data.qpos[0], data.qvel[0]])
        data.ctrl[0] = command
        for _ in range(16):
            data.qfrc_applied[0] = torque(data.qpos[0])
            mujoco.mj_step(model, data)
    noisy = np.asarray(states) + 1e-3 * rng.normal(size=(len(UNIFORM), 2)) * [1.0, 10.0]
    return pendulum_like(noisy, ctrl)


def pendulum_like(states: np.ndarray, ctrl: np.ndarray) -> Recording:
    return Recording(
        name="made",
        time=UNIFORM,
        qpos=states[:, :1],
        qvel=states[:, 1:],
        ctrl=ctrl[:, None],
        torque={},
        velocity_measured=True,
        spans=((0, len(UNIFORM)),),
        warnings=(),
    )


def screened(mjcf: str, recording: Recording, *kinds: str) -> dict[str, Score]:
    """Return what screening says of some kinds."""
    model = as_model(mjcf)
    chosen = tuple(effect for effect in make_candidates(model) if effect.kind in kinds)
    problem = make_problem([recording], chosen, model=model)
    settled = settle(problem, problem.simulator.base, problem.segments.start)
    return {chosen[score.effect].kind: score for score in screen(problem, settled)}


def test_a_payload_beside_the_axis_of_a_wheel_comes_before_a_displaced_centre_of_mass():
    def add_weight(spec):
        spec.body("link").add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.01, 0, 0], pos=[0.14, 0, 0], mass=0.3
        )

    found = screened(WHEEL, drive(WHEEL, 0.3, add_weight), "payload_mass", "com_offset")
    assert not found["payload_mass"].excluded
    assert found["payload_mass"].possible
    assert found["payload_mass"].share > found["com_offset"].share


def test_only_where_the_centre_of_mass_is_on_the_axis_are_payloads_tried_beside_it():
    wheel, boom = (PayloadMass.starts(models.spec(m).compile(), "body/link") for m in (WHEEL, BOOM))
    assert [sorted(start) for start in boom] == [["mass"]] * 2
    assert {*wheel[2].keys(), *wheel[-1].keys()} == {"mass", "x", "z"}  # y is along the hinge
    assert sorted(start["x"] for start in wheel if "x" in start) == pytest.approx(
        [-0.1065, 0.1065], rel=0.01
    )


def test_a_ripple_of_a_heavy_boom_is_not_too_small_to_be_tried():
    recording = drive(BOOM, 200.0, torque=lambda q: 20.0 * np.sin(4 * q))
    found = screened(BOOM, recording, "cogging_torque", "joint_stiffness")
    assert not found["cogging_torque"].excluded
    assert found["cogging_torque"].share > 0.7
    host = models.spec(BOOM).compile()
    assert CoggingTorque.starts(host, "joint/hinge")[0]["amplitude"] > 1.0
    assert StribeckFriction.starts(host, "joint/hinge")[0]["coulomb"] > 1.0


def test_of_what_acts_alone_the_size_is_told_from_which_the_clearest_would_show():
    noisy = [pendulum.record(lambda spec: None, seed, noise=0.05) for seed in range(2)]
    chosen = tuple(e for e in make_candidates(pendulum.MODEL) if e.kind == "gravity_tilt")
    problem = make_problem(noisy, chosen, model=pendulum.MODEL)
    settled = settle(problem, problem.simulator.base, problem.segments.start)
    (tilt,) = unseen(problem, settled)  # the pendulum moves in the plane of pitch
    assert 0.0 < tilt.up_to < 0.3


@pytest.mark.parametrize("with_gear", [False, True])
@pytest.mark.parametrize("slow", [0.03, 0.1])
def test_a_slow_drive_is_under_way_where_a_segment_begins(slow, with_gear):
    gear = (JointFlexibility("joint/hinge", stiffness=50.0, damping=0.1),) if with_gear else ()
    lag = ActuatorLag("all", time_constant=slow)
    mjcf = models.PENDULUM.replace('damping="', 'armature="0.01" damping="')
    assert mjcf != models.PENDULUM
    model = Model("pendulum", models.__file__, models.__file__, models.spec(mjcf))
    ctrl = record(UNIFORM).ctrl

    def follow(effects):
        world = dynamics.compile(model.spec, (), effects, "mujoco")
        state = dynamics.initial_state(world, jnp.full(1, 0.8), jnp.zeros(1))

        def step(state, command):
            return dynamics.step(world, state, command, 2), jnp.concatenate(
                [state.qpos, state.qvel]
            )

        return np.asarray(jax.jit(lambda s, c: jax.lax.scan(step, s, c)[1])(state, ctrl))

    with jax.enable_x64(True):
        made, fast = pendulum_like(follow((lag, *gear)), ctrl[:, 0]), follow(gear)
    grid = choose_grid([made], 0.002)
    segments = cut([made], grid, 0.4)
    simulator = Simulator(
        Model("pendulum", models.__file__, models.__file__, model.spec, effects=(lag, *gear)),
        (),
        grid,
    )
    problem = Problem(simulator, segments, np.ones(len(segments.start), bool), grid.sample)
    predicted = simulator.predict(np.zeros((1, 0)), segments.start[None], problem.segments)[0]
    error = np.sqrt(np.mean((predicted - segments.measured)[segments.weight > 0] ** 2, axis=0))
    without = np.sqrt(np.mean((fast - np.concatenate([made.qpos, made.qvel], 1)) ** 2, axis=0))
    assert np.all(error < (0.02 if with_gear else 0.01) * without)


@pytest.mark.parametrize("kind", ["contact_friction", "contact_compliance"])
def test_beside_an_effect_on_the_same_contact_no_effect_is_none(kind):
    own = (
        ContactFriction("geom/floor", sliding=0.4),
        ContactCompliance("geom/floor", time_constant=0.02, damping_ratio=0.5),
    )
    card = as_model(PUCK, own)
    nothing = choose_effect(card, kind, "geom/box", {})
    before, after = (
        dynamics.native_model(card.compile("mujoco", more)) for more in ((), [nothing])
    )
    np.testing.assert_allclose(after.pair_friction, before.pair_friction)
    np.testing.assert_allclose(after.pair_solref, before.pair_solref)
