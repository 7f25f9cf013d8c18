"""Recordings of a pendulum that a motor drives, made by C MuJoCo at a 16 times finer timestep."""

from collections.abc import Callable

import mujoco
import numpy as np

from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.model_card import Model
from tests import models

MODEL = Model("pendulum", __file__, __file__, models.spec(models.PENDULUM))
TIME = np.arange(750) * 0.004


def record(
    change: Callable[[mujoco.MjSpec], None],
    seed: int,
    pull: float = 0.0,
    torque: Callable[[float], float] = lambda speed: 0.0,
    ripple: Callable[[float], float] = lambda angle: 0.0,
    control: Callable[[float, float, float], float] | None = None,
    noise: float = 1e-3,
) -> Recording:
    """Record a pendulum that differs from the model, and at which a cable pulls [N m].

    Args:
        change: Makes the difference.
        seed: Draws commands and noise.
        pull: A constant torque.
        torque: One more torque [N m] by the speed [rad/s].
        ripple: And one by the angle [rad].
        control: Gives the command by time, angle and speed, instead of random steps and a sine.
        noise: Standard deviation of the angle [rad]; the speed's is ten times as much [rad/s].
    """
    rng = np.random.default_rng(seed)
    spec = models.spec(models.PENDULUM)
    change(spec)
    spec.option.timestep /= 16
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[0] = 0.8
    ctrl = rng.uniform(-1, 1, 8)[(TIME / 0.4).astype(int)] + 0.5 * np.sin(9 * TIME)
    states = []
    for k, time in enumerate(TIME):
        states.append([data.qpos[0], data.qvel[0]])
        if control is not None:
            ctrl[k] = control(time, *states[-1])
        data.ctrl[0] = ctrl[k]
        for _ in range(round(0.004 / model.opt.timestep)):
            data.qfrc_applied[0] = pull + torque(data.qvel[0]) + ripple(data.qpos[0])
            mujoco.mj_step(model, data)
    states = np.asarray(states) + noise * rng.normal(size=(len(TIME), 2)) * [1.0, 10.0]
    return Recording(
        name=f"pull {pull}, {seed}",
        time=TIME,
        qpos=states[:, :1],
        qvel=states[:, 1:],
        ctrl=ctrl[:, None],
        torque={},
        velocity_measured=True,
        spans=((0, len(TIME)),),
        warnings=(),
    )


def add_damping(spec: mujoco.MjSpec, size: float = 0.02) -> None:
    """Damp the joint more than the model does [N m s/rad]."""
    spec.joint("hinge").damping[0] += size


def add_payload(spec: mujoco.MjSpec, mass: float, x: float, z: float) -> None:
    """Fix a small ball to the pole."""
    ball = mujoco.mjtGeom.mjGEOM_SPHERE
    size, no = [0.01, 0.0, 0.0], 0
    spec.body("pole").add_geom(
        type=ball, size=size, pos=[x, 0.0, z], mass=mass, contype=no, conaffinity=no
    )
