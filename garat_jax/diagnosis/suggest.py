"""Sizes at which to try effects, as the torque that the model lacks suggests them."""

from collections.abc import Sequence

import mujoco
import numpy as np

from garat_jax.diagnosis.localise import MissingTorque, missing_torque
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.robust import orthonormal, without
from garat_jax.effects import Effect, Suggestion

REVERSED = 0.05
"""Speed, relative to its root mean square, within which dry friction is smoothed here."""


def suggest(
    effects: Sequence[Effect], host: mujoco.MjModel, recordings: Sequence[Recording]
) -> dict[int, Suggestion]:
    """Ask each effect at a hinge or slide that may answer what the torque missing there suggests.

    Args:
        effects: The candidates.
        host: The compiled model as it is; what acts on its commands, or by forces, is not in it.
        recordings: What was measured.

    Returns:
        Suggestions by the effect's index.
    """
    asked = {i: e.target.partition("/")[2] for i, e in enumerate(effects) if _may_answer(e)}
    if not asked:
        return {}
    missing, found = missing_torque(host, recordings), {}
    for index, name in asked.items():
        if missing.dofs.count(name) != 1:
            continue
        dof = missing.dofs.index(name)
        answers = [
            effects[index].suggested(missing.position[:, dof], ripple)
            for ripple in _ripples(missing, dof)
        ]
        kept = [answer for answer in answers if answer is not None]
        if kept:
            starts = tuple(start for answer in kept for start in answer.starts)
            found[index] = Suggestion(starts, sum(answer.num_tried for answer in kept))
    return found


def _may_answer(effect: Effect) -> bool:
    """Say whether an effect at a joint has suggestions at all."""
    return effect.target.startswith("joint/") and (
        type(effect).suggested.__func__ is not Effect.suggested.__func__
    )


def _ripples(m: MissingTorque, dof: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the torque missing at a dof less what smooth laws and dry friction explain, [M] each.

    One is less what follows the command, too: a wrong gain would drown a ripple. In the other a
    controller's command, which fights the ripple and so has it, explains nothing of it. Of
    acceleration, load and command two will do: with one dof their torques add up to what is
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
    ]
    torque = m.torque[:, dof][:, None]
    first, second = (
        without(torque, orthonormal(np.stack(columns, axis=1)))[:, 0]
        for columns in (laws, [*laws, m.command[:, dof]])
    )
    return first, second
