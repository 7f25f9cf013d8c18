"""Initial states at many parameters in one batch are those at each by itself."""

import functools

import numpy as np
import pytest

from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.segments import choose_grid, cut
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.diagnosis.starts import follow, follow_each, settle
from garat_jax.effects import QuadraticDrag, ViscousDamping
from tests.diagnosis.pendulum import MODEL, add_damping, record

EFFECTS = (ViscousDamping("joint/hinge"), QuadraticDrag("joint/hinge"))
THETAS = np.asarray([[0.05, 0.0], [0.0, 0.02], [0.02, 0.02]])


@pytest.fixture(scope="module")
def problem() -> Problem[Simulator]:
    damped = functools.partial(add_damping, size=0.05)
    recordings = [record(damped, seed) for seed in range(2)]
    grid = choose_grid(recordings, 0.002)
    simulator = Simulator(MODEL, EFFECTS, grid)
    segments = cut(recordings, grid, 0.5)
    return Problem(simulator, segments, np.ones(len(segments.start), bool), 0.004)


def test_each_segment_may_have_parameters_of_its_own(problem):
    starts = np.stack([problem.segments.start] * len(THETAS))
    each = problem.simulator.predict(THETAS, starts, problem.segments)
    count = len(problem.segments.start)
    mixed = THETAS[np.arange(count) % len(THETAS)]
    found = problem.simulator.predict(mixed[None], starts[:1], problem.segments)[0]
    for number in range(count):
        np.testing.assert_allclose(found[number], each[number % len(THETAS), number], atol=1e-9)


def test_many_parameters_are_followed_together_as_one_by_one(problem):
    near = settle(problem, problem.simulator.base, problem.segments.start)
    together = follow_each(problem, THETAS, near)
    for theta, found in zip(THETAS, together, strict=True):
        alone = follow(problem, theta, near)
        np.testing.assert_array_equal(found.theta, theta)
        assert found.residual.shape == near.residual.shape
        np.testing.assert_allclose(found.cost, alone.cost, rtol=1e-2)
        assert abs(found.cost.sum() - near.cost.sum()) > 10.0
