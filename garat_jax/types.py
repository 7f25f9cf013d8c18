"""The vocabulary that environments, agents and methods share."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

Metrics = dict[str, jax.Array]
Number = Any
"""A hyper-parameter: a float, or an array [] that `vmap` varies."""
Params = Any
"""A pytree of arrays that defines an environment, a network or both."""

Policy = Callable[[Params, jax.Array, jax.Array], tuple[jax.Array, jax.Array]]
"""`(params, obs, key) -> (action, log_prob)` for one observation."""


class Transition(NamedTuple):
    """What one control step gave; leading axes are [T, B] in a batch.

    `next_obs` is always the observation before any reset. A step that ends an episode because
    the task says so is `terminated`; one that ends it because time is up is `truncated`. One in
    which physics left the finite numbers is `terminated` and `faulty`: nothing sound followed, its
    reward is 0 and its `next_obs` is its `obs`.
    """

    obs: jax.Array
    action: jax.Array
    reward: jax.Array
    next_obs: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    log_prob: jax.Array
    faulty: jax.Array


class Agent(NamedTuple):
    """A learner of one policy.

    Attributes:
        init: `(key, env_params) -> state`.
        step: `(state, env_params) -> (state, metrics, transitions)`: collect one batch, learn
            from it.
        policy: `(policy_params, obs, key) -> (action, log_prob)`, the stochastic policy.
        mean: `(policy_params, obs) -> action`, its mean action.
        steps_per_iteration: Environment steps that one `step` takes.
    """

    init: Callable[..., Any]
    step: Callable[..., Any]
    policy: Policy
    mean: Callable[[Params, jax.Array], jax.Array]
    steps_per_iteration: int
