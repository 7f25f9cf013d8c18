"""Friction holds at rest and takes energy away, and special laws contain the plain one."""

import hypothesis
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import strategies as st

from garat_jax import dynamics
from garat_jax.effects import (
    AsymmetricFriction,
    CoulombFriction,
    LoadFriction,
    QuadraticDrag,
    StribeckFriction,
)
from tests.effects.truth import RIG, SUBSTEPS, commands, predict
from tests.models import spec

JOINT = "joint/hinge"
FREE = RIG.replace(' damping="0.01"', "")
SIZES = st.floats(0.0, 2.0)


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True):
        yield


def energy(path: np.ndarray) -> np.ndarray:
    """Return the rig's energy along (angle, speed) [T, 2], J."""
    model = spec(FREE).compile()
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    data = mujoco.MjData(model)
    energies = []
    for angle, speed in path:
        data.qpos[0], data.qvel[0] = angle, speed
        mujoco.mj_forward(model, data)
        energies.append(data.energy.sum())
    return np.asarray(energies)


@hypothesis.settings(max_examples=10, deadline=None)
@hypothesis.given(SIZES, SIZES, st.floats(1e-3, 2.0), st.floats(-1.5, 1.5), st.floats(-8.0, 8.0))
@pytest.mark.parametrize("kind", [AsymmetricFriction, StribeckFriction, QuadraticDrag])
def test_friction_never_adds_energy(kind, first, second, velocity, angle, speed):
    values = {
        AsymmetricFriction: {
            "coulomb_positive": first,
            "coulomb_negative": second,
            "viscous_positive": second,
            "viscous_negative": velocity,
        },
        StribeckFriction: {"coulomb": first, "static": second, "velocity": velocity},
        QuadraticDrag: {"coefficient": first},
    }[kind]
    still = np.zeros(100)
    with jax.enable_x64(True):
        start = np.array([[angle, speed]])
        braked = predict(FREE, (kind(JOINT, **values),), still, start[0])
        loose = predict(FREE, (), still, start[0])
    wobble = np.ptp(energy(np.concatenate([start, loose])))  # the integrator's own
    assert np.all(energy(braked) <= energy(start)[0] + wobble + 1e-3)


def test_no_load_and_no_motion_stay_so():
    still = np.zeros(100)
    for effect in (
        AsymmetricFriction(JOINT, coulomb_positive=0.5, coulomb_negative=0.1),
        StribeckFriction(JOINT, coulomb=0.1, static=0.5),
    ):
        path = predict(FREE, (effect,), still, (0.0, 0.0))
        assert np.abs(path).max() == 0.0


def test_a_joint_sticks_below_the_friction_of_its_direction_and_slips_above():
    effect = AsymmetricFriction(JOINT, coulomb_positive=0.6, coulomb_negative=0.2)
    for command, slips in ((0.25, False), (-0.25, True), (-0.08, False), (0.35, True)):
        path = predict(FREE, (effect,), np.full(100, command), (0.0, 0.0))  # gear 2
        assert (np.abs(path[-1, 0]) > 0.02) == slips, command


def test_equal_friction_in_both_directions_and_at_rest_is_coulomb_friction():
    ctrl = commands(0.5)
    plain = predict(RIG, (CoulombFriction(JOINT, torque=0.2),), ctrl)
    for effect in (
        AsymmetricFriction(JOINT, coulomb_positive=0.2, coulomb_negative=0.2),
        StribeckFriction(JOINT, coulomb=0.2, static=0.2),
        StribeckFriction(JOINT, coulomb=0.2, static=0.0),
    ):
        np.testing.assert_allclose(predict(RIG, (effect,), ctrl), plain, atol=1e-9)


@pytest.mark.parametrize("timestep", [5e-4, 2e-3, 1e-2])
def test_load_friction_is_stable_and_slows_a_driven_joint(timestep):
    mjcf = RIG.replace("0.002", str(timestep))
    ctrl = np.full(100, 0.3)
    easy = predict(mjcf, (), ctrl, (0.0, 0.0))
    stiff = predict(mjcf, (LoadFriction(JOINT, ratio=0.3),), ctrl, (0.0, 0.0))
    locked = predict(mjcf, (LoadFriction(JOINT, ratio=1.0),), ctrl, (0.0, 0.0))
    assert np.abs(stiff[:, 0]).max() < 0.95 * np.abs(easy[:, 0]).max()
    assert np.abs(locked[:, 1]).max() < 0.02 * np.abs(easy[:, 1]).max()


@pytest.mark.parametrize(
    "effect",
    [
        AsymmetricFriction(JOINT, 0.03, 0.01, 0.005, 0.002),
        StribeckFriction(JOINT, coulomb=0.01, static=0.03, velocity=0.5),
        LoadFriction(JOINT, ratio=0.1),
    ],
)
def test_along_the_path_that_it_leads_to_a_varying_friction_does_the_same(effect):
    ctrl, start = 0.3 * np.sin(np.arange(120) * 0.15), np.array([0.1, 0.0])
    path, bare = predict(RIG, (effect,), ctrl, start), predict(RIG, (), ctrl, start)
    whole = np.concatenate([start[None], path])
    world = dynamics.compile(spec(RIG), effects=(effect,), engine="mujoco")
    given = world.replace(effects=tuple(e.along_path() for e in world.effects))
    state = dynamics.initial_state(given, jnp.asarray(start[:1]), jnp.asarray(start[1:]))
    seen = jnp.asarray((whole[:-1] + whole[1:]) / 2)
    found = dynamics.trajectory(given, state, jnp.asarray(ctrl)[:, None], SUBSTEPS, along=seen)
    found = np.concatenate([found.qpos, found.qvel], axis=1)
    assert np.sum(np.diff(np.sign(path[:, 1])) != 0) >= 2
    change, along = (path - bare).T, (found - bare).T
    for one, other in zip(change, along, strict=True):
        assert one @ other > 0.98 * np.linalg.norm(one) * np.linalg.norm(other)
        assert np.linalg.norm(other) == pytest.approx(np.linalg.norm(one), rel=0.2)
