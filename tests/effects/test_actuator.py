"""Actuator laws against closed forms, and limits that survive."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from garat_jax import dynamics
from garat_jax.effects import (
    CATALOGUE,
    ActuatorDelay,
    ActuatorLag,
    BackEmf,
    Backlash,
    Effect,
    JointStiffness,
    MotorCurve,
    MotorDeadband,
    MotorGain,
    TorqueSaturation,
    unit_at,
)
from garat_jax.effects.actuator import MINITAUR_CURVE
from garat_jax.errors import UserError
from tests.effects.truth import RIG, SERVO, commands, predict
from tests.models import MUSCLE, PENDULUM, SLIDER, spec

MOTOR = "actuator/motor"


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True):
        yield


def torques(mjcf: str, effects: tuple[Effect, ...], ctrl, angle=0.0, speed=0.0) -> np.ndarray:
    """Return the actuator's torque at the joint for each command, from C MuJoCo, N m."""
    world = dynamics.compile(spec(mjcf), effects=effects, engine="mujoco")
    view, model = dynamics.view(world), dynamics.native_model(world)
    data = mujoco.MjData(model)
    found = []
    for command in ctrl:
        acting = jnp.asarray([command])
        for effect in world.effects:
            acting = effect.apply(view, None, acting, effect.init(model))[0]
        data.qpos[0], data.qvel[0], data.ctrl[:] = angle, speed, np.asarray(acting)
        mujoco.mj_forward(model, data)
        found.append(data.qfrc_actuator[0])
    return np.asarray(found)


def test_the_minitaur_table_is_reproduced():
    wide = RIG.replace("-3 3", "-9 9")
    linear, given = np.transpose(MINITAUR_CURVE)
    both = np.concatenate([linear, -linear]) / 2.0  # gear 2
    got = torques(wide, (MotorCurve(MOTOR, table=MINITAUR_CURVE),), both)
    np.testing.assert_allclose(got, np.concatenate([given, -given]), atol=1e-12)
    np.testing.assert_allclose(linear, np.arange(0, 61, 10) * 0.1)


def test_two_numbers_come_near_the_minitaur_table():
    linear, given = np.transpose(MINITAUR_CURVE)
    effect = MotorCurve(MOTOR, saturation=4.0, linear=0.9)
    got = torques(RIG.replace("-3 3", "-9 9"), (effect,), linear / 2.0)
    np.testing.assert_allclose(got, given, atol=0.05 * given.max())


def test_a_curve_is_straight_then_level():
    effect = MotorCurve(MOTOR, saturation=2.0, linear=1.0)
    got = torques(RIG, (effect,), [0.2, 0.5, -0.5, 3.0, 30.0])
    np.testing.assert_allclose(got[:3], [0.4, 1.0, -1.0])
    assert got[3] == pytest.approx(2.0, abs=0.01)
    assert got[4] == got[3]  # the command was clamped first


def test_a_limit_is_at_the_joint_and_the_tighter_one_holds():
    tight = RIG.replace('gear="2"', 'gear="2" forcerange="-0.2 0.6"')
    commands = [-3.0, -0.1, 0.1, 3.0]
    for mjcf, expected in ((RIG, [-0.7, -0.2, 0.2, 0.7]), (tight, [-0.4, -0.2, 0.2, 0.7])):
        got = torques(mjcf, (TorqueSaturation(MOTOR, limit=0.7),), commands)
        np.testing.assert_allclose(got, expected)


def test_a_gain_moves_the_limit_with_it():
    limited = RIG.replace('gear="2"', 'gear="2" forcerange="-0.2 0.6"')
    got = torques(limited, (MotorGain(MOTOR, scale=0.5),), [-3.0, 0.1, 3.0])
    np.testing.assert_allclose(got, [-0.2, 0.1, 0.6])


@pytest.mark.parametrize("mjcf", [RIG, SERVO], ids=["motor", "servo"])
def test_back_emf_is_in_joint_units_and_adds_to_a_servo(mjcf):
    plain, with_emf = (
        torques(mjcf, effects, [0.5], 0.1, 2.0) for effects in ((), (BackEmf(MOTOR, 0.3),))
    )
    np.testing.assert_allclose(with_emf - plain, -0.6)


def at_a_site(mjcf: str) -> str:
    """Let the slider's motor push a site along the same axis in place of the joint."""
    site = '<body name="puck" pos="0 0 -0.2005"><site name="middle"/>'
    moved = mjcf.replace('<body name="puck" pos="0 0 -0.2005">', site)
    return moved.replace('joint="along"', 'site="middle" gear="3 0 0 0 0 0"')


