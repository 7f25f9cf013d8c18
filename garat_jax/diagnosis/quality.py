"""What a recording is worth: its rate, gaps, noise and steps, and how late its commands act.

The command lag is read off inverse dynamics: the torque that the motion took is explained best by
the commands of some moments before. It comes before any fit, and so does not say by which effect.
"""

import copy
import dataclasses
from collections.abc import Mapping

import mujoco
import numpy as np
from scipy import signal

from garat_jax.diagnosis.columns import signals
from garat_jax.diagnosis.filters import even_steps, held, held_means, quantum
from garat_jax.diagnosis.localise import MissingTorque, missing_torque, window_size
from garat_jax.diagnosis.measurements import Recording, between_gaps, noise
from garat_jax.dynamics import Dynamics
from garat_jax.effects.elements import element_names

LAGS = np.arange(-0.02, 0.1001, 0.0005)
"""Seconds among which the lag of commands is sought."""
LIMITED = 0.01
"""Part of the time for which an actuator may be at its limit for its lag to be told."""
TELLING = 1.1
"""How much worse the worst lag must explain the torque than the best, for the best to mean much."""


@dataclasses.dataclass(frozen=True)
class Channel:
    """One measured signal.

    Attributes:
        noise: Standard deviation of its white noise, in `unit`.
        step: Its quantisation, in `unit`; 0 if none shows.
        unit: The signal's unit.
    """

    noise: float
    step: float
    unit: str


@dataclasses.dataclass(frozen=True)
class Quality:
    """What one recording is worth.

    Attributes:
        name: The recording.
        samples: How many.
        seconds: From the first to the last.
        rate: Samples a second, by the median interval.
        irregularity: Largest deviation of an interval from the median, relative to it, gaps aside.
        gaps: How many.
        velocity: `measured`, or `estimated` from positions.
        channels: By signal; velocities only where they were measured.
        command_lag: Seconds between a command and its torque, by actuator; NaN where the recording
            does not tell.
        warnings: What is odd but usable.
    """

    name: str
    samples: int
    seconds: float
    rate: float
    irregularity: float
    gaps: int
    velocity: str
    channels: Mapping[str, Channel]
    command_lag: Mapping[str, float]
    warnings: tuple[str, ...]


def assess(recording: Recording, model: mujoco.MjModel, world: Dynamics | None = None) -> Quality:
    """Assess one recording of a model, `world` with its effects; see `missing_torque`."""
    intervals = np.concatenate([np.diff(recording.time[a:b]) for a, b in recording.spans])
    usual = float(np.median(intervals))
    return Quality(
        name=recording.name,
        samples=len(recording.time),
        seconds=float(recording.time[-1] - recording.time[0]),
        rate=1.0 / usual,
        irregularity=float(np.abs(intervals - usual).max() / usual),
        gaps=len(between_gaps(recording.time)) - 1,
        velocity="measured" if recording.velocity_measured else "estimated",
        channels=_channels(recording, model),
        command_lag=command_lags(recording, model, world),
        warnings=recording.warnings,
    )


def _channels(recording: Recording, model: mujoco.MjModel) -> dict[str, Channel]:
    state = np.concatenate([recording.qpos, recording.qvel], axis=1)
    listed = signals(model)
    num = len(listed) if recording.velocity_measured else model.nq
    deviations = noise(recording)
    return {
        s.name: Channel(float(deviations[i]), quantum(state[:, i]), s.unit)
        for i, s in enumerate(listed[:num])
    }


def command_lags(
    recording: Recording, model: mujoco.MjModel, world: Dynamics | None = None
) -> dict[str, float]:
    """Estimate how late each actuator's command acts, in seconds; NaN where it does not show.

    The needed torque is regressed on the command of d seconds before, beside speed, its sign,
    load and a constant; the d that leaves the least is the lag. Actuators whose force is at its
    limit for long do not tell it, nor do those with an activation.
    """
    names = element_names(model, "actuator")
    gains = torque_per_command(model)
    lags = dict.fromkeys(names, float("nan"))
    spans = [dataclasses.replace(recording, spans=(span,)) for span in recording.spans]
    missing = [(part, missing_torque(model, [part], world)) for part in spans]
    for index, name in enumerate(names):
        dof = int(np.argmax(np.abs(gains[:, index]))) if model.nv else 0
        if gains[dof, index] != 0.0:
            lags[name] = _lag(missing, index, dof, float(gains[dof, index]))
    return lags


def torque_per_command(model: mujoco.MjModel) -> np.ndarray:
    """Return how much each command changes each dof's torque at rest, short of limits, [nv, nu]."""
    model = copy.copy(model)
    model.actuator_forcelimited[:], model.jnt_actfrclimited[:] = 0, 0
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    limited = model.actuator_ctrllimited.astype(bool)
    middle = np.where(limited, model.actuator_ctrlrange.mean(axis=1), 0.0)
    torques = []
    for command in [middle, *(middle + 1e-3 * np.eye(model.nu))]:
        data.ctrl[:] = command
        mujoco.mj_fwdActuation(model, data)
        torques.append(data.qfrc_actuator.copy())
    changes = np.asarray(torques[1:]).reshape(model.nu, model.nv) - torques[0]
    return changes.T / 1e-3


def _lag(parts: list[tuple[Recording, MissingTorque]], index: int, dof: int, gain: float) -> float:
    """Return the lag of one actuator that explains the torque at one dof best."""
    remainders = np.zeros(len(LAGS))
    if np.mean(np.concatenate([m.limited[:, index] for _, m in parts])) > LIMITED:
        return float("nan")
    for part, m in parts:
        (a, b) = part.spans[0]
        time, ctrl = part.time[a:b], part.ctrl[a:b, [index]]
        even = even_steps(time)
        size = window_size(even)
        given = gain * np.asarray(signal.savgol_filter(held(even, time, ctrl)[:, 0], size, 2))
        within = (m.time > m.time[0] + LAGS[-1]) & (m.time < m.time[-1] + LAGS[0])
        if within.sum() < 3 * FEATURES:
            continue
        at = m.time[within]
        target = m.torque[within, dof] + np.interp(at, even, given)
        basis = np.linalg.qr(_nuisances(m, dof)[within])[0]
        target = target - basis @ (basis.T @ target)
        for k, lag in enumerate(LAGS):
            mean = held_means(even - lag, time, ctrl)[:, 0]
            late = gain * np.interp(at, even, np.asarray(signal.savgol_filter(mean, size, 2)))
            late = late - basis @ (basis.T @ late)
            factor = float(late @ target) / max(float(late @ late), 1e-300)
            remainders[k] += float(np.sum((target - max(factor, 0.0) * late) ** 2))
    best = int(np.argmin(remainders))
    if best in (0, len(LAGS) - 1) or remainders.max() <= TELLING * remainders[best]:
        return float("nan")
    low, middle, high = remainders[best - 1 : best + 2]
    bend = low - 2 * middle + high
    shift = 0.5 * (low - high) / bend if bend > 0 else 0.0
    return float(LAGS[best] + shift * (LAGS[1] - LAGS[0]))


FEATURES = 4
"""Columns of `_nuisances`."""


def _nuisances(m: MissingTorque, dof: int) -> np.ndarray:
    speed = m.velocity[:, dof]
    scale = 0.05 * float(np.sqrt(np.mean(speed**2))) + 1e-12
    columns = [speed, np.tanh(speed / scale), m.load[:, dof]]
    return np.stack([np.ones_like(speed), *columns], axis=1)
