"""Segments, fits and screening against simulations whose truth is known."""

import dataclasses

import mujoco
import numpy as np
import pytest
from scipy import signal

from garat_jax.diagnosis.diagnose import make_candidates, split, thin
from garat_jax.diagnosis.differences import clear_differences
from garat_jax.diagnosis.fit import are_determined, fit, interval, promises_more
from garat_jax.diagnosis.localise import localise, missing_torque
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.model_card import Model
from garat_jax.diagnosis.noise import signal_noise
from garat_jax.diagnosis.problem import Problem, StartSpace, block_labels
from garat_jax.diagnosis.screen import cosine, screen
from garat_jax.diagnosis.segments import QUIET, choose_grid, cut, metric_spread
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.diagnosis.starts import follow, settle
from garat_jax.diagnosis.timestep import count_timestep
from garat_jax.effects import ActuatorDelay, CoggingTorque, TorqueSaturation, ViscousDamping
from garat_jax.errors import UserError
from tests import models
from tests.diagnosis import pendulum

MODEL = Model("pendulum", __file__, __file__, models.spec(models.PENDULUM))


def record(time, damping=0.0, delay=0, noise=1e-3, seed=0, command=1.0, finer=1) -> Recording:
    """Step C MuJoCo at the model's own timestep or a finer one, each interval in some substeps."""
    rng = np.random.default_rng(seed)
    model = models.spec(models.PENDULUM).compile()
    model.opt.timestep /= finer
    model.dof_damping[0] += damping
    data = mujoco.MjData(model)
    data.qpos[0] = 0.8
    ctrl = command * np.sin(9 * time) * np.sign(np.sin(2 * time))
    states = []
    for k in range(len(time)):
        states.append([data.qpos[0], data.qvel[0]])
        if k + 1 < len(time):
            for _ in range(round((time[k + 1] - time[k]) / model.opt.timestep)):
                data.ctrl[0] = ctrl[max(k - delay, 0)]
                mujoco.mj_step(model, data)
    states = np.asarray(states) + noise * rng.normal(size=(len(time), 2)) * [1.0, 10.0]
    return Recording(
        name=f"made {seed}",
        time=time,
        qpos=states[:, :1],
        qvel=states[:, 1:],
        ctrl=ctrl[:, None],
        torque={},
        velocity_measured=True,
        spans=((0, len(time)),),
        warnings=(),
    )


def make_problem(recordings, candidates, horizon=0.4, model=MODEL, timestep=0.002) -> Problem:
    grid = choose_grid(recordings, timestep)
    segments = cut(recordings, grid, horizon)
    fitted = np.ones(len(segments.start), bool)
    simulator = Simulator(model, candidates, grid)
    return Problem(simulator, segments, fitted, grid.sample)


def candidates():
    return make_candidates(MODEL)


def column(simulator: Simulator, kind: str) -> int:
    return next(
        j for j, s in enumerate(simulator.slots) if simulator.effects[s.effect].kind == kind
    )


UNIFORM = np.arange(500) * 0.004
IRREGULAR = np.cumsum(np.random.default_rng(1).choice([0.002, 0.004, 0.006], 500))


@pytest.mark.parametrize("time", [UNIFORM, IRREGULAR], ids=["uniform", "irregular"])
def test_predictions_are_those_of_a_mujoco_loop(time):
    problem = make_problem([record(time, noise=0.0)], ())
    s = problem.segments
    predicted = problem.simulator.predict(np.zeros((1, 0)), s.start[None], s)[0]
    error = np.abs(predicted - s.measured)[s.weight > 0].max(axis=0)
    assert error[0] < 1e-9
    assert error[1] < 1e-9


def test_a_segment_in_the_middle_knows_the_late_commands_before_it():
    recording = record(UNIFORM, delay=5, noise=0.0)
    problem = make_problem([recording], (ActuatorDelay("all", delay=0.0),))
    s = problem.segments
    predicted = problem.simulator.predict(np.array([[0.02]]), s.start[None], s)[0]
    np.testing.assert_allclose(predicted, s.measured, atol=1e-9)


def test_no_candidates_make_no_changes():
    problem = make_problem([record(UNIFORM)], ())
    shape = problem.segments.measured.shape
    whitened = problem.whiten_change(np.zeros((0, *shape)))
    assert whitened.shape == (0, shape[0], shape[1] * shape[2])


