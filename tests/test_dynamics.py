"""The two engines are one physics, and overrides and effects reach both."""

import functools
import logging
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from garat_jax import dynamics
from garat_jax.dynamics import Override
from garat_jax.effects import (
    CATALOGUE,
    ActuatorDelay,
    AsymmetricFriction,
    PayloadMass,
    RotorInertia,
    ViscousDamping,
)
from garat_jax.engine import _Simulations
from garat_jax.errors import UserError
from garat_jax.setconst import set_const
from tests.models import ARM, MUSCLE, PENDULUM, TUMBLER, showing, spec

SIZES = {
    "viscous_damping": {"coefficient": 0.2},
    "coulomb_friction": {"torque": 0.3},
    "torque_offset": {"torque": -0.4},
    "rotor_inertia": {"inertia": 0.05},
    "motor_gain": {"scale": 0.7},
    "actuator_delay": {"delay": 0.013},
    "asymmetric_friction": {
        "coulomb_positive": 0.3,
        "coulomb_negative": 0.1,
        "viscous_positive": 0.02,
        "viscous_negative": 0.1,
    },
    "stribeck_friction": {"coulomb": 0.1, "static": 0.3, "velocity": 0.3},
    "load_friction": {"ratio": 0.3},
    "quadratic_drag": {"coefficient": 0.1},
    "joint_stiffness": {"stiffness": 2.0, "reference": 0.5},
    "cogging_torque": {"amplitude": 0.2, "periods": 6.0, "phase": 0.4},
    "backlash": {"gap": 0.05},
    "joint_flexibility": {"stiffness": 20.0, "damping": 0.02},
    "motor_deadband": {"width": 0.1},
    "torque_saturation": {"limit": 0.4},
    "back_emf": {"coefficient": 0.2},
    "motor_curve": {"saturation": 0.6, "linear": 0.2},
    "actuator_lag": {"time_constant": 0.02},
    "payload_mass": {"mass": 0.5, "x": 0.1, "y": 0.02, "z": -0.05},
    "com_offset": {"x": 0.05, "y": -0.02, "z": 0.1},
    "air_drag": {"coefficient": 0.8},
    "gravity_scale": {"scale": 0.5},
    "gravity_tilt": {"roll": 0.2, "pitch": -0.3},
    "contact_friction": {"sliding": 0.2},
    "contact_compliance": {"time_constant": 0.05, "damping_ratio": 0.4},
    "encoder_scale": {"scale": 1.1},
    "encoder_offset": {"offset": 0.1},
    "sensor_delay": {"delay": 0.013},
}


CORE = (
    "viscous_damping", "coulomb_friction", "torque_offset", "motor_gain", "actuator_delay",
    "payload_mass", "gravity_scale", "air_drag", "encoder_offset",
)  # fmt: skip
"""Kinds of every sort; MJX compiles each for several seconds, the others when slow tests run."""
WITH_MJX = [pytest.param(k, marks=() if k in CORE else pytest.mark.slow) for k in CATALOGUE]


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True):
        yield


def make(kind: str, nominal: bool = False):
    cls, host = CATALOGUE[kind], spec(showing(kind)).compile()
    target = cls.targets(host)[-1]
    return cls(target=target, **(cls.at(host, target) if nominal else SIZES[kind]))


@functools.partial(jax.jit, static_argnums=(1, 2))  # compiled once for all sizes of an effect
def _simulate(world: dynamics.Dynamics, num_steps: int, num_substeps: int):
    host = world.host.model
    state = dynamics.initial_state(
        world, jnp.asarray(host.qpos0) + 0.3, jnp.linspace(-0.5, 0.5, host.nv)
    )

    def control_step(state, t):
        ctrl = 0.5 * jnp.sin(0.7 * t + jnp.arange(host.nu))
        state = dynamics.step(world, state, ctrl, num_substeps)
        reported = dynamics.sensed(world, state)
        return state, jnp.concatenate([reported.qpos, reported.qvel])

    return jax.lax.scan(control_step, state, jnp.arange(num_steps))[1]


def simulate(world: dynamics.Dynamics, num_steps: int = 40, num_substeps: int = 3) -> np.ndarray:
    """Return the sensed qpos and qvel [num_steps, nq + nv] under a fixed command."""
    return np.asarray(_simulate(world, num_steps, num_substeps))


