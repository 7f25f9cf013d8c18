"""Where compiled programs stay from one process to the next: JAX's persistent cache. No JAX."""

import os
import tempfile
from pathlib import Path

FOLDER = "JAX_COMPILATION_CACHE_DIR"
SWITCH = "JAX_ENABLE_COMPILATION_CACHE"
SHORTEST = "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"


def enable() -> None:
    """Have JAX keep each program that it compiles in the user's cache folder.

    It has to be called before JAX is imported, and sets JAX's own environment variables, for the
    processes that this one starts too. Those that are set already stay as they are: FOLDER names
    another folder or, if empty, none; SWITCH=false switches the cache off.
    """
    os.environ.setdefault(SHORTEST, "0")  # the second start of a run compiles nothing
    if FOLDER in os.environ:
        return
    try:
        folder = _user_cache() / "garat_jax" / "jax"
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()  # it may be there and another user's
    except (OSError, RuntimeError):  # no home, or none that can be written to
        return
    os.environ[FOLDER] = str(folder)


def folder() -> Path | None:
    """Return the folder in which programs are kept, None if they are not."""
    is_off = os.environ.get(SWITCH, "true").lower() in ("0", "false", "off", "no", "n", "f")
    name = os.environ.get(FOLDER)
    return Path(name) if name and not is_off else None


def _user_cache() -> Path:
    """Return XDG_CACHE_HOME, or what it stands for where it is not set or not absolute."""
    named = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return named if named.is_absolute() else Path.home() / ".cache"
