"""The activation of actuators along recorded commands: filters, integrators and muscles.

Nobody measures an activation. It follows from the commands, but for where it began: there a filter
or muscle is taken to have followed its command for long, which it has forgotten soon, and an
integrator to give no force.
"""

import copy
from collections.abc import Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from garat_jax.effects.elements import element_names
from garat_jax.errors import UserError

if TYPE_CHECKING:
    from garat_jax.diagnosis.measurements import Recording

FOLLOWING = (
    int(mujoco.mjtDyn.mjDYN_FILTER),
    int(mujoco.mjtDyn.mjDYN_FILTEREXACT),
    int(mujoco.mjtDyn.mjDYN_MUSCLE),
)
"""Dynamics whose activation comes to be the command; the first parameter is a time constant, and
of muscles, which let go more slowly than they pull, the second one is, too."""
NO_MOTION = int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_GRAVITY)
"""What is left out where only activations change."""
TIME_CONSTANTS = 3.0
"""After so many an activation has forgotten what it was."""
LONGEST = 2.0
"""Seconds of commands before a segment, at most."""


def forgets_in(model: mujoco.MjModel) -> float:
    """Return the seconds in which the slowest activation follows its command, 0 without any.

    Integrators, which never forget, do not count.
    """
    follows = np.isin(model.actuator_dyntype, FOLLOWING)
    lets_go = model.actuator_dyntype == mujoco.mjtDyn.mjDYN_MUSCLE
    constants = [*model.actuator_dynprm[follows, 0], *model.actuator_dynprm[lets_go, 1]]
    slowest = float(np.max(constants, initial=0.0))
    return min(LONGEST, TIME_CONSTANTS * slowest)


def known_spans(recording: "Recording", seconds: float) -> tuple[tuple[int, int], ...]:
    """Return the spans of a recording in which activations are known: not in its first seconds."""
    first = int(np.searchsorted(recording.time, recording.time[0] + (1 - 1e-9) * seconds))
    return tuple((max(a, first), b) for a, b in recording.spans if b > first)


def check_known(recordings: Sequence["Recording"], seconds: float, least: int) -> None:
    """Refuse a recording of which too little is left where activations are known.

    Args:
        recordings: What was measured.
        seconds: As for `known_spans`.
        least: Samples in a row that must be left.

    Raises:
        UserError: One has fewer.
    """
    for recording in recordings:
        if not any(b - a >= least for a, b in known_spans(recording, seconds)):
            raise UserError(
                f"{recording.name}: the activations with which its actuators began are not "
                f"forgotten before {seconds:.2g} s, and no {least} samples in a row follow; "
                "record for longer, or leave it out"
            )


def never_forgetting(model: mujoco.MjModel) -> list[str]:
    """List the actuators that integrate their commands: of them a recording does not tell all."""
    names = element_names(model, "actuator")
    integrates = model.actuator_dyntype == mujoco.mjtDyn.mjDYN_INTEGRATOR
    return [names[i] for i in np.flatnonzero(integrates)]


def follow_commands(
    model: mujoco.MjModel, begin: np.ndarray, ctrl: np.ndarray, interval: float
) -> np.ndarray:
    """Return the activations at the beginning of each step of held commands.

    Args:
        model: The compiled model.
        begin: State where the commands begin, [nq + nv].
        ctrl: Commands, [T, nu].
        interval: Seconds of a step.

    Returns:
        Activations, [T, na].
    """
    if not model.na:
        return np.zeros((len(ctrl), 0))
    model = copy.copy(model)
    model.opt.disableflags |= NO_MOTION
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    substeps = max(1, int(np.ceil(interval / model.opt.timestep - 1e-6)))
    model.opt.timestep = interval / substeps
    data = mujoco.MjData(model)
    qpos, qvel = np.split(begin, [model.nq])
    data.qpos[:], data.qvel[:] = qpos, qvel
    data.act[:] = _at_rest(model, data, ctrl[0])
    activations = np.empty((len(ctrl), model.na))
    for k, command in enumerate(ctrl):
        activations[k] = data.act
        data.ctrl[:] = command
        for _ in range(substeps):
            mujoco.mj_step(model, data)
            data.qpos[:], data.qvel[:] = qpos, qvel
    return activations


class Follower:
    """Follows the commands of recordings, once for all segments that were cut from them.

    Args:
        model: The compiled model.
        interval: Seconds of a step.
    """

    def __init__(self, model: mujoco.MjModel, interval: float):
        self._model, self._interval = model, interval
        self._ctrl, self._found = np.zeros(0), np.zeros(0)

    def __call__(self, begins: np.ndarray, ctrl: np.ndarray) -> np.ndarray:
        """Return the activations at the beginning of each step, [R, T, na].

        Args:
            begins: State where each recording begins, [R, nq + nv].
            ctrl: Its commands, [R, T, nu].
        """
        if self._ctrl is not ctrl:
            rows = zip(begins, ctrl, strict=True)
            found = [follow_commands(self._model, *row, self._interval) for row in rows]
            self._ctrl, self._found = ctrl, np.stack(found)
        return self._found


def _at_rest(model: mujoco.MjModel, data: mujoco.MjData, ctrl: np.ndarray) -> np.ndarray:
    """Return the activations [na] that were there before the first command changed."""
    data.ctrl[:] = ctrl
    mujoco.mj_forward(model, data)
    without = data.actuator_force.copy()
    data.act[:] = 1.0
    mujoco.mj_fwdActuation(model, data)
    change = data.actuator_force - without
    rest = np.zeros(model.na)
    for i in np.flatnonzero(model.actuator_dyntype != mujoco.mjtDyn.mjDYN_NONE):
        last = model.actuator_actadr[i] + model.actuator_actnum[i] - 1
        if model.actuator_dyntype[i] in FOLLOWING:
            rest[last] = ctrl[i]
        elif model.actuator_dyntype[i] == mujoco.mjtDyn.mjDYN_INTEGRATOR and change[i]:
            rest[last] = -without[i] / change[i]
        if model.actuator_actlimited[i]:
            rest[last] = np.clip(rest[last], *model.actuator_actrange[i])
    return rest
