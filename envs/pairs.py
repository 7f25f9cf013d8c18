"""Pairs of a source and a target world: Desai et al. 2020, table of modified environments."""

from garat_jax.dynamics import Override
from garat_jax.envs.inverted_pendulum import InvertedPendulum
from garat_jax.transfer import Pair

PAIRS: dict[str, Pair] = {
    "inverted_pendulum_heavy": Pair(
        name="inverted_pendulum_heavy",
        summary="InvertedPendulum whose pole weighs 100 kg instead of 4.89 kg",
        task=InvertedPendulum(),
        source=(Override("body", "pole", "mass", 4.89),),
        target=(Override("body", "pole", "mass", 100.0),),
    ),
}
