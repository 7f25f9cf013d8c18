"""Sizes at which to try effects, as recordings and the torque missing in them suggest."""

import functools
from collections.abc import Sequence

import mujoco
import numpy as np

from garat_jax.diagnosis.localise import MissingTorque, missing_torque
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.own_effects import asked
from garat_jax.diagnosis.robust import orthonormal, without
from garat_jax.dynamics import Dynamics
from garat_jax.effects import Effect, Suggestion
from garat_jax.effects.most import follow_most

REVERSED = 0.05
"""Speed, relative to its root mean square, within which dry friction is smoothed here."""
UNTOUCHED = 0.2
"""Share of the samples without contact at a joint from which those with one count for no ripple."""


def suggest(
    effects: Sequence[Effect],
    host: mujoco.MjModel,
    recordings: Sequence[Recording],
    world: Dynamics | None = None,
) -> dict[int, Suggestion]:
    """Ask each effect at a hinge, slide or actuator what was missing or asked for there.

    Args:
        effects: The candidates.
        host: The compiled model as it is.
        recordings: What was measured.
        world: The same with its effects; see `missing_torque`.

    Returns:
        Suggestions by the effect's index.
    """
    able = {index: effect for index, effect in enumerate(effects) if _may_answer(effect)}
    if not able:
        return {}
    missing = missing_torque(host, recordings, world)
    torques = functools.cache(lambda dof: (_without_friction(missing, dof), _ripples(missing, dof)))
    answers = {index: _suggestion(effect, missing, torques) for index, effect in able.items()}
    return {index: answer for index, answer in answers.items() if answer is not None}


def _may_answer(effect: Effect) -> bool:
    """Say whether an effect has suggestions at all."""
    names = ("suggested", "suggested_by_commands")
    own, none = ([_code(getattr(cls, name)) for name in names] for cls in (type(effect), Effect))
    return own != none


def _code(method) -> object:
    return getattr(method, "__func__", method)


def _suggestion(effect: Effect, missing: MissingTorque, torques) -> Suggestion | None:
    """Return an effect's suggestion, None if it has none; `torques` of a dof as `suggested` has."""
    element, _, name = effect.target.partition("/")
    if element == "actuator":
        at = missing.actuators.index(name)
        return asked(effect, "suggested_by_commands", missing.ctrl[:, at], missing.drive[:, at])
    if element != "joint" or name not in missing.dofs:
        return None
    dof = missing.dofs.index(name)
    return asked(effect, "suggested", missing.position[:, dof], *torques(dof))


def _without_friction(m: MissingTorque, dof: int) -> np.ndarray:
    """Return the torque missing at a dof less what damping and dry friction explain of it, [M].

    They are fitted beside a line over the position, to most of the torques: those of contacts that
    noise opens and closes are few but huge.
    """
    rub = _friction(m, dof)
    torque = m.torque[:, dof]
    _, factor = follow_most(np.column_stack([m.position[:, dof], rub]), torque)
    return torque - rub @ factor[1:]


def _friction(m: MissingTorque, dof: int) -> np.ndarray:
    """Return the speed of a dof and the sign of dry friction, smoothed at reversals, [M, 2]."""
    speed = m.velocity[:, dof]
    scale = float(np.sqrt(np.mean(speed**2))) + 1e-12
    return np.stack([speed, np.tanh(speed / (REVERSED * scale))], axis=1)


def _ripples(m: MissingTorque, dof: int) -> np.ndarray:
    """Return the torque missing at a dof less what smooth laws and dry friction explain, [2, M].

    It is NaN where the model's contacts act at the joint, unless they seldom do not: noise opens
    and closes them, and what that makes drowns a ripple.

    One is less what follows the command, too: a wrong gain would drown a ripple. In the other a
    controller's command, which fights the ripple and so has it, explains nothing of it. Of
    acceleration, load and command two will do: with one dof their torques add up to what is
    missing, whatever its law.
    """
    counts = m.contact[:, dof] == 0.0
    counts |= counts.mean() < UNTOUCHED
    rub = _friction(m, dof)
    laws = [np.ones(len(rub)), m.position[:, dof], *rub.T, m.load[:, dof]]
    torque, rests = m.torque[counts, dof][:, None], np.full((2, len(rub)), np.nan)
    for rest, columns in zip(rests, (laws, [*laws, m.command[:, dof]]), strict=True):
        basis = orthonormal(np.stack(columns, axis=1)[counts])
        rest[counts] = without(torque, basis)[:, 0]
    return rests
