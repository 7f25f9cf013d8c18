"""What all tests share: a compilation cache outside the repository, and the measured data."""

import os
import signal
from importlib import metadata
from pathlib import Path

import pytest

from garat_jax import compilation_cache

REPOSITORY = Path(__file__).resolve().parent.parent

# Before the first import of JAX, and inherited by the processes that tests start.
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")
# Tests compile more than they run: these halve the first, and cost a quarter of the second. A flag
# that is gone, as the first is from jaxlib 0.11.1 on, ends the process.
KNOWS_EMITTERS = tuple(map(int, metadata.version("jaxlib").split(".")[:3])) < (0, 11, 1)
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_cpu_use_fusion_emitters=false " * KNOWS_EMITTERS + "--xla_backend_optimization_level=1",
)
compilation_cache.enable()
# Shells have what they start in the background ignore Ctrl-C, and so would the programs that tests
# interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def knows_emitters() -> bool:
    """Whether the installed XLA has a switch for its fusion emitters."""
    return KNOWS_EMITTERS


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root of the source tree."""
    return REPOSITORY


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real measurements: GARAT_DATA, or shared/data beside the repository."""
    folder = Path(os.environ.get("GARAT_DATA") or REPOSITORY.parent / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"no measurements in {folder}; name their folder in GARAT_DATA")
    return folder
