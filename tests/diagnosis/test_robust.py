"""Robust intervals hold where errors come in blocks, and a regression is a regression."""

import numpy as np
import pytest
from scipy import stats

from garat_jax.diagnosis.robust import jackknife, regress

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


@pytest.mark.parametrize("leverage", [1.0, 10.0])
def test_jackknife_holds_where_one_block_says_most(leverage):
    rng = np.random.default_rng(3)
    inside = {regress: 0, jackknife: 0}
    for _ in range(400):
        column = rng.normal(size=400)
        column[:10] *= leverage
        error = rng.normal(size=400)
        error[:10] *= leverage  # as of a block that is predicted worse the more it says
        for estimate in inside:
            more = (np.arange(40),) if estimate is jackknife else ()
            found = estimate(column[:, None], error - 2.0 * column, BLOCKS, *more)
            half = stats.t.ppf(0.975, found.freedom) * np.sqrt(found.covariance[0, 0])
            inside[estimate] += abs(found.coefficient[0] - 2.0) < half
    assert inside[jackknife] / 400 > 0.90
    assert inside[jackknife] >= inside[regress]
    if leverage > 1.0:
        assert inside[regress] / 400 < 0.85


def test_jackknife_is_what_leaving_each_block_out_does():
    rng = np.random.default_rng(4)
    columns, residual = rng.normal(size=(400, 2)) * [1.0, 1e4], rng.normal(size=400)
    found = jackknife(columns, residual, BLOCKS, np.arange(40))
    kept = [block != BLOCKS for block in range(40)]
    apart = [regress(columns[k], residual[k], BLOCKS[k]).coefficient for k in kept]
    change = np.stack(apart) - found.coefficient
    assert found.covariance == pytest.approx(change.T @ change * 39 / 40)


def test_jackknife_of_columns_of_zeros_has_no_variance():
    columns, labels = np.column_stack([np.zeros(400), np.ones(400)]), np.arange(40)
    found = jackknife(columns, np.arange(400.0), BLOCKS, labels)
    assert found.covariance[0, 0] == 0.0 < found.covariance[1, 1]
    nothing = jackknife(columns[:, :1], np.arange(400.0), BLOCKS, labels)
    assert nothing.covariance == pytest.approx(np.zeros((1, 1)))


def test_intervals_hold_where_errors_last_beyond_a_block():
    rng = np.random.default_rng(2)
    labels, stretches, inside = np.arange(120), np.repeat([0, 1], 60), [0, 0]
    for _ in range(400):
        lasting = [np.convolve(rng.normal(size=62), np.ones(3), "valid") for _ in range(4)]
        column, error = (np.concatenate(pair) for pair in (lasting[:2], lasting[2:]))
        for i, given in enumerate((stretches, labels)):
            found = jackknife(column[:, None], error - 2.0 * column, labels, given)
            half = stats.t.ppf(0.975, found.freedom) * np.sqrt(found.covariance[0, 0])
            inside[i] += abs(found.coefficient[0] - 2.0) < half
    assert 0.88 < inside[0] / 400 < 0.98
    assert inside[1] / 400 < 0.85


def test_errors_across_a_gap_are_independent():
    column, residual = np.ones((8, 1)), np.asarray([1.0, 2, 2, 3, -2, -2, -1, -3])
    labels = np.repeat([0, 2, 3, 5], 2)  # no residual has the others
    apart, gap = (
        jackknife(column, residual, labels, np.asarray(s))
        for s in ([0, 1, 2, 3, 4, 5], [0, 0, 0, 1, 1, 1])
    )
    together = jackknife(column, residual, np.repeat(np.arange(4), 2), np.zeros(4, int))
    assert gap.covariance == pytest.approx(apart.covariance)
    assert together.covariance[0, 0] > 1.1 * apart.covariance[0, 0]
