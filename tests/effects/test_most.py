"""A law that most values follow."""

import numpy as np
import pytest

from garat_jax.effects.most import follow_most, median_distance

RNG = np.random.default_rng(0)
COLUMNS = np.column_stack([RNG.uniform(-3, 1, 2000), 1e-3 * RNG.normal(size=2000)])
VALUES = 5.0 + COLUMNS @ [-2.0, 400.0] + 0.01 * RNG.normal(size=2000)


def test_a_fifth_of_huge_values_does_not_bend_the_law():
    spoilt = VALUES.copy()
    spoilt[::5] += 300.0 * RNG.normal(size=400)
    level, factor = follow_most(COLUMNS, spoilt)
    assert level == pytest.approx(5.0, abs=0.1)
    assert factor == pytest.approx([-2.0, 400.0], rel=0.03)


def test_units_do_not_matter():
    level, factor = follow_most(COLUMNS, VALUES)
    other_level, other = follow_most(COLUMNS * [10.0, 1e3], 3.0 * VALUES + 1.0)
    assert other_level == pytest.approx(3.0 * level + 1.0, rel=1e-4)
    assert other == pytest.approx(3.0 * factor / [10.0, 1e3], rel=1e-3)


def test_what_never_changes_says_nothing():
    level, factor = follow_most(np.full((9, 1), 0.3), np.full(9, 2.0))
    assert (level, factor[0]) == pytest.approx((2.0, 0.0))
    assert median_distance(np.full(9, 2.0)) > 0