def test_a_fit_recovers_a_parameter_and_its_interval_covers_it():
    recordings = [record(UNIFORM, damping=0.02, seed=seed) for seed in range(2)]
    problem = make_problem(recordings, candidates())
    free = [column(problem.simulator, "viscous_damping")]
    found = fit(problem, problem.simulator.base, problem.segments.start, free)
    assert found.theta[free[0]] == pytest.approx(0.02, rel=0.02)
    assert found.low[0] < 0.02 < found.high[0]
    assert np.sqrt(np.mean(found.residual**2)) == pytest.approx(1.0, abs=0.25)


def test_as_many_parameters_as_blocks_of_time_leave_no_interval():
    problem = make_problem([record(UNIFORM[:60], damping=0.02)], candidates())
    num_blocks = len(np.unique(block_labels(problem)[problem.fitted]))
    assert not are_determined(problem, np.ones(num_blocks, bool))
    assert are_determined(problem, np.ones(num_blocks - 1, bool))
    found = fit(problem, problem.simulator.base, problem.segments.start, [])
    low, high = interval(problem, found.theta, None, range(num_blocks), np.ones(num_blocks, bool))
    assert not np.any(np.isfinite([low, high]))


def test_estimates_are_what_a_timestep_of_zero_would_give():
    problem = make_problem([record(UNIFORM, damping=0.02, noise=1e-5, finer=32)], candidates())
    free = [column(problem.simulator, "viscous_damping")]
    found = fit(problem, problem.simulator.base, problem.segments.start, free)
    timeless = count_timestep(problem, found)
    assert timeless.low[0] < 0.02 < timeless.high[0]
    assert timeless.low[0] < timeless.theta[free[0]] < timeless.high[0]
    assert abs(timeless.theta[free[0]] - 0.02) < 0.2 * abs(found.theta[free[0]] - 0.02)
    assert timeless.high[0] - timeless.low[0] < 0.5 * (found.high[0] - found.low[0])


@pytest.mark.parametrize(("widths", "promises"), [(0.0, False), (1.0, True)])
def test_derivatives_measured_anew_say_that_a_fit_stopped_short(widths, promises):
    problem = make_problem([record(UNIFORM, damping=0.02)], [ViscousDamping("joint/hinge")])
    found = fit(problem, problem.simulator.base, problem.segments.start, (0,))
    short = follow(problem, found.theta + widths * (found.high - found.low), found)
    there = clear_differences(problem, short.theta, short.start, (0,))
    assert promises_more(problem, short.theta, there, (0,)) is promises
    across_jumps = there._replace(relative=2.0 * there.relative)
    assert not promises_more(problem, short.theta, across_jumps, (0,))


def test_settled_initial_states_leave_only_noise():
    problem = make_problem([record(UNIFORM)], ())
    settled = settle(problem, np.zeros(0), problem.segments.start + 0.05)
    assert np.sqrt(np.mean(settled.residual**2)) == pytest.approx(1.0, abs=0.25)


def test_a_fit_of_no_parameters_settles_the_initial_states():
    problem = make_problem([record(UNIFORM)], candidates())
    start = problem.segments.start + 0.05
    settled = settle(problem, problem.simulator.base, start)
    found = fit(problem, settled.theta, start, (), sensitivity=settled.sensitivity)
    np.testing.assert_array_equal(found.residual, settled.residual)


def test_initial_states_are_projected_out():
    rng = np.random.default_rng(0)
    sensitivity = rng.normal(size=(3, 20, 2))
    sensitivity[1, :, 1] = 0.0  # an initial state that nothing shows
    space = StartSpace(sensitivity)
    rest = space.remove(rng.normal(size=(3, 20, 4)))
    np.testing.assert_allclose(np.swapaxes(sensitivity, 1, 2) @ rest, 0.0, atol=1e-12)


