"""The devices that JAX computes on, and how much memory this process has used."""

import resource
import sys
from typing import Any

import jax

from garat_jax.errors import UserError

NOT_THERE = "Unable to initialize backend"
"""How JAX begins to say that there is no such device."""


def use(device: str) -> list[Any]:
    """Have JAX compute on a kind of device, before anything else asks it to compute.

    Args:
        device: `cpu`, `gpu`, `tpu`, or `auto` for what JAX and JAX_PLATFORMS choose.

    Returns:
        The devices.

    Raises:
        UserError: There is none of that kind.
    """
    if device != "auto":
        # The CPU stays there for what accelerators ask of the host.
        jax.config.update("jax_platforms", device if device == "cpu" else f"{device},cpu")
    try:
        return jax.devices()
    except RuntimeError as error:
        raise describe(error) from error


def describe(error: RuntimeError) -> UserError:
    """Turn JAX's complaint about a device into one for the user."""
    reason = str(error).partition("\n")[0].partition(" (set JAX_PLATFORMS")[0].rstrip(".")
    wanted = str(jax.config.jax_platforms).partition(",")[0]  # pyright: ignore[reportAttributeAccessIssue]
    return UserError(
        f"JAX finds no device {wanted!r} ({reason}); "
        "choose another with --device or the variable JAX_PLATFORMS"
    )


def peak_mebibytes() -> float:
    """Return the largest amount of memory that this process has held so far, in MiB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10