def compiled(mjcf: str, *effects, engine: str, overrides=()):
    return dynamics.compile(spec(mjcf), overrides, effects, engine)


@pytest.mark.parametrize("kind", WITH_MJX)
def test_both_engines_agree_with_every_effect(kind):
    effect = make(kind)
    mjx, c = (simulate(compiled(showing(kind), effect, engine=e)) for e in ("mjx", "mujoco"))
    np.testing.assert_allclose(mjx, c, rtol=1e-4, atol=2e-5)


def assert_identity_at_nominal_alone(kind: str, engine: str):
    mjcf = showing(kind)
    plain = simulate(compiled(mjcf, engine=engine))[:10]
    nominal = simulate(compiled(mjcf, make(kind, nominal=True), engine=engine))[:10]
    present = simulate(compiled(mjcf, make(kind), engine=engine))[:10]
    np.testing.assert_allclose(nominal, plain, atol=1e-6)
    assert np.abs(present - plain).max() > 1e-3


@pytest.mark.parametrize("kind", CATALOGUE)
def test_an_effect_at_its_nominal_is_the_identity_and_elsewhere_is_not(kind):
    assert_identity_at_nominal_alone(kind, "mujoco")


@pytest.mark.parametrize("kind", WITH_MJX)
def test_in_mjx_too_an_effect_at_its_nominal_is_the_identity(kind):
    assert_identity_at_nominal_alone(kind, "mjx")


def test_a_loop_in_plain_mujoco_gives_the_same_trajectory():
    model = spec(PENDULUM).compile()
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = 0.3, -0.5
    expected = []
    for t in range(20):
        data.ctrl[:] = 0.5 * np.sin(0.7 * t)
        mujoco.mj_step(model, data, 3)
        expected.append([data.qpos[0], data.qvel[0]])
    ours = simulate(compiled(PENDULUM, engine="mujoco"), 20)
    np.testing.assert_allclose(ours, expected, rtol=1e-12)


def test_composed_effects_agree_in_both_engines():
    effects = tuple(make(kind) for kind in ("payload_mass", "actuator_delay", "viscous_damping"))
    mjx, c = (simulate(compiled(ARM, *effects, engine=e)) for e in ("mjx", "mujoco"))
    np.testing.assert_allclose(mjx, c, rtol=1e-4, atol=2e-5)


@pytest.mark.parametrize("engine", ["mjx", "mujoco"])
def test_vmap_over_states_and_parameters_is_a_loop(engine):
    world = compiled(PENDULUM, ViscousDamping("joint/hinge", coefficient=0.1), engine=engine)
    damping = jnp.asarray([0.0, 0.1, 0.5])
    angles = jnp.asarray([0.1, 0.2])

    @jax.jit
    def advance(coefficient, angle):
        changed = world.replace(effects=(world.effects[0].replace(coefficient=coefficient),))
        state = dynamics.initial_state(changed, angle[None], jnp.ones(1))
        return dynamics.step(changed, state, jnp.zeros(1), 5).qvel

    batched = jax.vmap(lambda c: jax.vmap(lambda a: advance(c, a))(angles))(damping)
    looped = jnp.stack([jnp.stack([advance(c, a) for a in angles]) for c in damping])
    np.testing.assert_allclose(batched, looped, rtol=1e-9)
    assert batched[0, 0, 0] > batched[2, 0, 0]


@pytest.mark.parametrize("mjcf", [ARM, TUMBLER, MUSCLE], ids=["arm", "tumbler", "muscle"])
def test_set_const_is_what_mujoco_computes(mjcf):
    from mujoco import mjx

    model = spec(mjcf).compile()
    mass = model.body_mass * np.linspace(1.0, 3.0, model.nbody)
    heavier = mjx.put_model(model).replace(body_mass=jnp.asarray(mass))
    changed = jax.jit(lambda heavier: set_const(heavier, model))(heavier)
    model.body_mass[:] = mass
    mujoco.mj_setConst(model, mujoco.MjData(model))
    weights = ("dof_invweight0", "body_invweight0", "tendon_invweight0")
    for name in ("body_subtreemass", "actuator_acc0", *weights):
        np.testing.assert_allclose(getattr(changed, name), getattr(model, name), rtol=1e-6)


