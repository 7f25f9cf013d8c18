"""Where a model fails: the torque that it lacks, by joint, and what that torque goes with.

The missing torque is inverse dynamics of the measured motion minus the torque that the model's
actuators give, both smoothed by the same filter. It is a second view, independent of the fit.
"""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np
from scipy import signal

from garat_jax.effects.base import DOFS_OF_JOINT, element_names

if TYPE_CHECKING:
    from garat_jax.diagnosis.measurements import Recording

WINDOW = 0.06
"""Seconds of the smoothing filter: short against a robot joint's motion."""
SLOW = 0.25
"""Speed below which a joint counts as slow, relative to its root mean square."""
WORTH_TELLING = 0.05
"""Smallest share of the missing torque that a regime is told for."""


@dataclasses.dataclass(frozen=True)
class Place:
    """One line of the where-it-fails map.

    Attributes:
        signal: The joint.
        share: Share of all the missing torque's squares that the regime at this joint explains.
        regime: When, in words.
        evidence: What shows it, in words, with numbers.
    """

    signal: str
    share: float
    regime: str
    evidence: str


class MissingTorque(NamedTuple):
    """The torque that a model lacks, by dof, over all recordings; also drawn in the report.

    Attributes:
        dofs: Name of each dof's joint.
        actuators: Name of each actuator.
        time: Seconds, [M].
        position: [M, nv]; zero for dofs of ball and free joints.
        velocity: [M, nv].
        acceleration: [M, nv].
        command: Torque of the model's actuators, [M, nv].
        load: Gravity and Coriolis torque, [M, nv].
        torque: What is missing, [M, nv].
        ctrl: The actuators' commands, [M, nu].
        drive: Torque of each of the model's actuators at its joint, [M, nu].
    """

    dofs: tuple[str, ...]
    actuators: tuple[str, ...]
    time: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    command: np.ndarray
    load: np.ndarray
    torque: np.ndarray
    ctrl: np.ndarray
    drive: np.ndarray


def missing_torque(model: mujoco.MjModel, recordings: "Sequence[Recording]") -> MissingTorque:
    """Compute the torque that a model lacks along the recordings.

    Args:
        model: The compiled model, its native fields as its effects leave them.
        recordings: What was measured.
    """
    parts = [_of_span(model, r, slice(*span)) for r in recordings for span in r.spans]
    stacked = [np.concatenate(columns) for columns in zip(*parts, strict=True)]
    actuators = tuple(element_names(model, "actuator"))
    return MissingTorque(_dof_names(model), actuators, *stacked)


def localise(missing: MissingTorque) -> list[Place]:
    """Say in words at which joint and in which regime torque is missing, largest share first."""
    total = float(np.sum(np.var(missing.torque, axis=0) + np.mean(missing.torque, axis=0) ** 2))
    if total == 0.0:
        return []
    places = []
    for dof, name in enumerate(missing.dofs):
        torque = missing.torque[:, dof]
        of_joint = float(np.mean(torque**2)) / total
        for regime, feature, words in _features(missing, dof):
            norm = float(feature @ feature)
            if norm == 0.0:
                continue
            size = float(feature @ torque) / norm
            share = of_joint * size**2 * norm / max(float(torque @ torque), 1e-300)
            if share >= WORTH_TELLING:
                evidence = (
                    f"{100 * share:.0f} % of the missing torque is at {name}, {regime}: "
                    + words.format(size=size, sign="with" if size > 0 else "against")
                )
                places.append(Place(name, share, regime, evidence))
    return sorted(places, key=lambda place: -place.share)


def _features(m: MissingTorque, dof: int):
    """Yield (regime, feature [M], words with {size} and {sign}) for one dof."""
    speed, position = m.velocity[:, dof], m.position[:, dof]
    scale = float(np.sqrt(np.mean(speed**2))) + 1e-12
    direction = np.tanh(speed / (0.05 * scale))
    slow = np.abs(speed) < SLOW * scale
    ones = np.ones_like(speed)
    yield "against or with the motion", direction, "{size:+.3g} N m {sign} the motion, at any speed"
    yield "at low speed, around reversals", direction * slow, "{size:+.3g} N m {sign} the motion"
    yield "in proportion to speed", speed, "{size:+.3g} N m s/rad, {sign} the motion"
    yield (
        "in proportion to speed squared",
        speed * np.abs(speed),
        "{size:+.3g} N m s²/rad², {sign} the motion",
    )
    yield "always", ones, "{size:+.3g} N m whatever the joint does"
    yield "in proportion to the command", m.command[:, dof], "{size:+.3g} of the commanded torque"
    yield (
        "when the command changes",
        np.gradient(m.command[:, dof]),
        "it follows the command's changes",
    )
    yield "in proportion to the load", m.load[:, dof], "{size:+.3g} of the model's own load torque"
    yield (
        "in proportion to acceleration",
        m.acceleration[:, dof],
        "{size:+.3g} kg m², {sign} the acceleration",
    )
    yield "with position", position - position.mean(), "{size:+.3g} N m/rad"
    elapsed = m.time - m.time.min()
    drift = (elapsed - elapsed.mean()) / max(float(elapsed.max()), 1e-12)
    words = "the part of the command that is missing changes by {size:+.3g} from start to end"
    yield "drifting with time, with the command", drift * m.command[:, dof], words


def _of_span(model: mujoco.MjModel, recording: "Recording", span: slice):
    """Return the columns of `MissingTorque` for one span of one recording."""
    time = recording.time[span]
    interval = float(np.median(np.diff(time)))
    size = max(5, 2 * round(0.5 * WINDOW / interval) + 1)
    size = min(size, len(time) - 1 + len(time) % 2)
    velocity = recording.qvel[span]
    acceleration = signal.savgol_filter(velocity, size, 2, deriv=1, delta=interval, axis=0)
    speed = signal.savgol_filter(velocity, size, 2, axis=0)
    data = mujoco.MjData(model)
    rows = []
    for k in range(len(time)):
        data.qpos[:], data.qvel[:] = recording.qpos[span][k], speed[k]
        data.qacc[:], data.ctrl[:] = acceleration[k], recording.ctrl[span][k]
        mujoco.mj_inverse(model, data)
        needed, load = data.qfrc_inverse.copy(), data.qfrc_bias.copy()
        mujoco.mj_fwdActuation(model, data)
        drive = data.actuator_force * model.actuator_gear[:, 0]
        rows.append((needed, load, data.qfrc_actuator.copy(), drive))
    needed, load, given, drive = (np.asarray(column) for column in zip(*rows, strict=True))
    both = signal.savgol_filter(np.hstack([given, drive]), size, 2, axis=0)
    given, drive = both[:, : model.nv], both[:, model.nv :]
    position = _positions(model, recording.qpos[span])
    edge = slice(size // 2, len(time) - size // 2)
    of_dofs = (time, position, speed, acceleration, given, load, needed - given)
    columns = (*of_dofs, recording.ctrl[span], drive)
    return tuple(column[edge] for column in columns)


def _positions(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    positions = np.zeros((len(qpos), model.nv))
    for joint in range(model.njnt):
        if DOFS_OF_JOINT[int(model.jnt_type[joint])] == 1:
            positions[:, model.jnt_dofadr[joint]] = qpos[:, model.jnt_qposadr[joint]]
    return positions


def _dof_names(model: mujoco.MjModel) -> tuple[str, ...]:
    names = element_names(model, "joint")
    return tuple(names[joint] or f"joint {joint}" for joint in model.dof_jntid)
