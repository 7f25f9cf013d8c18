"""Programs are compiled for the candidates that act, and agree where these do nothing."""

import dataclasses
from collections.abc import Sequence
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from garat_jax.diagnosis.diagnose import make_candidates
from garat_jax.diagnosis.fit import fit
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.model_card import Model
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.segments import choose_grid, cut
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.dynamics import Override, native_model
from garat_jax.effects import (
    ActuatorDelay,
    ActuatorLag,
    Effect,
    MotorGain,
    StribeckFriction,
    TorqueOffset,
    ViscousDamping,
)
from garat_jax.effects.base import ModelView
from garat_jax.effects.motor_apart import Transmission
from garat_jax.errors import UserError
from tests import models

TIME = np.arange(101) * 0.005
HARDLY = 1e-9
"""Size at which a candidate acts without being felt, relative to its parameter's scale."""


@struct.dataclass
class Broken(MotorGain):
    """A gain that is no number after ten substeps."""

    kind: ClassVar[str] = "broken"
    acts: ClassVar[bool] = True

    def init(self, host):
        return jnp.zeros(())

    def apply(self, model: ModelView, state, ctrl: jax.Array, memory):
        return jnp.where(memory < 10, ctrl, jnp.nan), None, memory + 1


@struct.dataclass
class Marked(MotorGain):
    """A gain that remembers where a site is that it adds."""

    kind: ClassVar[str] = "marked"

    def prepare(self, spec):
        spec.worldbody.add_site(name="mark", pos=[0.0, 0.0, 1.0])

    def init(self, host):
        return jnp.asarray(host.site("mark").pos[2])


def make_simulator(mjcf: str, candidates: Sequence[Effect] = ()):
    """Return a model with candidates, or every one, in segments where it falls and is pushed."""
    model = Model("model", __file__, __file__, models.spec(mjcf))
    host = native_model(model.compile(engine="mujoco"))
    states = np.tile(host.qpos0, (len(TIME), 1)), np.zeros((len(TIME), host.nv))
    ctrl = 0.3 * np.sign(np.sin(20 * TIME))[:, None] * np.ones(host.nu)
    recording = Recording("made", TIME, *states, ctrl, {}, True, ((0, len(TIME)),), ())
    grid = choose_grid([recording], host.opt.timestep)
    simulator = Simulator(model, candidates or make_candidates(model), grid)
    return simulator, cut([recording], grid, 0.25)


def test_a_candidate_may_need_what_the_model_card_overrides():
    armature = Override("joint", "hinge", "armature", 0.01)
    spec = models.spec(models.PENDULUM)
    model = Model("pendulum", __file__, __file__, spec, overrides=(armature,))
    candidates = make_candidates(model)
    (index,) = (i for i, c in enumerate(candidates) if c.kind == "backlash")
    count = len(TIME)
    recording = Recording(
        "made", TIME, *np.zeros((2, count, 1)), np.ones((count, 1)), {}, True, ((0, count),), ()
    )
    grid = choose_grid([recording], model.compile(engine="mujoco").host.model.opt.timestep)
    simulator, segments = Simulator(model, candidates, grid), cut([recording], grid, 0.25)
    theta = simulator.base.copy()
    theta[next(j for j, slot in enumerate(simulator.slots) if slot.effect == index)] = 0.02
    thetas, starts = np.stack([simulator.base, theta]), np.stack([segments.start] * 2)
    without, beside = simulator.predict(thetas, starts, segments)
    assert np.abs(beside - without).max() > 1e-3


@pytest.mark.parametrize("mjcf", [models.SLIDER, models.ARM, models.DRONE])
def test_a_candidate_that_does_nothing_predicts_what_the_model_does_without_it(mjcf):
    simulator, segments = make_simulator(mjcf)
    alone = simulator.predict(simulator.base[None], segments.start[None], segments)[0]
    assert np.ptp(alone, axis=1).max() > 0.01
    for index, effect in enumerate(simulator.effects):
        if isinstance(effect, Transmission):
            continue  # a motor that is apart from its joint, however little, is a body more
        theta = simulator.base.copy()
        j = next(j for j, slot in enumerate(simulator.slots) if slot.effect == index)
        p = simulator.slots[j].parameter
        theta[j] += HARDLY * p.scale * (-1 if theta[j] >= p.high else 1)
        beside = simulator.predict(theta[None], segments.start[None], segments)[0]
        assert np.abs(beside - alone).max() < 1e-5, (effect.kind, effect.target)


