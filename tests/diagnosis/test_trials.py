"""What contacts do to predictions: small steps that tell nothing, samples that count for little."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from garat_jax.diagnosis.metric import make_metric, trusted
from garat_jax.diagnosis.screen import _measure, screen
from garat_jax.diagnosis.starts import settle
from garat_jax.diagnosis.trials import enlarge, firsts
from garat_jax.effects import Backlash, CoggingTorque, GravityTilt, JointFlexibility, TorqueOffset
from tests import models
from tests.diagnosis import pendulum
from tests.diagnosis.test_fit import MODEL, UNIFORM, candidates, column, make_problem, record


class Jumping:
    """A simulator that half a timestep changes from some sample on."""

    def __init__(self, simulator, first: int, jump: float):
        self._simulator, self._first, self._jump = simulator, first, jump
        self.predict = simulator.predict

    def refined(self, factor: int):
        return SimpleNamespace(predict=self._jumped)

    def _jumped(self, theta, start, segments):
        predicted = self._simulator.predict(theta, start, segments)
        predicted[:, :, self._first :] += self._jump
        return predicted


def test_steps_grow_where_few_samples_make_the_change():
    problem = make_problem([record(UNIFORM)], candidates())
    simulator = problem.simulator
    rows, trials = firsts(problem, simulator.base, ())
    damping, friction = (
        next(
            t.rows[0]
            for t in trials
            if rows[t.rows[0]].column == column(simulator, kind) and t.is_only
        )
        for kind in ("viscous_damping", "coulomb_friction")
    )
    changes = np.full((1000, len(rows)), 1e-3)
    changes[::100, friction] = 0.03  # three times the norm of the rest
    every = range(len(rows))
    larger = enlarge(problem, rows, trials, changes, np.full(1000, 0.5), every)
    assert friction in larger and damping not in larger
    row, trial = larger[friction]
    assert row.step == pytest.approx(500 * rows[friction].step)
    assert row.values[row.column] == pytest.approx(simulator.base[row.column] + row.step)
    assert trial.rows == (friction,)
    assert trial.start == row.values
    assert friction not in enlarge(problem, rows, trials, changes, np.full(1000, 1.9e-3), every)
    assert friction not in enlarge(problem, rows, trials, changes, np.full(1000, 0.5), [damping])
    p = simulator.slots[row.column].parameter
    far, _ = enlarge(problem, rows, trials, changes, np.full(1000, 1e9), every)[friction]
    assert far.step == pytest.approx(0.3 * (p.high - p.low))
    changes[:, friction] = np.where(np.arange(1000) % 100, 0.0, 1.0)
    changes[0, friction] = 1e3  # most samples do not change at all
    rare, _ = enlarge(problem, rows, trials, changes, np.full(1000, 5.0), every)[friction]
    assert rare.step == pytest.approx(5 * rows[friction].step)


def test_a_gear_is_no_candidate_where_another_acts():
    spec = models.spec(models.PENDULUM)
    spec.joints[0].armature = 0.01
    model = dataclasses.replace(MODEL, spec=spec)
    gears = (Backlash("joint/hinge"), JointFlexibility("joint/hinge"))
    problem = make_problem([record(UNIFORM)], gears, model=model)

    def tried(theta):
        return {trial.effect for trial in firsts(problem, theta, skip=[0])[1]}

    nothing = problem.simulator.base
    gap = np.where(np.arange(len(nothing)) == column(problem.simulator, "backlash"), 0.1, nothing)
    assert tried(nothing) == {1}
    assert tried(gap) == set()


def test_of_parameters_that_act_alone_the_one_that_is_seen_comes_first():
    def tilt(spec):
        spec.option.gravity = [-9.81 * np.sin(0.05), 0.0, -9.81 * np.cos(0.05)]

    problem = make_problem([pendulum.record(tilt, seed) for seed in range(2)], candidates())
    simulator = problem.simulator
    settled = settle(problem, simulator.base, problem.segments.start)
    found = {simulator.effects[score.effect].kind: score for score in screen(problem, settled)}
    roll = column(simulator, "gravity_tilt")  # to first order nothing, where all moves in a plane
    assert found["gravity_tilt"].columns[0] == roll + 1
    assert found["gravity_tilt"].possible
    assert found["gravity_tilt"].size[0] == pytest.approx(0.05, abs=0.01)
    tilts = [i for i, e in enumerate(simulator.effects) if isinstance(e, GravityTilt)]
    assert [problem.num_tried(i) for i in tilts] == [2]


def test_samples_that_half_a_timestep_changes_count_less_and_are_reported_as_they_are():
    problem = make_problem([record(UNIFORM, damping=0.02)], ())
    problem = dataclasses.replace(problem, fitted=np.arange(len(problem.fitted)) % 2 == 0)
    settled = settle(problem, problem.simulator.base, problem.segments.start)
    same = trusted(problem, settled).segments.trust
    assert same.min() > 0.5
    jumping = Jumping(problem.simulator, 60, 1000.0)
    doubted = trusted(dataclasses.replace(problem, simulator=jumping), settled)
    trust = doubted.segments.trust
    assert trust[:, 60:].max() < 0.01
    np.testing.assert_array_equal(trust[:, :60], 1.0)
    again = doubted.whiten(
        doubted.simulator.predict(settled.theta[None], settled.start[None], doubted.segments)
    )[0]
    raw, weighed = make_metric(problem), make_metric(doubted)
    held_out = ~problem.fitted
    assert weighed.error(again, held_out) == pytest.approx(raw.error(settled.residual, held_out))
    assert np.abs(again).sum() < 0.7 * np.abs(settled.residual).sum()


def test_a_step_grows_until_it_stands_out_of_what_contacts_add():
    """Contacts add an amount to a tenth of the samples that changes with the step, not its size."""
    problem = make_problem([record(UNIFORM)], [TorqueOffset("joint/hinge")])
    wave = np.sin(np.arange(1000))

    def change(thetas: np.ndarray) -> np.ndarray:
        changes = np.outer(wave, thetas[:, 0])
        for number, torque in enumerate(thetas[:, 0]):
            noise = np.random.default_rng(int(1e6 * abs(torque))).normal(size=1000)
            changes[:, number] += np.where(np.arange(1000) % 10, 0.1, 3.0) * noise
        return changes

    evidence = SimpleNamespace(residual=5.0 * wave, change=change)
    rows, trials, changes = _measure(problem, np.zeros(1), evidence, np.ones(1000), ())
    (row,), ((effect, start, _, _),) = rows, trials
    assert effect == 0
    assert start == {0: row.step}
    assert 2.0 < row.step < 10.0
    assert changes[:, 0] @ wave / np.linalg.norm(changes) / np.linalg.norm(wave) > 0.8


@pytest.mark.parametrize("phase", [0.6, 2.2, -2.4, -0.8])
def test_a_ripple_is_scored_in_whatever_phase_it_is(phase):
    def rippled(seed):
        return pendulum.record(
            lambda spec: None, seed, ripple=lambda q: 0.05 * np.sin(6 * q + phase)
        )

    problem = make_problem([rippled(0), rippled(1)], [CoggingTorque("joint/hinge")])
    simulator = problem.simulator
    settled = settle(problem, simulator.base, problem.segments.start)
    (score,) = screen(problem, settled)
    start = {simulator.slots[j].parameter.name: value for j, value in score.start.items()}
    assert score.possible and score.share > 0.85
    assert start["periods"] == 6.0 and start["amplitude"] > 0
    assert np.cos(start["phase"] - phase) > 0.5


def test_of_a_ripple_that_the_model_has_more_and_less_are_scored():
    law = CoggingTorque("joint/hinge", amplitude=0.02, periods=6.0, phase=-2.4)

    def rippled(seed):
        return pendulum.record(lambda spec: None, seed, ripple=lambda q: 0.05 * np.sin(6 * q - 2.4))

    problem = make_problem([rippled(0), rippled(1)], [law])
    settled = settle(problem, problem.simulator.base, problem.segments.start)
    (score,) = screen(problem, settled)
    assert score.possible and score.share > 0.9
    assert score.start == {0: pytest.approx(0.04)}