def test_screening_finds_the_effect_and_excludes_what_is_not_excited():
    recordings = [record(UNIFORM, damping=0.02, seed=seed, command=0.0) for seed in range(2)]
    problem = make_problem(recordings, candidates())
    current = settle(problem, problem.simulator.base, problem.segments.start)
    scores = screen(problem, current)
    effects = problem.simulator.effects
    first = scores[0]
    assert effects[first.effect].kind == "viscous_damping"
    assert first.size[0] == pytest.approx(0.02, rel=0.1)
    assert first.p_value < 1e-3
    assert cosine(first, first) == pytest.approx(1.0)
    dead = {effects[s.effect].kind: s.excluded for s in scores if s.excluded}
    assert "do not excite" in dead["motor_gain"]
    assert "do not excite" in dead["actuator_delay"]


def test_the_missing_torque_says_where():
    places = localise(
        missing_torque(MODEL.compile().host.model, [record(UNIFORM, damping=0.05, noise=0.0)])
    )
    assert places[0].signal == "hinge"
    assert places[0].regime == "in proportion to speed"
    assert places[0].share > 0.8
    assert "against the motion" in places[0].evidence


def test_velocities_that_contradict_positions_count_as_noise():
    rng = np.random.default_rng(0)
    angle, speed = np.sin(4 * UNIFORM)[:, None], 4 * np.cos(4 * UNIFORM)[:, None]
    noisy = angle + 1e-4 * rng.normal(size=angle.shape)
    right = dataclasses.replace(record(UNIFORM), qpos=noisy, qvel=speed)
    wrong = dataclasses.replace(right, qvel=speed + 0.1 * np.sin(3 * UNIFORM)[:, None])
    assert signal_noise(right)[1] < 0.01
    assert signal_noise(wrong)[1] == pytest.approx(0.1 / np.sqrt(2), rel=0.3)


@pytest.mark.parametrize("correlated", [0.0, 0.02])
def test_noise_that_changes_slowly_is_seen_whole(correlated: float):
    rng = np.random.default_rng(0)
    sizes = np.asarray([5e-4, 8e-3])
    keep = np.exp(-(UNIFORM[1] - UNIFORM[0]) / correlated) if correlated else 0.0
    noise = rng.normal(size=(len(UNIFORM), 2))
    noise = signal.lfilter([np.sqrt(1 - keep**2)], [1, -keep], noise, axis=0) * sizes
    angle, speed = np.sin(4 * UNIFORM) + noise[:, 0], 4 * np.cos(4 * UNIFORM) + noise[:, 1]
    noisy = dataclasses.replace(record(UNIFORM), qpos=angle[:, None], qvel=speed[:, None])
    assert signal_noise(noisy) == pytest.approx(sizes, rel=0.3)


def test_hold_out_is_by_recording_and_of_a_single_one_its_last_third():
    recordings = [record(UNIFORM[:50], seed=seed) for seed in range(5)]
    fitted, held_out, _ = split(recordings, ())
    assert [len(fitted), len(held_out)] == [4, 1]
    (first,), (last,), how = split(recordings[:1], ())
    assert first.spans == ((0, 33),)
    assert last.spans == ((33, 50),)
    assert "last third" in how
    with pytest.raises(UserError, match="too short to hold out its last third"):
        split([record(UNIFORM[:24])], ())


def test_passive_recordings_are_thinned_and_driven_ones_are_not():
    fast = record(np.arange(100) * 0.002)
    passive = dataclasses.replace(fast, ctrl=np.zeros((100, 0)))
    assert len(thin([passive])[0].time) == 50
    assert thin([passive])[0].spans == ((0, 50),)
    assert len(thin([fast])[0].time) == 100
    parts = dataclasses.replace(passive, spans=((0, 80), (80, 95)))
    assert thin([parts])[0].spans == ((0, 40),)


def test_a_signal_that_never_changes_has_the_noise_of_its_kind():
    rng = np.random.default_rng(0)
    swinging = np.sin(9 * UNIFORM) + 1e-3 * rng.normal(size=len(UNIFORM))
    speed = 9 * np.cos(9 * UNIFORM) + 1e-2 * rng.normal(size=len(UNIFORM))
    still = np.full(len(UNIFORM), 0.25)
    recording = dataclasses.replace(
        record(UNIFORM),
        qpos=np.column_stack([swinging, still]),
        qvel=np.column_stack([speed, 0.0 * still]),
    )
    segments = cut([recording], choose_grid([recording], 0.002), 0.4)
    assert segments.noise[0] == pytest.approx(1e-3, rel=0.2)
    assert segments.noise[2] == pytest.approx(1e-2, rel=0.2)
    np.testing.assert_array_equal(segments.noise[[1, 3]], segments.noise[[0, 2]])
    np.testing.assert_array_equal(segments.spread[[1, 3]], QUIET * segments.noise[[1, 3]])


