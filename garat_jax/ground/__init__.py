"""Black-box grounding on measurements: what is left once physics is repaired goes to GAT or GARAT.

The source is a model with the effects that its card has; the target is the machine, known by its
recordings alone. What is learned is an action transformer.
"""

from garat_jax.ground.learn import Grounded, ground
from garat_jax.ground.run import run_ground
from garat_jax.ground.source import load_grounded
from garat_jax.transfer import GroundConfig

__all__ = ["GroundConfig", "Grounded", "ground", "load_grounded", "run_ground"]
