"""What a result has to name besides its settings: commit, versions and machine. No JAX."""

import os
import platform
import subprocess
from importlib import metadata
from pathlib import Path
from typing import Any

_RECORDED_DISTRIBUTIONS = (
    "garat_jax",
    "brax",
    "distrax",
    "flax",
    "jax",
    "jaxlib",
    "mujoco",
    "mujoco-mjx",
    "numpy",
    "optax",
    "orbax-checkpoint",
)


def provenance() -> dict[str, Any]:
    """Return what a result has to name besides its settings: commit, versions and machine."""
    return {"versions": versions(), "machine": machine(), "git": git_state()}


def versions() -> dict[str, str | None]:
    """Return the installed version of each package that can change a result; None where absent."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for name in _RECORDED_DISTRIBUTIONS:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = None
    return found


def machine() -> dict[str, Any]:
    """Return the machine's system, processor, cores and memory (GiB); None where not known."""
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "cpu": _cpu_model(),
        "cores": os.cpu_count(),
        "memory_gib": _memory_gib(),
    }


def git_state() -> dict[str, Any] | None:
    """Return the commit that the package's source tree is at and whether it was changed.

    Returns:
        `{"commit", "dirty"}`, or None when the package does not run from a source tree of its own.
    """
    tree = Path(__file__).resolve().parent.parent
    top = _git(tree, "rev-parse", "--show-toplevel")
    commit = _git(tree, "rev-parse", "--verify", "HEAD")
    if top is None or commit is None or Path(top).resolve() != tree:
        return None
    return {
        "commit": commit,
        "dirty": bool(_git(tree, "status", "--porcelain", "--untracked-files=no")),
    }


def _git(tree: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", str(tree), *arguments], capture_output=True, text=True, timeout=10
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def _cpu_model() -> str | None:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or None
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or None)


def _memory_gib() -> float | None:
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    except (ValueError, OSError):
        return None
