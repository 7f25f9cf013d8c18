"""Sizes at which to try effects, as the torque that the model lacks suggests them."""

from collections.abc import Sequence

import numpy as np

from garat_jax.diagnosis.localise import MissingTorque
from garat_jax.diagnosis.robust import orthonormal, without
from garat_jax.effects import Effect, Suggestion

REVERSED = 0.05
"""Speed, relative to its root mean square, within which dry friction is smoothed here."""


def suggest(effects: Sequence[Effect], missing: MissingTorque) -> dict[int, Suggestion]:
    """Ask each effect at a hinge or slide what the torque missing there suggests.

    Args:
        effects: The candidates.
        missing: What the model lacks; what other laws at a joint could explain is left out.

    Returns:
        Suggestions by the effect's index.
    """
    found = {}
    for index, effect in enumerate(effects):
        element, _, name = effect.target.partition("/")
        if element != "joint" or missing.dofs.count(name) != 1:
            continue
        dof = missing.dofs.index(name)
        suggestion = effect.suggested(missing.position[:, dof], _ripple(missing, dof))
        if suggestion is not None:
            found[index] = suggestion
    return found


def _ripple(m: MissingTorque, dof: int) -> np.ndarray:
    """Return the torque missing at a dof less what smooth laws and dry friction explain, [M].

    Of acceleration, load and command two will do: with one dof their torques add up to what is
    missing, whatever its law.
    """
    speed = m.velocity[:, dof]
    scale = float(np.sqrt(np.mean(speed**2))) + 1e-12
    laws = [
        np.ones_like(speed),
        m.position[:, dof],
        speed,
        np.tanh(speed / (REVERSED * scale)),
        m.load[:, dof],
        m.command[:, dof],
    ]
    return without(m.torque[:, dof][:, None], orthonormal(np.stack(laws, axis=1)))[:, 0]
