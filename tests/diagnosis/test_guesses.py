"""A payload's mass is as uncertain as its place, where that was left at a guess."""

import functools

import numpy as np
import pytest

from garat_jax.diagnosis.fit import fit
from garat_jax.diagnosis.guesses import with_guesses
from garat_jax.effects import AsymmetricFriction, PayloadMass, ViscousDamping
from tests.diagnosis.pendulum import add_payload, record
from tests.diagnosis.test_fit import make_problem

MASS, PLACE, GUESS = 0.1, -0.26, -0.25


@pytest.fixture(scope="module")
def problem():
    loaded = functools.partial(add_payload, mass=MASS, x=0.0, z=PLACE)
    laws = (
        PayloadMass("body/pole", z=GUESS),
        ViscousDamping("joint/hinge"),
        AsymmetricFriction("joint/hinge"),
    )
    return make_problem([record(loaded, seed) for seed in range(2)], laws)


def fitted(problem, *names):
    columns = [slot.parameter.name for slot in problem.simulator.slots]
    start = problem.simulator.base.copy()
    start[columns.index("mass")] = MASS
    return fit(problem, start, problem.segments.start, [columns.index(name) for name in names])


def test_the_interval_of_a_mass_counts_what_the_recordings_leave_open_of_its_place(problem):
    near = fitted(problem, "mass")
    assert not near.low[0] < MASS < near.high[0]
    widened = with_guesses(problem, [0], near)
    assert widened.low[0] < MASS < widened.high[0]
    whole = fitted(problem, "mass", "x", "z")
    assert whole.low[0] < MASS < whole.high[0]
    assert widened.low[0] == pytest.approx(whole.low[0], abs=0.002)
    np.testing.assert_array_equal(widened.theta, near.theta)


def test_what_was_fitted_and_what_acts_alone_is_no_guess(problem):
    whole = fitted(problem, "mass", "x", "y", "z")
    assert with_guesses(problem, [0], whole) is whole
    alone = fitted(problem, "coefficient", "coulomb_positive")
    assert with_guesses(problem, [1, 2], alone) is alone
