"""Traps of real recordings: late stamps, late commands, encoder steps, velocities here and there.

None of them is to be taken for friction or mass, and none is to hide what is missing.
"""

import dataclasses

import numpy as np
import pytest

from garat_jax import CATALOGUE
from garat_jax.diagnosis import Recording, diagnose
from garat_jax.diagnosis.filters import quantum
from garat_jax.diagnosis.quality import assess
from tests.diagnosis.pendulum import MODEL, add_damping, record

KINDS = (
    "viscous_damping",
    "coulomb_friction",
    "motor_gain",
    "rotor_inertia",
    "actuator_delay",
)
MODEL_OF_FEW = dataclasses.replace(MODEL, catalogue={kind: CATALOGUE[kind] for kind in KINDS})
HOST = MODEL.compile(engine="mujoco").host.model
DAMPING = 0.05


@pytest.fixture(scope="module")
def clean() -> list[Recording]:
    return [record(lambda spec: None, seed) for seed in (1, 2, 3)]


@pytest.fixture(scope="module")
def damped() -> list[Recording]:
    return [record(lambda spec: add_damping(spec, DAMPING), seed) for seed in (1, 2, 3)]


def rows(r: Recording, states: slice, times: slice) -> Recording:
    """Return a recording whose states are those of other rows than its times and commands."""
    time = r.time[times]
    return dataclasses.replace(
        r,
        time=time,
        ctrl=r.ctrl[times],
        qpos=r.qpos[states],
        qvel=r.qvel[states],
        spans=((0, len(time)),),
    )


def stamped_late(r: Recording) -> Recording:
    """Each state has the stamp of the sample after it."""
    return rows(r, slice(None, -1), slice(1, None))


def commanded_late(r: Recording, samples: int) -> Recording:
    """Each command was logged some samples before it acted."""
    kept = slice(None, len(r.time) - samples)
    ahead = rows(r, kept, kept)
    return dataclasses.replace(ahead, ctrl=r.ctrl[samples:])


def quantised(r: Recording, step: float) -> Recording:
    return dataclasses.replace(r, qpos=np.round(r.qpos / step) * step)


def explain(recordings):
    found = diagnose(MODEL_OF_FEW, recordings[:2], recordings[2:])
    sizes = {c.effect: next(iter(c.parameters.values())).estimate for c in found.selected}
    return found, sizes


def test_a_timestamp_one_step_late_is_a_delay_of_one_step(clean):
    late = [stamped_late(r) for r in clean]
    assert assess(late[0], HOST).command_lag["motor"] == pytest.approx(0.004, abs=5e-4)
    found, sizes = explain(late)
    assert found.verdict == "missing_effect"
    assert sizes == {"actuator_delay": pytest.approx(0.004, rel=0.05)}


def test_a_command_delay_of_30_ms_does_not_hide_the_damping(damped):
    late = [commanded_late(r, 8) for r in damped]
    assert assess(late[0], HOST).command_lag["motor"] == pytest.approx(0.032, abs=1e-3)
    found, sizes = explain(late)
    assert found.verdict == "missing_effect"
    assert sizes == {
        "viscous_damping": pytest.approx(DAMPING, rel=0.05),
        "actuator_delay": pytest.approx(0.032, rel=0.05),
    }


def test_the_steps_of_an_encoder_are_no_effect_and_hide_none(clean, damped):
    step = 2 * np.pi / 1024
    coarse, rough = ([quantised(r, step) for r in part] for part in (clean, damped))
    assert quantum(coarse[0].qpos[:, 0]) == pytest.approx(step)
    found, sizes = explain(coarse)
    assert (found.verdict, sizes) == ("adequate", {})
    found, sizes = explain(rough)
    assert found.verdict == "missing_effect"
    assert sizes == {"viscous_damping": pytest.approx(DAMPING, rel=0.05)}


@pytest.mark.parametrize("without", [1, 2], ids=["fitted", "held out"])
def test_a_recording_without_velocities_is_diagnosed_beside_others(damped, without):
    mixed = list(damped)
    mixed[without] = dataclasses.replace(damped[without], velocity_measured=False)
    found, sizes = explain(mixed)
    assert found.verdict == "missing_effect"
    assert sizes == {"viscous_damping": pytest.approx(DAMPING, rel=0.05)}
    listed = {"qpos.hinge", "qvel.hinge"} if without == 1 else {"qpos.hinge"}
    assert set(found.error.per_signal) == listed


@pytest.mark.parametrize("gain", [1.0, 0.8])
def test_commands_that_the_model_clamps_hide_no_gain(gain):
    """Most are beyond the range of 3 N m either way; what they then give is the gain's, too."""

    def weaken(spec):
        spec.actuator("motor").gainprm[0] *= gain

    made = [
        record(weaken, seed, control=lambda t, *_, k=seed: 9.0 * np.sin((15.0 + k) * t))
        for seed in (1, 2, 3)
    ]
    assert np.mean(np.abs(made[0].ctrl) > 3.0) > 0.7
    found, sizes = explain(made)
    assert found.verdict == ("adequate" if gain == 1.0 else "missing_effect")
    assert sizes == ({} if gain == 1.0 else {"motor_gain": pytest.approx(gain, rel=0.05)})


def test_what_the_timestep_does_to_quiet_recordings_is_no_effect():
    """It passes every test of significance as a delay of a part of the timestep, and is none."""
    found, sizes = explain([record(lambda spec: None, seed, noise=1e-6) for seed in (1, 2, 3)])
    assert found.error.integrator_exceeds_noise
    assert (found.verdict, sizes) == ("adequate", {})
