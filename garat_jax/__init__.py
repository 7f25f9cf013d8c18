"""Ground a simulator in data, and find the physical effect that it is missing.

The public names are imported on first use, so that `import garat_jax` loads neither JAX nor MuJoCo.
"""

import importlib
from typing import Any

__version__ = "0.1.0"

# Public name -> the module that defines it.
_PUBLIC_NAMES: dict[str, str] = {
    "CATALOGUE": "garat_jax.effects",
    "Env": "garat_jax.env",
    "Override": "garat_jax.dynamics",
    "Pair": "garat_jax.transfer",
    "Recording": "garat_jax.diagnosis",
    "RunDirectory": "garat_jax.runs",
    "Task": "garat_jax.env",
    "TransferConfig": "garat_jax.transfer",
    "UserError": "garat_jax.errors",
    "compare": "garat_jax.diagnosis",
    "diagnose": "garat_jax.diagnosis",
    "load_model": "garat_jax.diagnosis",
    "make_world": "garat_jax.env",
    "run_transfer": "garat_jax.transfer",
}

__all__ = ["__version__", *_PUBLIC_NAMES]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    """Import a public name on first use (PEP 562)."""
    if name not in _PUBLIC_NAMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_PUBLIC_NAMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_PUBLIC_NAMES})
