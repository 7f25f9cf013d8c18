"""Sizes, random orders and picks of minibatches."""

import jax
import jax.numpy as jnp

from garat_jax.errors import UserError

WORD = 32
MOST = 1 << WORD // 2
"""Most numbers for which half of a word's bits are left to draw the order."""


def minibatch_size(total: int, num_minibatches: int) -> int:
    """Return how many of so many steps each minibatch has; a rest is left out.

    Raises:
        UserError: There are more minibatches than steps, or none.
    """
    if not 1 <= num_minibatches <= total:
        raise UserError(
            f"a batch of {total} steps cannot make {num_minibatches} minibatches; "
            f"expected 1 to {total} of them, or a larger batch"
        )
    return total // num_minibatches


def shuffled(key: jax.Array, num: int) -> jax.Array:
    """Return the numbers below `num` in random order, [num] int32.

    Each number is put below random bits in one word, and the words are sorted. On a CPU, where XLA
    sorts words quickly and pairs slowly, this takes a fraction of the time of
    `jax.random.permutation`, which sorts pairs of a random key and a number, twice for this many.
    Numbers that draw the same bits come in ascending order: of 5,000, one in a hundred or so; of
    `MOST`, where as many bits are drawn as there are numbers, two in three have such a neighbour.

    Args:
        key: PRNG key.
        num: How many; for more than `MOST` this is `jax.random.permutation`.
    """
    if num > MOST:
        return jax.random.permutation(key, num)
    num_bits = (num - 1).bit_length()
    drawn = jax.random.bits(key, (num,), jnp.uint32) >> num_bits << num_bits
    words = jnp.sort(drawn | jnp.arange(num, dtype=jnp.uint32))
    return (words & ((1 << num_bits) - 1)).astype(jnp.int32)


def picked(key: jax.Array, num: int, size: int) -> jax.Array:
    """Return indices below `size` in random order, each as often as another but for once, [num].

    Args:
        key: PRNG key.
        num: How many to pick; where it is less than `size`, none comes twice.
        size: How many there are.
    """
    order = shuffled(key, max(num, size))[:num]
    if num <= size:
        return order
    return shuffled(jax.random.fold_in(key, 1), size)[order % size]  # who comes once more is random
