"""XLA's compiler options for programs that step a model."""

import functools
import os
from typing import Any

import jax
import numpy as np

from garat_jax.dynamics import Dynamics

DEEP_CHAIN = 5
"""Joints in a chain from which XLA's CPU fusion emitters slow MJX down; see docs/performance.md."""
FUSION_EMITTERS = "xla_cpu_use_fusion_emitters"
OPTIMISATION_LEVEL = "xla_backend_optimization_level"


def compiler_options(dynamics: Dynamics) -> dict[str, Any]:
    """Return XLA's options for programs that step these dynamics.

    XLA's CPU fusion emitters make MJX up to hundreds of times slower on deep kinematic chains
    (github.com/jax-ml/jax/issues/33761) and shallow ones slightly faster. Around C MuJoCo, which is
    not touched by them, LLVM's higher levels of optimisation cost up to a quarter of the compile
    time and save nothing; see docs/performance.md. What the user put in XLA_FLAGS stays as it is.
    """
    return options_for(dynamics.engine, chain_depth(dynamics))


def options_for(engine: str, depth: int) -> dict[str, Any]:
    """Return XLA's options for an engine and a model with so deep a chain; see `chain_depth`."""
    if jax.default_backend() != "cpu":
        return {}
    options: dict[str, Any] = {}
    if engine == "mujoco":
        options = {OPTIMISATION_LEVEL: 1}
    elif depth >= DEEP_CHAIN:
        options = {FUSION_EMITTERS: False}
    return _free(options)


def options_of_replay(engine: str, runs_often: bool) -> dict[str, Any]:
    """Return XLA's options for a program that replays recordings, one of dozens in a diagnosis.

    Around C MuJoCo the fusion emitters take longer to compile than they save, and so does any
    optimisation of a program that runs only a few times; see docs/performance.md.
    """
    if engine != "mujoco" or jax.default_backend() != "cpu":
        return {}
    return _free({OPTIMISATION_LEVEL: int(runs_often), FUSION_EMITTERS: False})


def _free(options: dict[str, Any]) -> dict[str, Any]:
    """Return those options that the user's XLA_FLAGS leave open and the installed XLA knows."""
    flags = os.environ.get("XLA_FLAGS", "")
    return {k: v for k, v in options.items() if k not in flags and is_known_option(k, v)}


@functools.cache
def is_known_option(name: str, value: bool | int = False) -> bool:
    """Say whether the installed XLA takes a compiler option; it refuses those it does not know."""
    try:
        jax.jit(lambda x: x + 1, compiler_options={name: value}).lower(0.0).compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True


def chain_depth(dynamics: Dynamics) -> int:
    """Return the largest number of degrees of freedom between the world and a body."""
    host = dynamics.host.model
    depth = np.zeros(host.nbody, int)
    for body in range(1, host.nbody):
        depth[body] = depth[host.body_parentid[body]] + host.body_dofnum[body]
    return int(depth.max())