def test_where_mjx_steps_it_predicts_and_fits_the_same(monkeypatch):
    """As on an accelerator: there a model that names no engine is compiled for MJX."""
    candidates = ViscousDamping("joint/hinge"), MotorGain("actuator/motor")
    theta, compiled = np.asarray([[0.05, 0.8]]), Model.compile
    simulator, segments = make_simulator(models.PENDULUM, candidates)
    known = simulator.predict(theta, segments.start[None], segments)[0]
    monkeypatch.setattr(Model, "compile", lambda *a, **kw: compiled(*a, **{"engine": "mjx"} | kw))
    on_mjx, _ = make_simulator(models.PENDULUM, candidates)
    assert (simulator._alone.engine, on_mjx._alone.engine) == ("mujoco", "mjx")
    found = on_mjx.predict(theta, segments.start[None], segments)[0]
    np.testing.assert_allclose(found, known, atol=1e-6)
    measured, all_fitted = dataclasses.replace(segments, measured=known), segments.start[:, 0] < 9
    problem = Problem(on_mjx, measured, all_fitted, TIME[1])
    fitted = fit(problem, on_mjx.base, segments.start, (0, 1))
    np.testing.assert_allclose(fitted.theta, theta[0], rtol=1e-3)


def test_beside_a_law_that_looks_what_does_not_look_shares_a_program():
    blind = (
        MotorGain("actuator/shoulder"),
        ViscousDamping("joint/elbow"),
        TorqueOffset("joint/elbow"),
    )
    simulator, segments = make_simulator(models.ARM, (StribeckFriction("joint/elbow"), *blind))
    base = simulator.base.copy()
    base[[j for j, slot in enumerate(simulator.slots) if slot.effect == 0]] = 0.3
    firsts = [next(j for j, s in enumerate(simulator.slots) if s.effect == i) for i in (1, 2, 3)]
    thetas = np.tile(base, (3, 1))
    thetas[np.arange(3), firsts] += 0.05
    assert [len(rows) for rows in simulator._ways(thetas, base).values()] == [3]
    together = simulator.linear_change(thetas, base, segments.start, segments)
    alone = [simulator.linear_change(t[None], base, segments.start, segments)[0] for t in thetas]
    assert np.abs(together).max(axis=(1, 2, 3)).min() > 1e-4
    assert np.abs(together - np.stack(alone)).max() < 1e-9


def test_beyond_the_end_of_a_recording_a_model_may_diverge():
    simulator, segments = make_simulator(models.PENDULUM, (Broken("actuator/motor"),))
    segments.weight[0, 3:] = 0.0
    predicted = simulator.predict(np.asarray([[0.9]]), segments.start[None], segments)[0]
    np.testing.assert_array_equal(predicted[0, 3:], segments.measured[0, 3:])
    assert np.isnan(predicted[0, 1:3]).all() and np.isnan(predicted[1, 1:]).all()


def test_an_effect_that_breaks_the_model_at_its_nominal_is_named():
    effects = (ActuatorLag("actuator/shoulder"), Broken("actuator/elbow"))
    simulator, segments = make_simulator(models.ARM, effects)
    theta = simulator.base.copy()
    theta[0] = 0.01
    with pytest.raises(UserError, match="no simulation with broken at actuator/elbow stays finite"):
        simulator.linear_change(theta[None], simulator.base, segments.start, segments)


def test_effects_with_a_memory_of_commands_have_a_program_of_their_own():
    effects = (
        MotorGain("actuator/shoulder"),
        ViscousDamping("joint/elbow"),
        ActuatorLag("actuator/shoulder"),
        ActuatorDelay("actuator/elbow"),
    )
    simulator, segments = make_simulator(models.ARM, effects)
    columns = [next(j for j, s in enumerate(simulator.slots) if s.effect == i) for i in range(4)]
    thetas = np.tile(simulator.base, (4, 1))
    thetas[np.arange(4), columns] += 0.02
    assert [*simulator._ways(thetas, simulator.base).values()] == [[0, 1], [2, 3]]
    together = simulator.linear_change(thetas, simulator.base, segments.start, segments)
    for theta, changed in zip(thetas, together, strict=True):
        alone = simulator.linear_change(theta[None], simulator.base, segments.start, segments)[0]
        assert np.abs(changed).max() > 1e-4
        assert np.abs(changed - alone).max() < 1e-9
    late = thetas[3]  # what acts already, acts in the program of the others, too
    beside = late + (thetas[0] - simulator.base)
    change = simulator.linear_change(beside[None], late, segments.start, segments)[0]
    both = np.stack([late, beside])
    starts = np.stack([segments.start] * 2)
    before, after = simulator.predict(both, starts, segments)
    np.testing.assert_allclose(change, after - before, atol=1e-9)
    assert simulator._jitted.cache_info().currsize <= 6  # of changes: plain, blind


def test_effects_whose_memory_needs_what_they_prepare_are_screened():
    simulator, segments = make_simulator(models.PENDULUM, (Marked("actuator/motor"),))
    moved = simulator.base + 0.1
    change = simulator.linear_change(moved[None], simulator.base, segments.start, segments)
    assert np.abs(change).max() > 1e-3