@pytest.mark.parametrize("engine", ["mjx", "mujoco"])
def test_a_payload_is_the_body_that_the_compiler_makes_of_it(engine):
    by_hand = spec(ARM)
    by_hand.body("forearm").add_body(
        pos=[0.3, 0, 0], ipos=[0, 0, 0], mass=0.5, inertia=[1e-9] * 3, explicitinertial=True
    )
    expected = simulate(dynamics.compile(by_hand, engine="mujoco"))
    effect = PayloadMass("body/forearm", mass=0.5, x=0.3)
    np.testing.assert_allclose(
        simulate(compiled(ARM, effect, engine=engine)), expected, rtol=1e-4, atol=2e-5
    )


def test_a_delay_of_whole_control_steps_shifts_the_command():
    delayed = compiled(PENDULUM, ActuatorDelay("all", delay=0.012), engine="mujoco")
    state = dynamics.initial_state(delayed, jnp.zeros(1), jnp.zeros(1))
    states = [state]
    for command in (1.0, 2.0, 3.0):  # held for 6 ms each
        states.append(dynamics.step(delayed, states[-1], jnp.asarray([command]), 3))
    plain = compiled(PENDULUM, engine="mujoco")
    reference = dynamics.initial_state(plain, jnp.zeros(1), jnp.zeros(1))
    for command in (1.0, 1.0, 1.0):  # the third command of 3 arrives two steps later
        reference = dynamics.step(plain, reference, jnp.asarray([command]), 3)
    np.testing.assert_allclose(states[-1].qpos, reference.qpos, rtol=1e-12)


def test_friction_takes_energy_away():
    decay = [
        np.abs(simulate(compiled(PENDULUM, make_hinge(kind, size), engine="mujoco"), 200)[-50:, 1])
        for kind, size in (("viscous_damping", 0.0), ("viscous_damping", 0.1))
    ]
    assert decay[1].max() < decay[0].max()


def make_hinge(kind: str, size: float):
    cls = CATALOGUE[kind]
    return cls("joint/hinge", **{cls.parameters()[0].name: size})


def test_armature_override_and_effect_are_the_same_physics():
    override = compiled(
        PENDULUM, engine="mujoco", overrides=(Override("joint", "hinge", "armature", 0.2),)
    )
    effect = compiled(PENDULUM, RotorInertia("joint/hinge", inertia=0.2), engine="mujoco")
    np.testing.assert_allclose(simulate(override), simulate(effect), rtol=1e-9)


@pytest.mark.parametrize(
    ("effect", "message"),
    [
        (ViscousDamping("joint/hing"), "did you mean hinge"),
        (ViscousDamping("body/pole"), "acts on joint/NAME"),
        (ViscousDamping("joint/free"), "unknown joint"),
    ],
)
def test_a_misplaced_effect_is_refused(effect, message):
    with pytest.raises(UserError, match=message):
        compiled(PENDULUM, effect, engine="mujoco")


def test_a_bad_state_stays_bad_in_both_engines():
    for engine in ("mjx", "mujoco"):
        world = compiled(PENDULUM, engine=engine)
        state = dynamics.initial_state(world, jnp.full(1, jnp.nan), jnp.zeros(1))
        assert np.isnan(dynamics.step(world, state, jnp.zeros(1)).qpos).all()


def test_a_simulation_that_diverges_prints_nothing_and_leaves_no_file(
    tmp_path, monkeypatch, capfd, caplog
):
    monkeypatch.chdir(tmp_path)
    caplog.set_level(logging.DEBUG, "garat_jax.engine")
    world = compiled(PENDULUM, engine="mujoco")
    state = dynamics.initial_state(world, jnp.zeros(1), jnp.full(1, 1e20))
    dynamics.step(world, state, jnp.zeros(1), 4).qvel.block_until_ready()
    assert "unstable" in caplog.text
    assert not [record for record in caplog.records if record.levelno > logging.DEBUG]
    assert capfd.readouterr() == ("", "")
    assert not list(tmp_path.iterdir())


def test_other_warnings_of_mujoco_are_logged_aloud_and_once(monkeypatch, caplog):
    monkeypatch.setattr("garat_jax.engine._warned", set())
    world = compiled(PENDULUM, engine="mujoco")
    state = dynamics.initial_state(world, jnp.zeros(1), jnp.zeros(1))
    for _ in range(2):
        data = mujoco.MjData(world.host.model)
        data.ctrl[:] = np.nan
        mujoco.mj_step(world.host.model, data)
        dynamics.step(world, state, jnp.zeros(1), 4).qvel.block_until_ready()
    (record,) = [record for record in caplog.records if record.name == "garat_jax.engine"]
    assert record.levelno == logging.WARNING and "CTRL" in record.getMessage()


