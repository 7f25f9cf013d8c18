"""Simulate a robot with its secrets at a fine timestep, and see whether they show."""

from collections.abc import Sequence

import mujoco
import numpy as np

from garat_jax.diagnosis.hidden import delayed, finer_timestep, simulate

from .robots import Scene, excite
from .secrets import Secret

LEAD = 0.5
"""Steps by which positions are ahead of their time: their step takes the velocities at its end."""
WINDOW = 0.5
"""Seconds over which the model without the secret is let run to see whether the secret shows."""


def experiment(scene: Scene, index: int, rate: float, seconds: float, seed: Sequence[int]):
    """Return one recording's sample times [T] and commands [T, nu]."""
    time = np.arange(round(seconds * rate)) / rate
    return time, excite(scene.robot, index, time, np.random.default_rng([*seed, 1, index]))


def measure(
    scene: Scene, secrets: Sequence[Secret], time: np.ndarray, ctrl: np.ndarray, delay: float
) -> np.ndarray:
    """Simulate the truth and return what noiseless sensors say, [T, nq + nv]."""
    robot = scene.robot
    spec = mujoco.MjSpec.from_file(str(robot.mjcf))
    for secret in secrets:
        secret.change(spec, scene)
    spec.option.timestep = finer_timestep(spec.option.timestep, float(time[1] - time[0]))
    model = spec.compile()
    step = model.opt.timestep
    for secret in secrets:
        secret.tune(model)
    data = mujoco.MjData(model)
    robot.set_start(model, data)
    substeps = round((time[1] - time[0]) / step)
    fine = delayed(np.repeat(ctrl, substeps, axis=0), round(delay / step))
    for secret in secrets:
        fine = secret.command(model, fine)
    at = np.arange(len(time)) * substeps - sum(secret.late() for secret in secrets) / step
    qpos, qvel = _sense(model, data, fine, np.maximum(at, 0.0), _combine(secrets, model, scene))
    joints = [scene.model.joint(i).name for i in range(scene.model.njnt)]
    qpos = qpos[:, [int(model.joint(n).qposadr[0]) for n in joints]]
    qvel = qvel[:, [int(model.joint(n).dofadr[0]) for n in joints]]
    for secret in secrets:
        secret.sense(joints, qpos, qvel)
    return np.concatenate([qpos, qvel], axis=1)


def _sense(model: mujoco.MjModel, data: mujoco.MjData, ctrl: np.ndarray, at: np.ndarray, act):
    """Simulate, and return positions [T, nq] and velocities [T, nv] at times `at`, in steps, [T].

    Between steps they are interpolated linearly, positions at the staggered times of the leapfrog
    method, which a semi-implicit step is.
    """
    first = np.floor(at - LEAD)
    steps = first[:, None] + np.arange(3)
    needed, place = np.unique(np.maximum(steps, 0).astype(int), return_inverse=True)
    states = simulate(model, data, ctrl, needed, act)[place.reshape(steps.shape)]
    parts = np.split(states, [model.nq], axis=2)
    weights = (1.0 - np.abs(at[:, None] - lead - steps) for lead in (LEAD, 0.0))
    return [
        np.einsum("tj,tji->ti", np.maximum(weight, 0.0), part)
        for weight, part in zip(weights, parts, strict=True)
    ]


def _combine(secrets: Sequence[Secret], model: mujoco.MjModel, scene: Scene):
    acts = [act for act in (secret.act(model, scene) for secret in secrets) if act]
    if not acts:
        return None
    constant = model.dof_frictionloss.copy()

    def combined(data: mujoco.MjData) -> None:
        model.dof_frictionloss[:] = constant
        data.qfrc_applied[:] = 0
        data.xfrc_applied[:] = 0
        for act in acts:
            act(data)

    return combined


class Eye:
    """Says how much a secret makes the model err, over what noise and its timestep do.

    The model runs at its own timestep for half a second at a time from the true state. The mean
    square of its error without a secret is taken off, and added to the noise's variance. The signal
    that shows the secret most counts.
    """

    def __init__(self, scene: Scene, rate: float, seed: Sequence[int]):
        self._scene = scene
        self._time, self._ctrl = experiment(scene, 3, rate, 4.0, seed)
        self._without = self._squares(())

    def sees(self, secrets: Sequence[Secret]) -> float:
        """Return the error in standard deviations of noise and the timestep's error."""
        more = np.maximum(self._squares(secrets) - self._without, 0.0)
        noise = np.repeat(self._scene.robot.noise, self._scene.model.nv)
        return float(np.sqrt(np.max(more / (noise**2 + self._without))))

    def _squares(self, secrets: Sequence[Secret]) -> np.ndarray:
        error = _prediction_error(self._scene, self._time, self._ctrl, secrets)
        return np.mean(error**2, axis=0)


def _prediction_error(scene: Scene, time, ctrl, secrets: Sequence[Secret]) -> np.ndarray:
    true = measure(scene, secrets, time, ctrl, 0.0)
    model = scene.model
    interval = float(time[1] - time[0])
    substeps = max(1, int(np.ceil(interval / model.opt.timestep - 1e-9)))
    spec = mujoco.MjSpec.from_file(str(scene.robot.mjcf))
    spec.option.timestep = interval / substeps
    model = spec.compile()
    errors = []
    length = max(2, round(WINDOW / interval))
    for begin in range(0, len(time) - length + 1, length):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = np.split(true[begin], 2)
        samples = substeps * np.arange(length)
        held = np.repeat(ctrl[begin : begin + length], substeps, axis=0)
        errors.append(simulate(model, data, held, samples) - true[begin : begin + length])
    return np.concatenate(errors)
