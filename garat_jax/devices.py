"""The devices that JAX computes on, the cores, and how much memory this process has used."""

import os
import resource
import socket
import sys
import time
import traceback
from typing import Any

import jax

from garat_jax.errors import UserError

PATIENCE = 300.0
"""Seconds to wait for process 0, as long as JAX does."""


def num_cores() -> int:
    """Return how many of the machine's cores this process may use.

    One thread for each is enough. More wait for each other: on a core that other work shares, a
    step of eight small simulations takes ten times as long.
    """
    if hasattr(os, "sched_getaffinity"):  # not everywhere
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def use(device: str) -> list[Any]:
    """Have JAX compute on a kind of device, before anything else asks it to compute.

    Args:
        device: `cpu`, `gpu`, `tpu`, or `auto` for what JAX and JAX_PLATFORMS choose.

    Returns:
        The devices.

    Raises:
        UserError: There is none of that kind, or JAX computes on another kind already.
    """
    _prefer(device)
    try:
        devices = jax.devices()
    except (AssertionError, RuntimeError) as error:  # the former if CUDA's plugin is not there
        raise describe(error) from error
    if device not in ("auto", platform := devices[0].platform):
        raise UserError(
            f"JAX computes on {platform!r} already, so {device!r} comes too late; "
            "choose the device before anything asks JAX to compute"
        )
    return devices


def _prefer(device: str) -> None:
    """Tell JAX, which starts its devices when it is first asked for them, which to start."""
    if device != "auto":
        # The CPU stays there for what accelerators ask of the host.
        jax.config.update("jax_platforms", device if device == "cpu" else f"{device},cpu")


def join_processes(
    coordinator: str | None,
    num_processes: int | None,
    process: int | None,
    device: str = "auto",
) -> int:
    """Work with other processes, on the devices of all; before anything asks JAX to compute.

    Args:
        coordinator: Address and port of process 0.
        num_processes: How many there are.
        process: Which of them this is, from 0.
        device: What computes; as for `use`.

    Returns:
        Which of them this is. What is None comes from JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES
        and JAX_PROCESS_ID, or from Slurm or MPI.

    Raises:
        UserError: The processes do not come together, this is none of them, or as `use`.
    """
    _prefer(device)
    # It would take SIGTERM, for those who ask it; here Python's handler ends the run.
    jax.config.update("jax_enable_preemption_service", False)
    address = coordinator or os.environ.get("JAX_COORDINATOR_ADDRESS")
    number = _or_variable(process, "JAX_PROCESS_ID")
    count = _or_variable(num_processes, "JAX_NUM_PROCESSES")
    if count is not None and count < 1:
        raise UserError(f"--num-processes {count}: expected 1 or more")
    if number is not None and count is not None and not 0 <= number < count:
        raise UserError(f"--process-id {number}: expected 0 to {count - 1}")
    if address:
        _check_address(address, wait=bool(number))
    try:
        jax.distributed.initialize(coordinator, count, number)
    except (RuntimeError, ValueError) as error:
        reason = str(error).rstrip(".")
        raise UserError(
            f"the processes do not come together: {reason}; give --coordinator HOST:PORT, "
            "--num-processes N and --process-id K"
        ) from error
    if use(device)[0].platform == "cpu" and jax.process_count() > 1:
        # Of one kept program the collectives run in another order than of the same one compiled
        # anew (jaxlib 0.10.2), and only process 0 keeps them: each would wait for the other.
        jax.config.update("jax_enable_compilation_cache", False)
    return jax.process_index()


def _check_address(address: str, wait: bool) -> None:
    """Refuse an address for which JAX would end the process: no address, or nobody there.

    Args:
        address: Of process 0.
        wait: Wait until somebody answers.
    """
    host, _, port = address.rpartition(":")
    if not host or not (port.isascii() and port.isdigit() and 0 < int(port) < 2**16):
        raise UserError(f"the coordinator is {address!r}; expected HOST:PORT, as node1:1234")
    last = time.monotonic() + PATIENCE
    while wait:
        try:
            socket.create_connection((host.strip("[]"), int(port)), timeout=PATIENCE).close()
            return
        except OSError as error:
            if time.monotonic() > last:
                raise UserError(f"no process 0 answers at {address}: {error}") from error
            time.sleep(1.0)


def _or_variable(number: int | None, variable: str) -> int | None:
    text = os.environ.get(variable)
    if number is not None or not text:
        return number
    if not text.strip().isdecimal():
        raise UserError(f"the variable {variable} is {text!r}; expected a whole number")
    return int(text)


def is_of_devices(error: AssertionError | RuntimeError) -> bool:
    """Say whether JAX raised an error because a device is not there, wherever it was started."""
    if isinstance(error, AssertionError):  # CUDA's plugin is not there; it has no message
        return traceback.extract_tb(error.__traceback__)[-1].filename.endswith("xla_bridge.py")
    return str(error).startswith("Unable to initialize backend")


def describe(error: Exception) -> UserError:
    """Turn JAX's complaint about a device into one for the user."""
    reason = str(error).partition("\n")[0].partition(" (set JAX_PLATFORMS")[0].rstrip(".")
    wanted = str(jax.config.jax_platforms).partition(",")[0]  # pyright: ignore[reportAttributeAccessIssue]
    if wanted in ("gpu", "cuda") and (not reason or "known backends" in reason):  # JAX names ROCm
        reason = "no backend for it is installed; pip install 'garat_jax[cuda]' brings NVIDIA's"
    return UserError(
        f"JAX finds no device {wanted!r} ({reason}); "
        "choose another with the variable JAX_PLATFORMS, or with --device if the command has it"
    )


def peak_mebibytes() -> float:
    """Return the largest amount of memory that this process has held so far, in MiB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10