@pytest.mark.parametrize("engine", ["mujoco", "mjx"])
@pytest.mark.parametrize(
    "effect",
    [
        MotorGain("actuator/push", 0.8),
        TorqueSaturation("actuator/push", limit=2.0),
        BackEmf("actuator/push", 0.5),
        MotorCurve("actuator/push", saturation=2.5, linear=1.0),
        BackEmf("actuator/push"),  # at its nominal
        MotorCurve("actuator/push"),
    ],
    ids=lambda effect: effect.kind,
)
def test_a_law_at_a_site_is_that_at_the_joint(engine, effect):
    at_joint = SLIDER.replace('joint="along"', 'joint="along" gear="3"')
    sites = (
        at_a_site(SLIDER)
        .replace("3 0 0 0 0 0", "0 0 3 0 0 0")
        .replace("<site name=", '<site euler="0 90 0" name=')
    )
    commands = 1.5 * jnp.sin(0.3 * jnp.arange(20.0))[:, None]

    def path(mjcf: str) -> np.ndarray:
        world = dynamics.compile(spec(mjcf), effects=(effect,), engine=engine)

        def step(state, command):
            state = dynamics.step(world, state, command, 5)
            return state, jnp.concatenate([state.qpos, state.qvel])

        start = dynamics.initial_state(world, jnp.zeros(2), jnp.zeros(2))
        return np.asarray(jax.jit(lambda: jax.lax.scan(step, start, commands)[1])())

    expected = path(at_joint)
    assert np.all(np.isfinite(expected))
    assert np.ptp(expected[:, 1]) > 0.01
    for mjcf in (at_a_site(SLIDER), sites):
        np.testing.assert_allclose(path(mjcf), expected, atol=1e-6)


@pytest.mark.parametrize(
    "effect", [TorqueSaturation("actuator/push", 2.0), BackEmf("actuator/push", 0.5)]
)
def test_a_law_at_a_site_is_exported_as_that_at_the_joint(effect):
    models = []
    for mjcf in (SLIDER.replace('joint="along"', 'joint="along" gear="3"'), at_a_site(SLIDER)):
        exported = spec(mjcf)
        effect.export(exported)
        models.append(exported.compile())
    for field in ("actuator_forcerange", "actuator_biasprm"):
        np.testing.assert_allclose(getattr(models[1], field), getattr(models[0], field))
        assert np.all(np.isfinite(getattr(models[1], field)))


def test_a_lag_is_the_mean_of_the_exact_solution():
    world = dynamics.compile(spec(RIG), effects=(ActuatorLag("all", 0.01),), engine="mujoco")
    effect, view = world.effects[0], dynamics.view(world)
    memory, acting = effect.init(world.host.model), []
    for command in (1.0, 2.0, 2.0, 2.0):
        ctrl, _, memory = effect.apply(view, None, jnp.asarray([command]), memory)
        acting.append(float(ctrl[0]))
    fine = np.linspace(0.0, 0.006, 6001)
    exact = 2.0 - np.exp(-fine / 0.01)
    means = [exact[i : i + 2001].mean() for i in (0, 2000, 4000)]
    np.testing.assert_allclose(acting, [1.0, *means], atol=1e-5)


def test_a_command_beyond_its_range_is_late_as_it_acts():
    """Between two substeps the mean of what acts counts: a half of 3, not the 3 that 5 becomes."""
    world = dynamics.compile(spec(RIG), effects=(ActuatorDelay("all", 0.003),), engine="mujoco")
    effect, view = world.effects[0], dynamics.view(world)
    memory, acting = effect.init(world.host.model), []
    for command in (0.0, 10.0, 10.0, 10.0):
        ctrl, _, memory = effect.apply(view, None, jnp.asarray([command]), memory)
        acting.append(float(ctrl[0]))
    np.testing.assert_allclose(acting, [0.0, 0.0, 1.5, 3.0])


def test_springs_add_up_to_one():
    own = RIG.replace('armature="0.01"', 'armature="0.01" stiffness="2" springref="30"')
    effect = JointStiffness("joint/hinge", stiffness=3.0, reference=-0.4)
    model = dynamics.native_model(dynamics.compile(spec(own), effects=(effect,), engine="mujoco"))
    data = mujoco.MjData(model)
    for angle in (-1.0, 0.2):
        data.qpos[0] = angle
        mujoco.mj_forward(model, data)
        expected = -2.0 * (angle - np.pi / 6) - 3.0 * (angle + 0.4)
        np.testing.assert_allclose(data.qfrc_spring, expected)


@pytest.mark.parametrize("effect", [MotorDeadband(MOTOR, 0.1), MotorCurve(MOTOR, 1.0)])
def test_laws_of_motors_are_refused_at_servos(effect):
    with pytest.raises(UserError, match="force is its gain times the command"):
        dynamics.compile(spec(SERVO), effects=(effect,))


