"""What a report shows of recordings that were made under other conditions than the rest."""

import dataclasses
from collections.abc import Mapping, Sequence

from garat_jax.diagnosis.diagnose import split
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.model_card import Model
from garat_jax.diagnosis.report import traces
from garat_jax.diagnosis.results import Diagnosis
from garat_jax.diagnosis.view import look
from garat_jax.report import Section


def condition_sections(
    diagnosis: Diagnosis, model: Model, conditions: Mapping[str, Sequence[Recording]]
) -> list[Section]:
    """Return measured against simulated traces of each condition; they simulate what they show.

    Args:
        diagnosis: What was found.
        model: The model as it was given.
        conditions: The recordings of each condition.
    """
    sections = []
    for name, measured in conditions.items():
        fitted, held_out, _ = split(measured, ())
        everything = (*fitted, *held_out)
        shown = range(len(fitted), len(everything))
        drawn = traces(look(model, everything, shown, diagnosis.under(name)))
        heading = f"{drawn.heading} under the condition {name}"
        sections.append(dataclasses.replace(drawn, heading=heading))
    return sections
