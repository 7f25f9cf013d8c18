"""Control steps in recordings: how long they are, and how far their commands may go."""

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.model_card import Model
from garat_jax.errors import UserError
from garat_jax.methods.recorded import Paths, Steps

Drawn = TypeVar("Drawn", Steps, Paths)

INTERVAL = 0.02
"""Seconds of a control step, unless samples are farther apart: long enough for a change of state to
stand out of the sensors' noise, short against a robot joint's motion."""


class Bounds(NamedTuple):
    """Control steps: seconds of one, and the range of its commands, [nu] each."""

    interval: float
    low: np.ndarray
    high: np.ndarray


def choose_bounds(
    model: Model,
    recordings: Sequence[Recording],
    interval: float | None = None,
    holdout: Sequence[Recording] = (),
) -> Bounds:
    """Choose the control interval and the range of commands that the transformer may use.

    The range is the recorded one, widened by half of itself to each side, within `ctrlrange`.

    Args:
        model: The model.
        recordings: What is learned from.
        interval: Seconds of a control step; by default about `INTERVAL`, in whole samples.
        holdout: What is held out: its samples are to be no farther apart than that, too.

    Raises:
        UserError: The model has no actuator, the interval is shorter than a sample or no finite
            number, or an actuator has neither a `ctrlrange` nor commands that change.
    """
    host = model.compile(engine="mujoco").host.model
    if host.nu == 0:
        raise UserError(
            f"{model.path} has no actuator, and an action transformer changes commands; "
            "garat diagnose finds what is missing in passive motion"
        )
    sample = max(r.interval for r in (*recordings, *holdout))
    if interval is None:
        interval = sample * max(1, round(INTERVAL / sample))
    if not (1 - 1e-3) * sample <= interval < np.inf:
        raise UserError(
            f"--interval {interval:g}: expected a number of seconds, a sample, {sample:.4g} s, "
            "at least"
        )
    limited = host.actuator_ctrllimited.astype(bool)
    lowest, highest = np.where(limited, host.actuator_ctrlrange.T, [[-np.inf], [np.inf]])
    ctrl = np.concatenate([r.ctrl[a:b] for r in recordings for a, b in r.spans])
    ctrl = np.clip(ctrl, lowest, highest)
    low, high = ctrl.min(axis=0), ctrl.max(axis=0)
    room = (high - low) / 2
    for i in np.flatnonzero(room == 0):
        if not limited[i]:
            raise UserError(
                f"the command of actuator {host.actuator(i).name!r} never changes and it has no "
                "ctrlrange, so nothing says how far commands may go: give it a ctrlrange"
            )
    room = np.where(room == 0, np.inf, room)
    return Bounds(interval, np.maximum(low - room, lowest), np.minimum(high + room, highest))


def control_steps(recordings: Sequence[Recording], interval: float) -> Steps:
    """Cut recordings into control steps, one from each sample on; see `control_paths`.

    Raises:
        UserError: No recording is as long.
    """
    start, action, state = control_paths(recordings, interval, 1)
    if not len(start):
        raise UserError(f"no recording has {interval:g} s in a row; give a smaller --interval")
    return Steps(start, action[:, 0], state[:, 0])


def control_paths(
    recordings: Sequence[Recording], interval: float, length: int, every: int = 1
) -> Paths:
    """Cut recordings into paths of control steps, one from each sample on, or from fewer.

    The command of a step is the mean of those held during it; its end is interpolated between
    samples where there is none. There may be no path at all.

    Args:
        recordings: What was measured.
        interval: Seconds of a step.
        length: Steps of a path.
        every: Samples from the start of a path to that of the next.
    """
    parts = []
    for recording in recordings:
        for a, b in recording.spans:
            time, state = recording.time[a:b], _state(recording)[a:b]
            held = np.diff(time)[:, None] * recording.ctrl[a : b - 1]
            integral = np.concatenate([np.zeros((1, held.shape[1])), np.cumsum(held, axis=0)])
            starts = np.flatnonzero(time + length * interval <= time[-1] + 1e-6 * interval)
            starts = starts[::every]
            at = time[starts, None] + interval * np.arange(length + 1)
            travelled = np.diff(_interpolate(at, time, integral), axis=1)
            ends = _interpolate(at[:, 1:], time, state)
            parts.append(Paths(state[starts], travelled / interval, ends))
    return Paths(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def longest_path(recordings: Sequence[Recording], interval: float) -> int:
    """Return how many control steps the longest stretch without a gap lasts, 1 or more."""
    seconds = max(r.time[b - 1] - r.time[a] for r in recordings for a, b in r.spans)
    return max(1, int(seconds / interval + 1e-6))


def _state(recording: Recording) -> np.ndarray:
    return np.concatenate([recording.qpos, recording.qvel], axis=1)


def _interpolate(at: np.ndarray, time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return columns [T, C] between samples, [..., C]."""
    return np.stack([np.interp(at, time, column) for column in values.T], axis=-1)


def draw(recorded: Drawn, most: int, rng: np.random.Generator) -> Drawn:
    """Return at most so many of the steps or paths, drawn at random."""
    chosen = rng.permutation(len(recorded[0]))[:most]
    return type(recorded)(*(column[chosen] for column in recorded))
