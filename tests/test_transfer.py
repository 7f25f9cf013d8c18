"""What the transfer experiment does with recorded transitions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from garat_jax.env import EnvState
from garat_jax.rollout import Recorded
from garat_jax.transfer import thinned
from garat_jax.types import Transition


@pytest.mark.parametrize(
    ("wanted", "kept"), [(30, [0, 1, 2, 3, 4, 5]), (15, [0, 2, 4]), (10, [0, 3]), (1, [0])]
)
def test_thinned_keeps_whole_transitions_evenly_in_time(wanted, kept):
    numbers = jnp.arange(2 * 6 * 5).reshape(2, 6, 5)  # seeds, time, environments
    fields = dict.fromkeys(Transition._fields, numbers)
    recorded = Recorded(Transition(**fields), EnvState(*[numbers] * len(EnvState._fields)))
    found = thinned(recorded, wanted)
    for leaf in jax.tree.leaves(found):
        np.testing.assert_array_equal(leaf, numbers[:, kept])
