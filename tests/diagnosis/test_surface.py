"""The minimum of a cost that jumps from one set of parameters to the next."""

import dataclasses

import numpy as np
import pytest

from garat_jax.diagnosis import surface
from garat_jax.diagnosis.fit import fit, uncertainty
from garat_jax.diagnosis.problem import Problem, linearise
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.diagnosis.starts import Fit, follow, follow_each
from garat_jax.diagnosis.surface import smooth_minimum
from garat_jax.effects import TorqueOffset, ViscousDamping
from tests.diagnosis.test_fit import make_problem, record

TRUTH = 0.02
COLUMNS = np.asarray([0])


class Jumping:
    """A simulator whose predictions jump in every segment, elsewhere for other parameters."""

    def __init__(self, smooth: Simulator, size: np.ndarray):
        self.smooth, self.size = smooth, size
        self.effects, self.slots, self.base = smooth.effects, smooth.slots, smooth.base
        self.host = smooth.host

    def predict(self, theta, start, segments) -> np.ndarray:
        predicted = self.smooth.predict(theta, start, segments)
        after = np.linspace(0, 1, predicted.shape[2])[:, None]
        names = np.stack([segments.recording, segments.first], axis=1)
        for row, values in zip(predicted, theta, strict=True):
            every = np.broadcast_to(values, (len(row), np.shape(values)[-1]))
            for signals, name, own in zip(row, names, every, strict=True):
                rng = np.random.default_rng([*name, *own.view(np.uint64)])
                signals += self.size * rng.normal(size=2) * (after > rng.random())
        return predicted


@pytest.fixture(scope="module")
def smooth() -> tuple[Problem, Fit, np.ndarray, float]:
    recordings = [record(np.arange(400) * 0.004, damping=TRUTH, seed=seed) for seed in range(2)]
    problem = make_problem(recordings, [ViscousDamping("joint/hinge")])
    found = fit(problem, problem.simulator.base, problem.segments.start, COLUMNS)
    lin = linearise(problem, found.theta, found.start, COLUMNS, [1e-4], found.sensitivity)
    return problem, found, *uncertainty(problem, lin, np.asarray([True]))


@pytest.mark.parametrize("off", [0.8, 6.0])
def test_from_near_and_from_far_a_smooth_minimum_is_found_and_is_sure(smooth, off):
    problem, found, covariance, sure = smooth
    half = sure * np.sqrt(covariance[0, 0])
    off = follow(problem, found.theta + off * half, found)
    back, rough = smooth_minimum(problem, off, COLUMNS, covariance, sure)
    assert back.theta[0] == pytest.approx(found.theta[0], abs=0.1 * half)
    assert rough[0] < 0.2 * half


def test_a_segment_whose_initial_state_was_not_found_does_not_outvote_the_others():
    expected = np.full(30, 100.0)
    costs = np.stack([expected, 1.02 * expected])
    costs[:, 0] = 3000.0, 2500.0
    assert costs[1].sum() < costs[0].sum()
    right, wrong = surface._together(costs, expected)
    assert right < wrong
    right, wrong = surface._together(costs[:, 1:], expected[1:])
    assert wrong - right == pytest.approx(0.5 * 29 * 2.0, rel=0.05)


class Lost:
    """A simulator of which one segment is far off, a little less so the larger the parameter."""

    def __init__(self, smooth: Simulator, first: int, size: np.ndarray, half: float):
        self.smooth, self.first, self.size, self.half = smooth, first, size, half
        self.effects, self.slots, self.base = smooth.effects, smooth.slots, smooth.base
        self.host = smooth.host

    def predict(self, theta, start, segments) -> np.ndarray:
        predicted = self.smooth.predict(theta, start, segments)
        lost = (segments.recording == 0) & (segments.first == self.first)
        less = 1.0 - 0.005 * (theta[..., 0] - TRUTH) / self.half
        wave = (-1.0) ** np.arange(predicted.shape[2])[:, None] * self.size
        off = less.reshape(len(predicted), -1, 1, 1) * wave
        return predicted + np.where(lost[:, None, None], off, 0.0)


def test_the_minimum_of_all_is_found_beside_a_segment_that_is_lost(smooth):
    problem, found, covariance, sure = smooth
    half, noise = sure * np.sqrt(covariance[0, 0]), 15.0 * problem.segments.noise
    simulator = Lost(problem.simulator, problem.segments.first[0], noise, half)
    lost = dataclasses.replace(problem, simulator=simulator)
    off = follow(lost, found.theta + 0.5 * half, found)
    back, _ = smooth_minimum(lost, off, COLUMNS, covariance, sure)
    assert back.theta[0] == pytest.approx(found.theta[0], abs=0.5 * half)


def test_what_the_last_surface_moved_counts_as_unsure(smooth):
    problem, found, covariance, sure = smooth
    half = sure * np.sqrt(covariance[0, 0])
    off = follow(problem, found.theta + 6.0 * half, found)
    back, unsure = smooth_minimum(problem, off, COLUMNS, covariance, sure, moves=1)
    assert abs(back.theta[0] - found.theta[0]) > half
    assert unsure[0] > 0.9 * (off.theta[0] - back.theta[0]) > half


