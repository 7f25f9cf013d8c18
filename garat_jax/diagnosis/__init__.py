"""From measurements to the missing physical effect."""

from garat_jax.diagnosis.compare import run_compare

__all__ = ["run_compare"]
