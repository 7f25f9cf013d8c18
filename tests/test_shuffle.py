"""A random order has every number once, and no order is likelier than another."""

import jax
import numpy as np
import pytest

from garat_jax import shuffle
from garat_jax.shuffle import picked, shuffled


@pytest.mark.parametrize("num", [1, 2, 5000, shuffle.MOST, shuffle.MOST + 1])
def test_every_number_is_there_once(num):
    order = np.asarray(shuffled(jax.random.key(0), num))
    assert order.dtype == np.int32
    np.testing.assert_array_equal(np.sort(order), np.arange(num))


def test_all_orders_of_four_are_equally_likely():
    keys = jax.random.split(jax.random.key(1), 24_000)
    orders = np.asarray(jax.vmap(lambda key: shuffled(key, 4))(keys))
    _, counts = np.unique(orders, axis=0, return_counts=True)
    assert len(counts) == 24
    chi_square = np.sum((counts - 1000) ** 2) / 1000
    assert chi_square < 49.7  # 99.9 % of a chi-square distribution with 23 degrees of freedom


def test_neighbours_of_many_ascend_about_as_often_as_they_descend():
    keys = jax.random.split(jax.random.key(2), 100)
    steps = np.diff(np.asarray(jax.vmap(lambda key: shuffled(key, 5000))(keys)), axis=1)
    assert abs(np.mean(steps > 0) - 0.5) < 0.005  # it is 0.0024, by numbers that drew the same


@pytest.mark.parametrize(("num", "size"), [(12, 4), (10, 4), (4, 4), (4, 10), (1, 3)])
def test_picks_are_of_all_alike(num, size):
    keys = jax.random.split(jax.random.key(3), 3000)
    picks = np.asarray(jax.vmap(lambda key: picked(key, num, size))(keys))
    assert picks.shape == (3000, num)
    each = np.stack([np.bincount(row, minlength=size) for row in picks])
    assert np.ptp(each, axis=1).max() <= 1
    np.testing.assert_allclose(each.mean(axis=0), num / size, atol=0.05)
