"""The where-it-fails map: every regime that is hidden is named, in the units of the joint."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from garat_jax.diagnosis.localise import MUCH, SLOW, MissingTorque, localise, missing_torque
from garat_jax.diagnosis.measurements import Recording
from garat_jax.dynamics import compile, initial_state, native_model, step
from garat_jax.effects import ActuatorDelay, AsymmetricFriction, LoadFriction, QuadraticDrag
from tests import models

TIME = np.linspace(0.0, 10.0, 2001)
COMMAND = 2.0 * np.sin(3.1 * TIME) * np.sin(0.7 * TIME)
CONTACT = np.maximum(np.sin(9.3 * TIME), 0.0)
POSITION = np.sin(5.7 * TIME) / 5.7 + 0.6 * np.sin(2.3 * TIME) / 2.3
SPEED = np.cos(5.7 * TIME) + 0.6 * np.cos(2.3 * TIME)
ACCELERATION = -5.7 * np.sin(5.7 * TIME) - 0.6 * 2.3 * np.sin(2.3 * TIME)
LOAD = np.cos(1.3 * TIME)
USUAL = np.sqrt(np.mean(SPEED**2))
MOTION = np.tanh(SPEED / (0.05 * USUAL))
PARTS = {
    "against or with the motion": (MOTION, "against the motion, at any speed"),
    "at low speed, around reversals": (
        MOTION * (np.abs(SPEED) < SLOW * USUAL),
        "against the motion",
    ),
    "in proportion to the command": (COMMAND, "of the commanded torque"),
    "when the command changes": (np.gradient(COMMAND), "of its change in a sample"),
    "in proportion to the load": (LOAD, "of the model's own load torque"),
    "with position": (POSITION - POSITION.mean(), "N m/rad"),
    "in proportion to the contacts": (CONTACT, "of the model's own contact torque"),
    "when much is commanded": (
        np.sign(COMMAND) * np.maximum(np.abs(COMMAND) - MUCH * np.abs(COMMAND).max(), 0.0),
        f"of the commanded torque beyond {MUCH * np.abs(COMMAND).max():.3g} N m",
    ),
    "drifting with time": (
        TIME / 10.0 - 0.5,
        "from start to end, whatever is commanded",
    ),
    "drifting with time, with the command": (
        (TIME / 10.0 - 0.5) * COMMAND,
        "of the commanded torque from start to end",
    ),
    "in proportion to speed": (SPEED, "against the motion"),
}


def lacking(torque, slides=False) -> MissingTorque:
    columns = (POSITION, SPEED, ACCELERATION, COMMAND, LOAD, CONTACT, torque)
    nothing = np.zeros((len(TIME), 0))
    of_dofs = (c[:, None] for c in columns)
    return MissingTorque(
        ("joint",), (), (slides,), TIME, TIME / 10.0, *of_dofs, nothing, nothing, nothing
    )


@pytest.mark.parametrize("regime", PARTS)
def test_a_hidden_regime_comes_first_with_its_size(regime):
    shape, words = PARTS[regime]
    first = localise(lacking(-0.3 * shape))[0]
    assert (first.signal, first.regime) == ("joint", regime)
    assert first.share == pytest.approx(1.0)
    sign = "" if "against" in words else "-"
    start = f"100 % of the missing torque is at joint, {regime}: {sign}0.3 "
    assert first.evidence.startswith(start)
    assert first.evidence.endswith(words)


@pytest.mark.parametrize(
    ("torque", "at_hinge", "at_slide"),
    [
        (-0.3 * SPEED, "0.3 N m s/rad, against the motion", "0.3 N s/m, against the motion"),
        (
            0.2 * SPEED * np.abs(SPEED),
            "0.2 N m s²/rad², with the motion",
            "0.2 N s²/m², with the motion",
        ),
        (np.full(len(TIME), 0.4), "+0.4 N m whatever", "+0.4 N whatever"),
        (-1.5 * ACCELERATION, "1.5 kg m², against", "1.5 kg, against"),
    ],
)
def test_sizes_have_the_units_of_the_joint(torque, at_hinge, at_slide):
    for slides, words in ((False, at_hinge), (True, at_slide)):
        places = localise(lacking(torque, slides))
        assert any(words in place.evidence for place in places)
        if slides:
            assert not any("rad" in p.evidence or "N m" in p.evidence for p in places)


def test_contacts_and_slides_are_those_of_the_model():
    model = models.spec(models.SLIDER).compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 1000)
    num = 100
    recording = Recording(
        "still.csv", np.arange(num) * 0.01, np.tile(data.qpos, (num, 1)), np.zeros((num, 2)),
        np.zeros((num, 1)), {}, True, ((0, num),), (),
    )  # fmt: skip
    missing = missing_torque(model, [recording])
    assert missing.slides == (True, True)
    weight = 0.5 * 9.81
    np.testing.assert_allclose(missing.contact, [[weight, 0.0]] * len(missing.time), atol=0.05)


def test_time_counts_within_each_recording_whatever_its_clock_says():
    model = models.spec(models.PENDULUM).compile()
    nothing = np.zeros((100, 1))
    time, rest = np.arange(100) * 0.01, (nothing, nothing, nothing, {}, True, ((0, 100),), ())
    made = [Recording("a", time, *rest), Recording("b", 1.7e9 + time, *rest)]
    elapsed = missing_torque(model, made).elapsed
    first, second = np.split(elapsed, 2)
    np.testing.assert_allclose(first, second, atol=1e-6)
    assert 0 < first[0] < 0.1 and 0.9 < first[-1] < 1


def test_few_samples_have_a_place_too():
    model = models.spec(models.PENDULUM).compile()
    nothing = np.zeros((21, 1))
    rest = (nothing, nothing + 1.0, nothing, {}, True, ((0, 21),), ())
    missing = missing_torque(model, [Recording("a", np.arange(21) * 1e-3, *rest)])
    assert len(missing.time) == 1
    assert all(np.isfinite(place.share) for place in localise(missing))


@pytest.mark.parametrize(
    ("effects", "timestep", "most"),
    [
        ((QuadraticDrag("joint/hinge", 0.2), ActuatorDelay("actuator/motor", 0.02)), 0.001, 0.15),
        ((ActuatorDelay("actuator/motor", 0.02),), 0.004, 0.4),
        ((LoadFriction("joint/hinge", 0.5),), 0.001, 0.5),
        ((AsymmetricFriction("joint/hinge", 0.05, 0.3),), 0.001, 0.55),
    ],
    ids=["force and commands", "longer timestep", "friction under load", "friction by direction"],
)
def test_what_effects_of_the_model_give_is_not_missing(effects, timestep, most):
    """Drag is a force and late commands are commands: no field of the compiled model has them.

    Nor has one a friction that varies; and delays last as long whatever the model's timestep.
    """
    spec = models.spec(models.PENDULUM)
    spec.option.timestep = 0.001
    world = compile(spec, (), effects, "mujoco")
    ctrl = np.sign(np.sin(9 * np.arange(1000) * 0.002))[:, None]
    state = initial_state(world, jnp.asarray([0.5]), jnp.zeros(1))

    def advance(state, command):
        return step(world, state, command, 2), jnp.concatenate([state.qpos, state.qvel])

    path = jax.lax.scan(advance, state, jnp.asarray(ctrl, jnp.float32))[1]
    qpos, qvel = np.split(np.asarray(path, float), 2, axis=1)
    rest = (ctrl, {}, True, ((0, 1000),), ())
    made = Recording("made", np.arange(1000) * 0.002, qpos, qvel, *rest)
    spec.option.timestep = timestep
    world, bare = (compile(spec, (), some, "mujoco") for some in (effects, ()))
    there, gone = (missing_torque(native_model(w), [made], w).torque for w in (world, bare))
    assert np.sqrt(np.mean(there**2)) < most * np.sqrt(np.mean(gone**2))


def test_a_place_names_the_direction_of_a_joint_that_has_several():
    model = models.spec(models.TUMBLER).compile()
    num = 100
    qpos, spin = np.tile(model.qpos0, (num, 1)), np.zeros((num, model.nv))
    spin[:, 4] = np.arange(num) * 0.05
    recording = Recording(
        "spinning.csv", np.arange(num) * 0.01, qpos, spin, np.zeros((num, 0)), {}, True,
        ((0, num),), (),
    )  # fmt: skip
    missing = missing_torque(model, [recording])
    turning = missing._replace(torque=missing.torque * (np.arange(model.nv) == 4))
    assert missing.slides[:6] == (True, True, True, False, False, False)
    assert {place.signal for place in localise(turning)} == {"free.4"}


@pytest.mark.parametrize("dropped", [0.2, 0.5])
def test_a_model_lacks_no_torque_where_samples_are_dropped(dropped):
    model = models.spec(models.PENDULUM).compile()
    data = mujoco.MjData(model)
    data.qpos[0] = 1.0
    rows = []
    for _ in range(2000):
        rows.append((data.time, data.qpos[0], data.qvel[0]))
        mujoco.mj_step(model, data)
    time, angle, speed = np.asarray(rows)[np.random.default_rng(0).uniform(size=2000) > dropped].T
    state, ctrl = (angle[:, None], speed[:, None]), np.zeros((len(time), 1))
    made = Recording("made", time, *state, ctrl, {}, True, ((0, len(time)),), ())
    missing = missing_torque(model, [made])
    assert np.sqrt(np.mean(missing.torque**2)) < 0.02 * np.sqrt(np.mean(missing.load**2))
    assert missing.time[-1] == pytest.approx(time[-1], abs=0.05)