def test_laws_with_a_threshold_start_within_the_range_of_the_model():
    host = spec(RIG).compile()
    limits = [start["limit"] for start in TorqueSaturation.starts(host, MOTOR)]
    assert max(limits) < 6.0  # gear 2, commands up to 3
    assert len(limits) > 2
    assert all(0 < s["width"] < 3.0 for s in MotorDeadband.starts(host, MOTOR))


@pytest.mark.parametrize("cls", [TorqueSaturation, MotorCurve])
def test_limits_are_suggested_within_the_torque_that_the_recordings_ask_for(cls):
    rng = np.random.default_rng(0)
    torque = rng.normal(size=5000)  # beyond 1.64 in 10 % of the samples
    limits = [next(iter(s.values())) for s in cls.suggested_by_commands(torque / 70, torque).starts]
    shares = [float(np.mean(np.abs(torque) > limit)) for limit in limits]
    assert min(shares) < 0.1 < max(shares)
    assert max(shares) > 0.6
    held = cls.suggested_by_commands(np.ones(100), np.full(100, -2.0))
    assert len(held.starts) == held.num_tried == 1
    assert 1.5 < next(iter(held.starts[0].values())) < 2.0
    assert cls.suggested_by_commands(np.zeros(9), np.zeros(9)).starts == ()


def test_dead_bands_are_suggested_within_the_commands():
    small = 0.02 * np.sin(np.arange(1000.0))
    widths = [s["width"] for s in MotorDeadband.suggested_by_commands(small, 2 * small).starts]
    assert len(widths) > 2
    assert all(0 < width < 0.5 * 0.02 for width in widths)
    assert MotorDeadband.suggested_by_commands(np.zeros(9), np.zeros(9)).starts == ()


def test_play_is_suggested_within_the_travel():
    travel = 0.004 * np.sin(np.arange(1000.0))
    gaps = [s["gap"] for s in Backlash.suggested(travel, travel, travel[None]).starts]
    assert len(gaps) == 2
    assert all(0 < gap < 0.004 for gap in gaps)
    assert Backlash.suggested(np.full(9, 0.3), np.zeros(9), np.zeros((1, 9))).starts == ()


@pytest.mark.parametrize(
    ("kind", "at_hinge", "at_slide"),
    [
        ("back_emf", ["N m s/rad"], ["N s/m"]),
        ("torque_saturation", ["N m"], ["N"]),
        ("motor_curve", ["N m", "N m"], ["N", "N"]),
        ("motor_gain", ["1"], ["1"]),
        ("actuator_delay", ["s"], ["s"]),
    ],
)
def test_an_actuator_has_the_units_of_what_it_drives(kind, at_hinge, at_slide):
    turning = at_a_site(SLIDER).replace("3 0 0 0 0 0", "0 0 0 3 0 0")
    for mjcf, target, units in (
        (PENDULUM, MOTOR, at_hinge),
        (SLIDER, "actuator/push", at_slide),
        (at_a_site(SLIDER), "actuator/push", at_slide),
        (turning, "actuator/push", at_hinge),
    ):
        host = spec(mjcf).compile()
        assert [unit_at(p, host, target) for p in CATALOGUE[kind].parameters()] == units


def test_a_muscle_has_no_gain_in_proportion_to_its_numbers():
    changed = spec(MUSCLE)
    changed.actuators[0].name = "biceps"
    host = changed.compile()
    assert MotorGain.targets(host) == BackEmf.targets(host) == []
    assert TorqueSaturation.targets(host) == ["actuator/biceps"]
    with pytest.raises(UserError, match="fixed or affine, as no muscle's are"):
        MotorGain("actuator/biceps", scale=1.5).check(host)
    assert MotorGain.targets(spec(SERVO).compile()) == [MOTOR]


@pytest.mark.parametrize("kind", ["motor_deadband", "motor_curve", "actuator_lag", "load_friction"])
def test_commands_are_clamped_where_the_model_clamps_them_only(kind):
    """A law at its nominal changes nothing, where commands go beyond their range, either."""
    mjcf = RIG.replace('<option timestep="0.002"/>', NEVER_CLAMPS)
    target = "joint/hinge" if kind == "load_friction" else "actuator/motor"
    plain, same = (
        predict(mjcf, effects, commands(9.0)) for effects in ((), (CATALOGUE[kind](target),))
    )
    np.testing.assert_allclose(same, plain, atol=1e-4)
    clamped = predict(RIG, (), commands(9.0))
    assert np.abs(clamped - plain).max() > 0.1


NEVER_CLAMPS = '<option timestep="0.002"><flag clampctrl="disable"/></option>'