def test_the_deepest_dip_of_a_rough_cost_is_left_for_the_middle_of_all(smooth):
    problem, found, covariance, sure = smooth
    half = sure * np.sqrt(covariance[0, 0])
    size = 0.5 * problem.segments.noise
    rough = dataclasses.replace(problem, simulator=Jumping(problem.simulator, size))
    tried = found.theta + half * np.linspace(-2, 2, 41)[:, None]
    dips = sorted(follow_each(rough, tried, found), key=lambda dip: dip.cost.sum())
    errors, unsure = [], []
    for dip in dips[:20]:
        middle, width = smooth_minimum(rough, dip, COLUMNS, covariance, sure)
        errors.append((dip.theta[0] - found.theta[0], middle.theta[0] - found.theta[0]))
        unsure.append(width[0])
    of_dips, of_middles = np.sqrt(np.mean(np.square(errors), axis=0))
    assert of_middles < 0.6 * of_dips
    assert np.median(unsure) > 0.2 * half
    inside = [abs(error) < width for (_, error), width in zip(errors, unsure, strict=True)]
    assert np.mean(inside) > 0.75


@pytest.fixture(scope="module")
def pair() -> tuple[Problem, Fit, np.ndarray, np.ndarray, float]:
    recordings = [record(np.arange(400) * 0.004, seed=seed) for seed in range(2)]
    laws = [ViscousDamping("joint/hinge"), TorqueOffset("joint/hinge")]
    problem = make_problem(recordings, laws)
    both, base = np.asarray([0, 1]), problem.simulator.base
    found = follow(problem, base, fit(problem, base, problem.segments.start, both))
    lin = linearise(problem, base, found.start, both, [1e-4, 1e-3], found.sensitivity)
    return problem, found, both, *uncertainty(problem, lin, np.asarray([True, True]))


def test_places_keep_up_with_axes_that_are_widened_later(pair, monkeypatch):
    seen, minimum = [], surface._minimum

    def second_is_flat(at, costs):
        seen.append(at.copy())
        return *minimum(at, costs)[:2], np.asarray([True, False])

    monkeypatch.setattr(surface, "_minimum", second_is_flat)
    smooth_minimum(*pair)
    kept = len(surface.OFFSETS)
    assert np.any(seen[0][:kept, 1] != 0)  # the bound of damping, 0, bends the first axis
    np.testing.assert_allclose(seen[1][:kept], seen[0][:kept] * [1.0, 0.5], atol=1e-9)


@pytest.mark.parametrize(("second", "surfaces"), [(1.5, 1), (1.0, surface.MOVES)])
def test_a_minimum_that_is_far_along_an_axis_has_to_be_sure_along_it(
    pair, monkeypatch, second, surfaces
):
    seen = []

    def minimum(at, costs):
        seen.append(at)
        return np.asarray([0.5, 1.3]), np.asarray([0.1, second]), np.asarray([True, True])

    monkeypatch.setattr(surface, "_minimum", minimum)
    monkeypatch.setattr(Problem, "within_bounds", lambda problem, columns, values: values)
    smooth_minimum(*pair)
    assert len(seen) == surfaces


def test_axes_stay_as_wide_as_they_were_needed_and_grow_fourfold_at_most(pair, monkeypatch):
    lengths, around = [], surface._around

    def measured(problem, fitted, columns, axes):
        lengths.append(np.linalg.norm(axes[:, -1]))
        return around(problem, fitted, columns, axes)

    def far_along_the_first_and_flat_along_the_second(at, costs):
        return np.asarray([1.3, 0.0]), np.asarray([0.1, 2.0]), np.asarray([True, False])

    monkeypatch.setattr(surface, "_around", measured)
    monkeypatch.setattr(surface, "_minimum", far_along_the_first_and_flat_along_the_second)
    monkeypatch.setattr(Problem, "within_bounds", lambda problem, columns, values: values)
    smooth_minimum(*pair)
    assert np.divide(lengths, lengths[0]) == pytest.approx([1.0, 2.0, 4.0, 4.0, 4.0, 4.0])


def test_a_minimum_beyond_a_bound_is_not_gone_to():
    time = np.arange(400) * 0.004
    recordings = [record(time, damping=-0.006, seed=seed) for seed in range(2)]
    problem = make_problem(recordings, [ViscousDamping("joint/hinge")])
    found = fit(problem, problem.simulator.base, problem.segments.start, COLUMNS)
    lin = linearise(problem, found.theta, found.start, COLUMNS, [1e-4], found.sensitivity)
    covariance, sure = uncertainty(problem, lin, np.asarray([True]))
    assert smooth_minimum(problem, found, COLUMNS, covariance, sure)[0].theta[0] >= 0.0
