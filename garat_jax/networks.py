"""Flax networks: policies, value functions, discriminators."""

from collections.abc import Sequence
from typing import Any

import distrax
import flax.linen as nn
import jax
import jax.numpy as jnp

from garat_jax.types import Number


def forward(network: nn.Module, weights: Any, inputs: jax.Array) -> Any:
    """Apply a network; Flax's `apply` may also return variables, which none of ours has."""
    return network.apply(weights, inputs)


class MLP(nn.Module):
    """Tanh layers and a linear output, with weights of variance 1 / inputs.

    Orthogonal weights, which many use, need LAPACK's QR. Under `vmap` over seeds several batched
    calls of it run at once, and on a CPU with two threads they have been seen to wait for each
    other for ever (jaxlib 0.10.2).

    Attributes:
        hidden: Widths of the hidden layers.
        size: Width of the output.
        output_scale: Scale of the output layer's initial weights; small ones start near zero.
    """

    hidden: Sequence[int]
    size: int
    output_scale: float = 1.0

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Map [..., inputs] to [..., size]."""
        for width in self.hidden:
            x = nn.tanh(nn.Dense(width)(x))
        output = nn.initializers.variance_scaling(self.output_scale**2, "fan_in", "normal")
        return nn.Dense(self.size, kernel_init=output)(x)


class GaussianPolicy(nn.Module):
    """A diagonal Gaussian over actions whose standard deviation does not depend on the state.

    Attributes:
        size: Number of actions.
        hidden: Widths of the hidden layers.
        initial_log_std: Log of the initial standard deviation, in action units.
    """

    size: int
    hidden: Sequence[int]
    initial_log_std: Number = 0.0

    @nn.compact
    def __call__(self, obs: jax.Array) -> distrax.MultivariateNormalDiag:
        """Map observations [..., obs_size] to a distribution over [..., size]."""
        mean = MLP(self.hidden, self.size, output_scale=0.01)(obs)
        log_std = self.param(
            "log_std", nn.initializers.constant(self.initial_log_std), (self.size,)
        )
        return distrax.MultivariateNormalDiag(mean, jnp.broadcast_to(jnp.exp(log_std), mean.shape))


class ValueNet(nn.Module):
    """The expected return of an observation."""

    hidden: Sequence[int]

    @nn.compact
    def __call__(self, obs: jax.Array) -> jax.Array:
        """Map [..., obs_size] to [...]."""
        return MLP(self.hidden, 1)(obs)[..., 0]


class Discriminator(nn.Module):
    """Tells grounded transitions from target transitions; a high logit means grounded."""

    hidden: Sequence[int]

    @nn.compact
    def __call__(self, features: jax.Array) -> jax.Array:
        """Map normalised (obs, action, next_obs - obs) [..., features] to logits [...]."""
        return MLP(self.hidden, 1)(features)[..., 0]
