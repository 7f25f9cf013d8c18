"""Ground a simulator in data, and find the physical effect that it is missing.

The public names are imported on first use, so that `import garat_jax` loads neither JAX nor MuJoCo.
"""

import importlib
from typing import Any

__version__ = "0.1.0"

# Public name -> the module that defines it.
_PUBLIC_NAMES: dict[str, str] = {
    "CATALOGUE": "garat_jax.effects",
    "Comparison": "garat_jax.diagnosis",
    "Diagnosis": "garat_jax.diagnosis",
    "Effect": "garat_jax.effects",
    "Env": "garat_jax.env",
    "Improvement": "garat_jax.diagnosis.improve",
    "Model": "garat_jax.diagnosis",
    "Override": "garat_jax.dynamics",
    "Pair": "garat_jax.transfer",
    "Recording": "garat_jax.diagnosis",
    "RunDirectory": "garat_jax.runs",
    "Task": "garat_jax.env",
    "TransferConfig": "garat_jax.transfer",
    "UserError": "garat_jax.errors",
    "add": "garat_jax.diagnosis.add",
    "compare": "garat_jax.diagnosis",
    "diagnose": "garat_jax.diagnosis",
    "diagnose_conditions": "garat_jax.diagnosis.conditions",
    "export_mjcf": "garat_jax.diagnosis.export",
    "improve": "garat_jax.diagnosis.improve",
    "load_catalogue": "garat_jax.effects.catalogue",
    "load_model": "garat_jax.diagnosis",
    "make_world": "garat_jax.env",
    "parameter": "garat_jax.effects",
    "plan": "garat_jax.diagnosis.plan",
    "run_compare": "garat_jax.diagnosis",
    "run_diagnose": "garat_jax.diagnosis",
    "run_improve": "garat_jax.diagnosis.improve",
    "run_transfer": "garat_jax.transfer",
    "save_card": "garat_jax.diagnosis.model_card",
    "write_plan": "garat_jax.diagnosis.plan",
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
