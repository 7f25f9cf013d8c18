"""Sizes at which to try effects, as recordings and the torque missing in them suggest."""

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
    """Ask each effect at a hinge, slide or actuator what was missing or asked for there.

    Args:
        effects: The candidates.
        host: The compiled model as it is; what acts on its commands, or by forces, is not in it.
        recordings: What was measured.

    Returns:
        Suggestions by the effect's index.
    """
    asked = {index: effect for index, effect in enumerate(effects) if _may_answer(effect)}
    if not asked:
        return {}
    missing = missing_torque(host, recordings)
    answers = {index: _suggestion(effect, missing) for index, effect in asked.items()}
    return {index: answer for index, answer in answers.items() if answer is not None}


def _may_answer(effect: Effect) -> bool:
    """Say whether an effect has suggestions at all."""
    return any(
        getattr(type(effect), name).__func__ is not getattr(Effect, name).__func__
        for name in ("suggested", "suggested_by_commands")
    )


def _suggestion(effect: Effect, missing: MissingTorque) -> Suggestion | None:
    """Return an effect's suggestion, None if it has none."""
    element, _, name = effect.target.partition("/")
    if element == "actuator":
        at = missing.actuators.index(name)
        return effect.suggested_by_commands(missing.ctrl[:, at], missing.drive[:, at])
    if element != "joint" or missing.dofs.count(name) != 1:
        return None
    dof = missing.dofs.index(name)
    torque, rests = missing.torque[:, dof], _ripples(missing, dof)
    return effect.suggested(missing.position[:, dof], torque, rests)


def _ripples(m: MissingTorque, dof: int) -> np.ndarray:
    """Return the torque missing at a dof less what smooth laws and dry friction explain, [2, M].

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
    rests = (
        without(torque, orthonormal(np.stack(columns, axis=1)))[:, 0]
        for columns in (laws, [*laws, m.command[:, dof]])
    )
    return np.stack(list(rests))
