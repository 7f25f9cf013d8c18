"""The seven robots, how each is excited, and what is typical of its motion."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np

ASSETS = Path(__file__).resolve().parent / "assets"
IDLE = 0.4
"""Seconds without a command at the start of a recording, and once more within it."""
EDGE = 0.2
"""Seconds in which a smooth command swells after it was idle."""
HOLD = (0.25, 0.9)
"""Seconds that a step of a step train lasts."""


@dataclasses.dataclass(frozen=True)
class Robot:
    """A robot and its experiments.

    Attributes:
        name: Its MJCF's name.
        amplitude: Largest deviation of each actuator's command from its centre.
        centre: Command at which it is idle, by actuator; 0 where not given.
        start: Initial positions by joint; 0 where not given.
        band: Lowest and highest frequency of the commands, Hz.
        noise: Standard deviation of an angle's (or a place's) and a speed's noise.
    """

    name: str
    amplitude: Mapping[str, float]
    centre: Mapping[str, float] = dataclasses.field(default_factory=dict)
    start: Mapping[str, float] = dataclasses.field(default_factory=dict)
    band: tuple[float, float] = (0.2, 2.0)
    noise: tuple[float, float] = (5e-4, 8e-3)

    @property
    def mjcf(self) -> Path:
        """The model under diagnosis."""
        return ASSETS / f"{self.name}.xml"

    def set_start(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Write the initial positions, also those of joints that follow a named one."""
        for joint in range(model.njnt):
            name = model.joint(joint).name.removeprefix("rotor of ")
            data.qpos[model.jnt_qposadr[joint]] = self.start.get(name, 0.0)


_LEGS = ("fl", "fr", "rl", "rr")
ROBOTS: dict[str, Robot] = {
    "pendulum": Robot("pendulum", {"motor": 0.8}),
    "cart_pole": Robot("cart_pole", {"force": 6.0}, band=(0.4, 2.5)),
    "arm2": Robot("arm2", {"shoulder": 1.1, "elbow": 0.6}),
    "arm6": Robot(
        "arm6",
        {"pan": 0.7, "lift": 0.5, "elbow": 0.6, "roll": 0.7, "pitch": 0.7, "yaw": 0.7},
    ),
    "puck": Robot("puck", {"push_x": 2.2, "push_y": 2.2}, band=(0.4, 2.5), noise=(3e-4, 6e-3)),
    "hopper": Robot(
        "hopper",
        {"hip": 0.4, "knee": 0.7},
        centre={"hip": 0.5, "knee": -1.0},
        start={"hip": 0.5, "knee": -1.0, "height": -0.088},
        band=(0.4, 3.0),
    ),
    "legs": Robot(
        "legs",
        {f"{leg}_{joint}": size for leg in _LEGS for joint, size in (("hip", 0.5), ("knee", 0.6))},
        centre={f"{leg}_{joint}": c for leg in _LEGS for joint, c in (("hip", 0.2), ("knee", -1))},
        start={f"{leg}_{joint}": c for leg in _LEGS for joint, c in (("hip", 0.2), ("knee", -1))},
        band=(0.2, 2.5),
    ),
}


