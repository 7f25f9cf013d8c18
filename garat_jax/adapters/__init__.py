"""Bridges to other libraries: their training on our environments, and their environments as ours.

Each library's rules stay on its side of its bridge.
"""

from typing import TYPE_CHECKING

from garat_jax.adapters.brax_side import BraxEnv, BraxSource, brax_on_new_jax, from_brax, to_brax
from garat_jax.env import Env
from garat_jax.errors import UserError
from garat_jax.types import Params

if TYPE_CHECKING:
    from garat_jax.adapters.gymnasium_side import GymnasiumEnv, GymnasiumVectorEnv

__all__ = [
    "BraxEnv",
    "BraxSource",
    "brax_on_new_jax",
    "from_brax",
    "to_brax",
    "to_gymnasium",
    "to_gymnasium_vector",
]


def to_gymnasium(env: Env, params: Params) -> "GymnasiumEnv":
    """Make an environment one of Gymnasium's, for stable-baselines3, CleanRL and the like.

    Any environment will do: a world, a repaired one, a grounded one. It ends its own episodes, with
    `terminated` and `truncated` told apart, so it needs no `TimeLimit`.

    Args:
        env: The environment.
        params: Its parameters.

    Raises:
        UserError: Gymnasium is not installed.
    """
    return _gymnasium_side().GymnasiumEnv(env, params)


def to_gymnasium_vector(
    env: Env, params: Params, num_envs: int, same_step: bool = True
) -> "GymnasiumVectorEnv":
    """Make a batch of environments, stepped as one program, one of Gymnasium's vector environments.

    By default one whose episode ends is reset within the same step (`AutoresetMode.SAME_STEP`): the
    observation before the reset is `infos["final_obs"][i]` where `infos["_final_obs"][i]` is true.

    Args:
        env: The environment.
        params: Its parameters, the same for all.
        num_envs: How many.
        same_step: Whether they are reset within the step; otherwise the next step resets them
            (`AutoresetMode.NEXT_STEP`), as Gymnasium's vector wrappers of observations want it.

    Raises:
        UserError: Gymnasium is not installed.
    """
    return _gymnasium_side().GymnasiumVectorEnv(env, params, num_envs, same_step)


def _gymnasium_side():
    try:
        from garat_jax.adapters import gymnasium_side
    except ModuleNotFoundError as error:
        if error.name != "gymnasium":
            raise
        raise UserError(
            "Gymnasium is not installed; it comes with the extra: pip install 'garat_jax[bench]'"
        ) from error
    return gymnasium_side
