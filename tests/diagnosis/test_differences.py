"""Finite differences where predictions are smooth, and where contacts chatter."""

import numpy as np
import pytest

from garat_jax.diagnosis.differences import (
    STEP,
    WIDER,
    clear_differences,
    cosines,
    difference_steps,
    projected,
)
from garat_jax.diagnosis.metric import trusted
from garat_jax.diagnosis.problem import linearise
from garat_jax.diagnosis.starts import settle
from garat_jax.effects import ViscousDamping
from tests.diagnosis.test_fit import make_problem, record
from tests.diagnosis.test_starts import FRICTION, puck

__all__ = ["puck"]


def test_a_smooth_law_keeps_a_small_step():
    problem = make_problem([record(np.arange(400) / 200.0)], [ViscousDamping("joint/hinge")])
    theta, start = problem.simulator.base, problem.segments.start
    found = clear_differences(problem, theta, start, (0,))
    assert found.relative <= WIDER * STEP
    assert found.is_clear.all()
    plain = linearise(problem, theta, start, (0,), difference_steps(problem, theta, (0,), STEP))
    np.testing.assert_allclose(found.linearisation.parameters, plain.parameters, rtol=1e-3, atol=1)


def test_chatter_widens_the_step_until_the_law_shows(puck):
    """The derivative is that of a change that is far larger than what the jumps make of it."""
    theta = np.array([FRICTION])
    settled = settle(puck, theta, puck.segments.start)
    puck = trusted(puck, settled)

    def derivative(relative: float) -> np.ndarray:
        steps = difference_steps(puck, theta, (0,), relative)
        near = settled.sensitivity
        return projected(puck, linearise(puck, theta, settled.start, (0,), steps, near))[0]

    found = clear_differences(puck, theta, settled.start, (0,), settled.sensitivity)
    assert found.relative > STEP
    assert found.is_clear.all()
    clear, far = projected(puck, found.linearisation)[0], derivative(10.0)
    assert cosines(clear, far) > 0.8
    assert np.linalg.norm(clear) == pytest.approx(np.linalg.norm(far), rel=0.5)
    assert np.linalg.norm(derivative(STEP)) > 10 * np.linalg.norm(far)


def test_nothing_free_has_no_differences():
    problem = make_problem([record(np.arange(400) / 200.0)], [ViscousDamping("joint/hinge")])
    found = clear_differences(problem, problem.simulator.base, problem.segments.start, ())
    assert found.relative.shape == found.is_clear.shape == (0,)
    assert found.linearisation.parameters.shape[-1] == 0
