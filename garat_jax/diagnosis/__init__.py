"""From measurements to the missing physical effect."""

from garat_jax.diagnosis.compare import Comparison, compare, run_compare
from garat_jax.diagnosis.diagnose import diagnose
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.model_card import Model, load_model
from garat_jax.diagnosis.results import Diagnosis
from garat_jax.diagnosis.run import run_diagnose

__all__ = [
    "Comparison",
    "Diagnosis",
    "Model",
    "Recording",
    "compare",
    "diagnose",
    "load_model",
    "run_compare",
    "run_diagnose",
]