def excite(robot: Robot, index: int, time: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Make one recording's commands [T, nu]: multi-sine, steps, chirp, or multi-sine and steps.

    The commands are idle at the start and once more later, and stay within the limits.
    """
    columns = []
    pause = rng.uniform(0.4, 0.8) * time[-1]
    for name, amplitude in robot.amplitude.items():
        smooth = _chirp(robot, time, rng) if index % 4 == 2 else _multisine(robot, time, rng)
        window = np.minimum(_swell(time, IDLE), 1.0 - _swell(time, pause) + _swell(time, pause + 1))
        steps = _steps(time, pause, rng)
        smooth = smooth * window
        shape = (smooth, steps, smooth, 0.6 * smooth + 0.4 * steps)[index % 4]
        columns.append(robot.centre.get(name, 0.0) + amplitude * shape)
    model = mujoco.MjModel.from_xml_path(str(robot.mjcf))
    low, high = model.actuator_ctrlrange.T
    return np.clip(np.stack(columns, axis=1), low, high)


def _swell(time: np.ndarray, begin: float) -> np.ndarray:
    """Rise from 0 at a time to 1 smoothly."""
    return 0.5 - 0.5 * np.cos(np.pi * np.clip((time - begin) / EDGE, 0.0, 1.0))


def _multisine(robot: Robot, time: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    count = 6
    frequencies = np.geomspace(*robot.band, count) * rng.uniform(0.85, 1.15, count)
    waves = np.sin(2 * np.pi * time[:, None] * frequencies + rng.uniform(0, 2 * np.pi, count))
    total = waves.sum(axis=1)
    return total / np.abs(total).max()


def _chirp(robot: Robot, time: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    low, high = robot.band
    low, high = low * rng.uniform(0.8, 1.2), high * rng.uniform(0.8, 1.2)
    growth = np.log(high / low) / time[-1]
    phase = 2 * np.pi * low * np.expm1(growth * time) / growth + rng.uniform(0, 2 * np.pi)
    return np.sin(phase) * rng.uniform(0.7, 1.0)


def _steps(time: np.ndarray, pause: float, rng: np.random.Generator) -> np.ndarray:
    edges = IDLE + np.cumsum(rng.uniform(*HOLD, int(time[-1] / HOLD[0]) + 1))
    levels = np.concatenate([[0.0], rng.uniform(-1, 1, len(edges))])
    shape = levels[np.searchsorted(edges, time, side="right")]
    return np.where((time > pause) & (time < pause + 0.8), 0.0, shape)


@dataclasses.dataclass(frozen=True)
class Scene:
    """A robot's model without a secret, and how large things are when it moves.

    Attributes:
        robot: Which.
        model: The model under diagnosis.
        speed: Root mean square of each dof's speed, [nv].
        travel: Standard deviation of each dof's position, [nv].
        torque: Typical torque of each dof: of its actuator, gravity or inertia, [nv].
        inertia: Typical inertia of each dof, [nv].
        force: Each actuator's largest force but for rare peaks, [nu].
        command: Root mean square of each actuator's command about its centre, [nu].
        body_speed: Root mean square of each body's centre of mass's speed, [nbody].
        gravity: Root mean square of each dof's gravity torque, [nv].
    """

    robot: Robot
    model: mujoco.MjModel
    speed: np.ndarray
    travel: np.ndarray
    torque: np.ndarray
    inertia: np.ndarray
    force: np.ndarray
    command: np.ndarray
    body_speed: np.ndarray
    gravity: np.ndarray

    def dof(self, joint: str) -> int:
        """Return the dof of a hinge or slide."""
        return int(self.model.joint(joint).dofadr[0])

    def joint_of(self, actuator: str) -> str:
        """Return the joint that an actuator drives."""
        return self.model.joint(int(self.model.actuator(actuator).trnid[0])).name

    def driven(self) -> dict[str, str]:
        """Return the actuator of each joint that has one."""
        names = [self.model.actuator(i).name for i in range(self.model.nu)]
        return {self.joint_of(name): name for name in names}


def _rms(rows: list[np.ndarray]) -> np.ndarray:
    return np.sqrt(np.mean(np.square(rows), axis=0))


def survey(robot: Robot, seed: int = 0) -> Scene:
    """Move the model without a secret at its own timestep and measure how large things are."""
    model = mujoco.MjModel.from_xml_path(str(robot.mjcf))
    data = mujoco.MjData(model)
    robot.set_start(model, data)
    rng = np.random.default_rng(seed)
    time = np.arange(round(6.0 / model.opt.timestep)) * model.opt.timestep
    ctrl = excite(robot, 3, time, rng)
    speeds, places, torques, biases, inertial, diagonals, forces, bodies = ([] for _ in range(8))
    mass, velocity = np.zeros((model.nv, model.nv)), np.zeros(6)
    for row in ctrl:
        data.ctrl[:] = row
        mujoco.mj_step(model, data)
        mujoco.mj_fullM(model, data, mass)
        diagonal = np.diag(mass).copy()
        speeds.append(data.qvel.copy())
        places.append(data.qpos.copy())
        torques.append(data.qfrc_actuator.copy())
        biases.append(data.qfrc_bias.copy())
        inertial.append(diagonal * data.qacc)
        diagonals.append(diagonal)
        forces.append(np.abs(data.actuator_force))
        along = []
        for body in range(model.nbody):
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, velocity, 0)
            along.append(np.linalg.norm(velocity[3:]))
        bodies.append(np.asarray(along))
    bias = _rms(biases)
    centre = [robot.centre.get(name, 0.0) for name in robot.amplitude]
    return Scene(
        robot=robot,
        model=model,
        speed=_rms(speeds),
        travel=np.std(places, axis=0),
        torque=np.maximum(np.maximum(_rms(torques), bias), _rms(inertial)),
        inertia=np.mean(diagonals, axis=0),
        force=np.quantile(forces, 0.995, axis=0),
        command=_rms([*(ctrl - centre)]),
        body_speed=_rms(bodies),
        gravity=bias,
    )
