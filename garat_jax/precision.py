"""Products of matrices with all of float32's bits, on every device."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax

Inputs = ParamSpec("Inputs")
Output = TypeVar("Output")


def full_precision(function: Callable[Inputs, Output]) -> Callable[Inputs, Output]:
    """Have the products of matrices in a function, and in its derivatives, keep float32's bits.

    By default NVIDIA's GPUs since Ampere round what they multiply to the 10 bits of TF32, and TPUs
    to the 7 of bfloat16, with which physics drifts (google-deepmind/mujoco_playground#86).
    On a CPU nothing changes.
    """

    @functools.wraps(function)
    def precise(*inputs: Inputs.args, **options: Inputs.kwargs) -> Output:
        with jax.default_matmul_precision("highest"):
            return function(*inputs, **options)

    return precise
