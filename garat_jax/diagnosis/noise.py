"""How large the errors of sensors are, white or not, and what is assumed where that is hidden."""

from collections.abc import Sequence

import numpy as np
from scipy import integrate, optimize

from garat_jax.diagnosis.measurements import Recording, noise

SMALLEST_NOISE = 1e-4
"""Noise assumed at least, relative to the signal's standard deviation within segments."""
ROUNDING = 1e-9
"""Part of a signal's standard deviation that is none within segments."""
UNKNOWN_NOISE = 1e-6
"""Noise assumed where no signal of a kind ever changes, in the signals' units."""
KINEMATIC_WINDOWS = np.asarray([0.04, 0.06, 0.09, 0.13, 0.2, 0.3])
"""Seconds over which position and velocity sensors are held against each other."""
HELD_AGAINST = 0.05
"""Seconds over which the velocities' error is averaged, of what grows with time."""


def noise_of(
    recordings: Sequence[Recording], measured: np.ndarray, weight: np.ndarray
) -> np.ndarray:
    """Estimate each signal's error over some recordings, [num_signals].

    Args:
        recordings: What was measured.
        measured: What was cut from them, [S, L, num_signals].
        weight: 0 where that is padding, else 1, [S, L].
    """
    num_position, num_signals = recordings[0].qpos.shape[1], measured.shape[2]
    deviations = _together(recordings)
    if with_velocity := [r for r in recordings if r.velocity_measured]:
        deviations[num_position:] = _together(with_velocity)[num_position:]
    samples, within = measured[weight > 0], _within(measured, weight)
    spread = samples.std(axis=0)
    least = SMALLEST_NOISE * np.where(within > ROUNDING * spread, within, spread)
    deviations = np.maximum(deviations[:num_signals], least)
    is_still = np.ptp(samples, axis=0) == 0
    for kind in (slice(num_position), slice(num_position, num_signals)):
        deviations[kind] = _noise_of_still(deviations[kind], is_still[kind])
    return deviations


def _together(recordings: Sequence[Recording]) -> np.ndarray:
    return np.sqrt(np.mean([signal_noise(r) ** 2 for r in recordings], axis=0))


def _within(measured: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return each signal's standard deviation within segments, [num_signals]: a wheel rolls on."""
    weight = weight[..., None]
    mean = np.sum(weight * measured, axis=1, keepdims=True) / weight.sum(axis=1, keepdims=True)
    return np.sqrt(np.sum(weight * (measured - mean) ** 2, axis=(0, 1)) / weight.sum())


def signal_noise(recording: Recording) -> np.ndarray:
    """Estimate each signal's error, [nq + nv], also where it is not white.

    Noise that changes slowly from sample to sample hides from `noise`, as do filtered velocities,
    but position and velocity sensors then contradict each other. How far the change of a position
    is from the integral of its velocity depends on the time in between: what does not grow with it
    is the positions' error, what grows is the velocities'. (Joints of one dof alone; a quaternion
    is no integral.)
    """
    white = np.asarray(noise(recording))
    num = recording.qpos.shape[1]
    if not recording.velocity_measured or num != recording.qvel.shape[1]:
        return white
    interval = recording.interval
    longest = max(b - a for a, b in recording.spans)
    windows = np.unique(np.maximum(2, np.round(KINEMATIC_WINDOWS / interval).astype(int)))
    windows = windows[windows < longest]
    if len(windows) < 3:
        return white
    apart = _contradictions(recording, windows)
    seconds = windows * interval
    powers = np.stack([np.ones_like(seconds), seconds, seconds**2], axis=1)
    error = white.copy()
    for joint in range(num):
        scale = np.maximum(apart[:, joint], 1e-300)
        constant, walk, drift = optimize.nnls(powers / scale[:, None], np.ones(len(scale)))[0]
        moving = walk / HELD_AGAINST + drift - white[num + joint] ** 2 * interval / HELD_AGAINST
        error[joint] = max(white[joint], np.sqrt(constant / 2))
        error[num + joint] = np.hypot(white[num + joint], np.sqrt(max(moving, 0.0)))
    return error


def _contradictions(recording: Recording, windows: np.ndarray) -> np.ndarray:
    """Return the mean square of change of position less integrated velocity, [windows, nv]."""
    apart = []
    for a, b in recording.spans:
        time, speed = recording.time[a:b], recording.qvel[a:b]
        travelled = integrate.cumulative_trapezoid(speed, time, axis=0, initial=0.0)
        apart.append(recording.qpos[a:b] - travelled)
    return np.stack(
        [
            np.mean(np.concatenate([d[size:] - d[:-size] for d in apart]) ** 2, axis=0)
            for size in windows
        ]
    )


def _noise_of_still(noise: np.ndarray, is_still: np.ndarray) -> np.ndarray:
    """Give signals that never change, whose encoders hide their noise, the most of their kind."""
    most = noise[~is_still].max(initial=0.0) or UNKNOWN_NOISE
    return np.where(is_still, most, noise)