INTERRUPTED = """
import os, signal, threading, time
import jax, jax.numpy as jnp
from garat_jax import dynamics
from garat_jax.env import make_world
from garat_jax.envs.inverted_pendulum import InvertedPendulum
from garat_jax.interrupt import interruptible

world = make_world(InvertedPendulum(), engine="mujoco")
speeds = jnp.zeros((8, 2)).at[4:].set(1e20)  # the first last long, the others diverge after them
states = jax.vmap(lambda v: dynamics.initial_state(world.params, jnp.zeros(2), v))(speeds)
step = jax.jit(jax.vmap(lambda s: dynamics.step(world.params, s, jnp.zeros(1), 30_000)))
run = step.lower(states).compile()

def interrupt():
    for _ in range(60):
        time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

thread = threading.Thread(target=interrupt, daemon=True)
try:
    with interruptible():
        thread.start()
        while True:
            jax.block_until_ready(run(states))
except KeyboardInterrupt:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    print("stopped")
    thread.join()
"""


def test_ctrl_c_while_mujoco_warns_does_not_abort_the_process():
    program = [sys.executable, "-c", INTERRUPTED]
    done = subprocess.run(program, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, "stopped\n"), done.stderr[-1000:]


def test_mujoco_has_a_thread_for_each_core_that_the_process_may_use(monkeypatch):
    model = spec(PENDULUM).compile()
    for cores in ({3}, {1, 3}):
        monkeypatch.setattr(os, "sched_getaffinity", lambda _, cores=cores: cores, raising=False)
        assert _Simulations(model, 8, ()).batch.nthread == len(cores)


def test_the_native_model_is_what_the_engine_steps():
    effects = (PayloadMass("body/forearm", mass=0.5, x=0.3), make("viscous_damping"))
    world = compiled(ARM, *effects, engine="mujoco")
    model = dynamics.native_model(world)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = 0.3, [-0.5, 0.5]
    state = dynamics.initial_state(world, jnp.asarray(data.qpos), jnp.asarray(data.qvel))
    mujoco.mj_step(model, data, 5)
    state = dynamics.step(world, state, jnp.zeros(model.nu), 5)
    np.testing.assert_allclose(state.qpos, data.qpos, rtol=1e-9)
    assert dynamics.view(world).host.body("payload of forearm").mass[0] < 1e-8


def test_the_native_model_has_the_steady_part_of_a_varying_friction():
    effect = AsymmetricFriction("joint/hinge", coulomb_positive=0.3, coulomb_negative=0.1)
    model = dynamics.native_model(compiled(PENDULUM, effect, engine="mujoco"))
    assert model.dof_frictionloss[0] == pytest.approx(0.2)


@pytest.mark.parametrize("driven", [True, False])
def test_many_steps_at_once_are_the_same_as_one_by_one(driven):
    model = spec(PENDULUM)
    if not driven:
        model.delete(model.actuator("motor"))
    kinds = (ViscousDamping("joint/hinge", 0.1), *([ActuatorDelay("all", 0.007)] * driven))
    world = dynamics.compile(model, effects=kinds, engine="mujoco")
    assert dynamics.steps_at_once(world)
    ctrl = jnp.sin(jnp.arange(12.0))[:, None] * jnp.ones(world.host.model.nu)
    start = dynamics.initial_state(world, jnp.asarray([0.4]), jnp.asarray([0.0]))

    def step(state, command):
        state = dynamics.step(world, state, command, 3)
        return state, jnp.concatenate([state.qpos, state.qvel])

    one_by_one = jax.jit(lambda: jax.lax.scan(step, start, ctrl)[1])()
    at_once = jax.jit(lambda: dynamics.trajectory(world, start, ctrl, 3))()
    path = np.concatenate([at_once.qpos, at_once.qvel], axis=1)
    np.testing.assert_allclose(path, one_by_one, atol=1e-12)


def test_kinds_at_one_target_are_pytrees_of_their_own():
    """jit looks programs up by structure: equal structures would run one law for another."""
    structures = [
        jax.tree.structure(effect(target="there", **{p.name: 0.0 for p in effect.parameters()}))
        for effect in CATALOGUE.values()
    ]
    for i, structure in enumerate(structures):
        assert all(structure != other for other in structures[:i])
