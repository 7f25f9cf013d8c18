"""Recordings of one rig under several conditions: with and without a payload, cold and warm.

What is found in the recordings of the base condition is shared: it is part of the model when the
recordings of every other condition are diagnosed. What is found there in addition is that
condition's own.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

from garat_jax.diagnosis.diagnose import diagnose
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.model_card import Model
from garat_jax.diagnosis.results import Diagnosis
from garat_jax.diagnosis.view import repaired


def diagnose_conditions(
    model: Model,
    recordings: Sequence[Recording],
    conditions: Mapping[str, Sequence[Recording]],
    holdout: Sequence[Recording] = (),
    say: Callable[[str], None] = lambda message: None,
) -> Diagnosis:
    """Find what a model lacks, and what changes from the base condition to others.

    Args:
        model: The model under diagnosis.
        recordings: What was measured in the base condition.
        conditions: What was measured in each of the others, by its name.
        holdout: Recordings of the base condition to prove the shared effects on.
        say: Told what is being done.

    Returns:
        The diagnosis of the base condition, with that of each other one in `conditions`: there the
        model has the shared effects, and one that is stronger there is found as a second one.
    """
    base = diagnose(model, recordings, holdout, say)
    shared = repaired(model, base.selected)
    found = {}
    for name, measured in conditions.items():
        say(f"the condition {name}")
        found[name] = diagnose(shared, measured, say=say, add_to_present=True)
    return dataclasses.replace(base, conditions=found)
