"""A payload's mass is as uncertain as its place, where that was left at a guess."""

import dataclasses
import functools

import numpy as np
import pytest

from garat_jax.diagnosis.fit import fit
from garat_jax.diagnosis.guesses import with_guesses
from garat_jax.effects import AsymmetricFriction, PayloadMass, ViscousDamping
from tests import models
from tests.diagnosis.pendulum import MODEL, add_payload, record
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
    assert widened.high[0] > near.high[0]
    whole = fitted(problem, "mass", "x", "z")
    assert whole.low[0] < MASS < whole.high[0]
    assert widened.low[0] == pytest.approx(whole.low[0], abs=0.002)
    np.testing.assert_array_equal(widened.theta, near.theta)


def test_what_was_fitted_and_what_acts_alone_is_no_guess(problem):
    whole = fitted(problem, "mass", "x", "y", "z")
    assert with_guesses(problem, [0], whole) is whole
    alone = fitted(problem, "coefficient", "coulomb_positive")
    assert with_guesses(problem, [1, 2], alone) is alone


def test_where_nothing_is_told_of_a_guess_its_bounds_count():
    """Without gravity only a payload's mass times its distance squared shows."""

    def float_freely(spec):
        spec.option.gravity = [0.0, 0.0, 0.0]
        add_payload(spec, mass=MASS, x=0.0, z=GUESS)

    spec = models.spec(models.PENDULUM)
    spec.option.gravity = [0.0, 0.0, 0.0]
    model = dataclasses.replace(MODEL, spec=spec)
    laws = (PayloadMass("body/pole", z=GUESS),)
    problem = make_problem([record(float_freely, 0)], laws, model=model)
    near = fitted(problem, "mass")
    widened = with_guesses(problem, [0], near)
    assert near.high[0] - near.low[0] < 0.01
    reach = 2.0 * MASS / abs(GUESS)  # kg for each metre of the place, of which bounds leave one
    assert widened.high[0] - MASS == pytest.approx(reach, rel=0.1)


def test_what_is_known_badly_does_not_widen_what_is_known_well(problem):
    near = fitted(problem, "mass", "coefficient")
    alone = with_guesses(problem, [0], near)
    more = np.asarray([0.0, 1.0])
    wide = dataclasses.replace(near, low=near.low - more, high=near.high + more)
    beside = with_guesses(problem, [0], wide)
    assert (beside.low[0], beside.high[0]) == pytest.approx((alone.low[0], alone.high[0]))


def test_an_interval_without_an_end_stays_so(problem):
    near = fitted(problem, "mass", "coefficient")
    endless = dataclasses.replace(
        near, low=np.asarray([near.low[0], -np.inf]), high=np.asarray([near.high[0], np.inf])
    )
    widened = with_guesses(problem, [0], endless)
    assert np.isfinite(widened.high[0])
    assert (widened.low[1], widened.high[1]) == (-np.inf, np.inf)