def test_noise_of_a_signal_that_hardly_moves_weighs_as_much_as_that_of_others():
    rng = np.random.default_rng(0)
    noise = np.asarray([1e-3, 1e-2, 0.1])
    moves = np.column_stack([np.sin(9 * UNIFORM), 9 * np.cos(9 * UNIFORM), 0 * UNIFORM])
    samples = moves + noise * rng.normal(size=moves.shape)
    spread = metric_spread(samples, noise)
    np.testing.assert_array_equal(spread[:2], samples[:, :2].std(axis=0))
    assert spread[2] / noise[2] == pytest.approx(np.median(spread[:2] / noise[:2]))
    np.testing.assert_allclose(metric_spread(samples[:, 2:], noise[2:]), QUIET * noise[2:])


def test_a_limit_that_is_reached_in_one_segment_only_is_screened_there():
    time = np.arange(6000) * 0.004
    limit = TorqueSaturation("actuator/motor")
    problem = make_problem([record(time, noise=0.0)], (limit,))
    segments, noise = problem.segments, 1e-3 * np.array([1.0, 10.0])
    for alone in (30, 31):  # of 60 segments every second one is screened anyway
        small = np.where(np.arange(60) == alone, 1.0, 0.3)[:, None, None]
        commanded = dataclasses.replace(segments, ctrl=small * segments.ctrl, noise=noise)
        true = problem.simulator.predict(np.array([[0.5]]), segments.start[None], commanded)[0]
        measured = true + noise * np.random.default_rng(0).normal(size=true.shape)
        made = dataclasses.replace(commanded, measured=measured)
        some = dataclasses.replace(problem, segments=made)
        settled = settle(some, some.simulator.base, made.start)
        (score,) = screen(some, settled)
        assert not score.excluded
        assert score.share > 0.5


def test_a_segment_with_much_of_the_residual_counts_as_one_beside_those_not_screened():
    time = np.arange(24000) * 0.004
    made = record(time, damping=0.02)
    problem = make_problem([made], (ViscousDamping("joint/hinge", coefficient=0.0),))
    segments = problem.segments
    rest = settle(problem, problem.simulator.base, segments.start).cost.sum()
    wave = np.sin(np.arange(100) * 0.3)
    measured = segments.measured.copy()  # of 240 segments every tenth is screened anyway
    measured[3, :, 0] += segments.noise[0] * np.sqrt(0.4 * rest / np.sum(wave**2)) * wave
    bumped = dataclasses.replace(problem, segments=dataclasses.replace(segments, measured=measured))
    settled = settle(bumped, bumped.simulator.base, segments.start)
    bump = settled.cost[3] / settled.cost.sum()
    (score,) = screen(bumped, settled)
    assert bump > 0.2
    assert abs(score.share - (1.0 - bump)) < 0.1


def test_few_segments_that_all_hold_much_of_the_residual_count_alike():
    problem = make_problem(
        [record(UNIFORM, damping=0.02)], (ViscousDamping("joint/hinge", coefficient=0.0),)
    )
    settled = settle(problem, problem.simulator.base, problem.segments.start)
    heavy = np.flatnonzero(settled.cost > 0.1 * settled.cost.sum())
    assert len(heavy) > 1
    (score,) = screen(problem.take(heavy), settled.take(heavy))
    assert score.share > 0.9


def test_a_law_that_is_switched_on_by_its_size_is_seen_at_the_size_that_is_missing():
    """At a hundredth of a newton metre no signal would tell the number of periods."""

    def ripple(angle: float) -> float:
        return 0.3 * np.sin(12 * angle + 0.4)

    recordings = [pendulum.record(lambda spec: None, seed, ripple=ripple) for seed in range(2)]
    problem = make_problem(recordings, [CoggingTorque("joint/hinge")], timestep=0.004)
    before = settle(problem, problem.simulator.base, problem.segments.start)
    assert np.linalg.norm(before.residual) > 100
    few = problem.take(np.arange(4))
    (score,) = screen(few, before.take(np.arange(4)))
    assert not score.excluded
    assert score.share > 0.5
