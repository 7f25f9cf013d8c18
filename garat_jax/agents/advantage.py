"""Generalised advantage estimation."""

import jax
import jax.numpy as jnp

from garat_jax.types import Number, Transition


def gae(
    transitions: Transition,
    value: jax.Array,
    next_value: jax.Array,
    discount: Number,
    trace: Number,
) -> tuple[jax.Array, jax.Array]:
    """Estimate advantages and value targets (Schulman et al. 2016, arXiv 1506.02438, eq. 16).

    A terminated step has no next value; a truncated one bootstraps from the observation that
    followed; neither lets the trace run on into the next episode.

    Args:
        transitions: Experience, [T, B].
        value: Values of `obs`, [T, B].
        next_value: Values of `next_obs`, [T, B].
        discount: γ.
        trace: λ.

    Returns:
        Advantages and value targets, [T, B].
    """
    bootstrap = discount * (1 - transitions.terminated) * next_value
    delta = transitions.reward + bootstrap - value
    carries_on = 1.0 - (transitions.terminated | transitions.truncated)

    def step(advantage, inputs):
        delta, carries_on = inputs
        advantage = delta + discount * trace * carries_on * advantage
        return advantage, advantage

    _, advantage = jax.lax.scan(step, jnp.zeros_like(delta[0]), (delta, carries_on), reverse=True)
    return advantage, advantage + value


def standardise(advantage: jax.Array) -> jax.Array:
    """Shift and scale to mean 0 and standard deviation 1."""
    return (advantage - advantage.mean()) / (advantage.std() + 1e-8)
