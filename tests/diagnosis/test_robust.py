"""Robust intervals hold where errors come in blocks, and a regression is a regression."""

import numpy as np
import pytest
from scipy import stats

from garat_jax.diagnosis.robust import regress

BLOCKS = np.repeat(np.arange(40), 10)


def test_coefficients_are_those_of_least_squares_in_any_unit():
    rng = np.random.default_rng(0)
    columns, residual = rng.normal(size=(400, 3)), rng.normal(size=400)
    found = regress(columns * [1.0, 1e-6, 1e6], residual, BLOCKS)
    expected = -np.linalg.lstsq(columns, residual, rcond=None)[0]
    assert found.coefficient * [1.0, 1e-6, 1e6] == pytest.approx(expected)
    assert found.rest == pytest.approx(residual + columns @ expected)
    assert found.freedom == 37


def test_a_column_of_zeros_gets_neither_coefficient_nor_variance():
    found = regress(np.column_stack([np.ones(400), np.zeros(400)]), np.ones(400), BLOCKS)
    assert found.coefficient == pytest.approx([-1.0, 0.0])
    assert found.covariance[1, 1] == 0.0


def test_intervals_hold_where_errors_are_common_to_a_block():
    rng = np.random.default_rng(1)
    inside = 0
    for _ in range(400):
        column = rng.normal(size=40)[BLOCKS]
        residual = -2.0 * column + rng.normal(size=40)[BLOCKS]
        found = regress(column[:, None], residual, BLOCKS)
        half = stats.t.ppf(0.975, found.freedom) * np.sqrt(found.covariance[0, 0])
        inside += abs(found.coefficient[0] - 2.0) < half
    assert 0.90 < inside / 400 < 0.98
