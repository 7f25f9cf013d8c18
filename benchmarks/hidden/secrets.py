"""How an effect enters the truth: what every secret is, and those outside the catalogue.

Secrets are written for plain MuJoCo at a fine timestep and share nothing with the catalogue's laws.
"""

import abc
import dataclasses
from collections.abc import Callable, Mapping
from typing import ClassVar

import mujoco
import numpy as np
from scipy import signal

from garat_jax.diagnosis.hidden import delayed

from .robots import Scene

Act = Callable[[mujoco.MjData], None]
SIZES = {"small": 0.5, "medium": 1.0, "large": 2.0}
"""Factor on the typical size of an effect."""


@dataclasses.dataclass(frozen=True)
class Secret(abc.ABC):
    """An effect at a place, with its true parameters.

    Attributes:
        target: Where it acts, as in the catalogue.
        parameters: By the catalogue's names.
    """

    target: str
    parameters: Mapping[str, float]

    element: ClassVar[str]
    kind: ClassVar[str]

    @property
    def name(self) -> str:
        """The target without its kind."""
        return self.target.partition("/")[2]

    def __getitem__(self, parameter: str) -> float:
        return self.parameters[parameter]

    @classmethod
    def names(cls, scene: Scene) -> list[str]:
        """List the names of the elements on which it makes sense; "" for the world and all."""
        del scene
        return [""]

    @classmethod
    def targets(cls, scene: Scene) -> list[str]:
        """List the targets on which it makes sense."""
        return [f"{cls.element}/{name}" if name else cls.element for name in cls.names(scene)]

    @classmethod
    @abc.abstractmethod
    def draw(
        cls, scene: Scene, name: str, size: float, rng: np.random.Generator
    ) -> dict[str, float]:
        """Draw parameters of about a size: 1 is typical."""

    def change(self, spec: mujoco.MjSpec, scene: Scene) -> None:  # noqa: B027
        """Change the spec before it is compiled."""

    def tune(self, model: mujoco.MjModel) -> None:  # noqa: B027
        """Change the compiled model."""

    def command(self, model: mujoco.MjModel, ctrl: np.ndarray) -> np.ndarray:
        """Return what becomes of the commands of every fine step, [N, nu]."""
        del model
        return ctrl

    def act(self, model: mujoco.MjModel, scene: Scene) -> Act | None:
        """Return what adds forces before every fine step."""
        del model, scene

    def late(self) -> float:
        """Return the seconds by which sensors are late."""
        return 0.0

    def sense(self, joints: list[str], qpos: np.ndarray, qvel: np.ndarray) -> None:  # noqa: B027
        """Change what the sensors say of some joints, [T, joints] each."""


def jitter(size: float, rng: np.random.Generator) -> float:
    """Return a size within 15 % of the given one."""
    return size * rng.uniform(0.85, 1.15)


def signed(size: float, rng: np.random.Generator) -> float:
    """Return about this size, of either sign."""
    return jitter(size, rng) * rng.choice([-1.0, 1.0])


class AtJoint(Secret):
    """Acts at a joint that moves."""

    element = "joint"

    @classmethod
    def names(cls, scene: Scene) -> list[str]:
        names = [scene.model.joint(i).name for i in range(scene.model.njnt)]
        return [n for n in names if scene.speed[scene.dof(n)] > 0.05]


class AtDrivenJoint(AtJoint):
    """Acts at a joint with an actuator."""

    @classmethod
    def names(cls, scene: Scene) -> list[str]:
        return list(scene.driven())


class AtActuator(Secret):
    """Acts at an actuator."""

    element = "actuator"

    @classmethod
    def names(cls, scene: Scene) -> list[str]:
        return list(scene.driven().values())


class AtMotor(AtActuator):
    """Acts at an actuator whose force is its command times a constant."""

    @classmethod
    def names(cls, scene: Scene) -> list[str]:
        model, plain = scene.model, mujoco.mjtBias.mjBIAS_NONE
        return [n for n in super().names(scene) if model.actuator(n).biastype[0] == plain]


class AtBody(Secret):
    """Acts at a body that moves."""

    element = "body"

    @classmethod
    def names(cls, scene: Scene) -> list[str]:
        model = scene.model
        moves = [b for b in range(1, model.nbody) if scene.body_speed[b] > 0.05]
        return [model.body(b).name for b in moves]


class World(Secret):
    """Acts everywhere."""

    element = "world"


def slide(scene: Scene, joint: str) -> bool:
    """Say whether a joint slides."""
    return scene.model.joint(joint).type[0] == mujoco.mjtJoint.mjJNT_SLIDE


def columns(model: mujoco.MjModel, target: str) -> list[int]:
    """Return the actuators that a target means."""
    name = target.partition("/")[2]
    return [model.actuator(name).id] if name else list(range(model.nu))


class Late(AtActuator):
    """Changes the timing of commands, of one actuator or of all."""

    @classmethod
    def targets(cls, scene: Scene) -> list[str]:
        single = super().targets(scene)
        return single if len(single) == 1 else [*single, "all"]


class ActuatorDelay(Late):
    kind = "actuator_delay"

    @classmethod
    def draw(cls, scene, name, size, rng):
        return {"delay": jitter(0.012 * size, rng)}

    def command(self, model, ctrl):
        ctrl, at = ctrl.copy(), columns(model, self.target)
        whole, part = divmod(self["delay"] / model.opt.timestep, 1.0)
        sooner, later = (delayed(ctrl[:, at], int(whole) + more) for more in (0, 1))
        ctrl[:, at] = (1.0 - part) * sooner + part * later
        return ctrl


class ActuatorLag(Late):
    kind = "actuator_lag"

    @classmethod
    def draw(cls, scene, name, size, rng):
        return {"time_constant": jitter(0.015 * size, rng)}

    def command(self, model, ctrl):
        ctrl, at = ctrl.copy(), columns(model, self.target)
        keep = np.exp(-model.opt.timestep / self["time_constant"])
        after = signal.lfilter([1 - keep], [1, -keep], ctrl[:, at], axis=0, zi=keep * ctrl[:1, at])[
            0
        ]
        ctrl[:, at] = (after + delayed(after, 1)) / 2.0  # the mean of each step
        return ctrl


class MotorDeadband(AtMotor):
    kind = "motor_deadband"

    @classmethod
    def draw(cls, scene, name, size, rng):
        command = scene.command[scene.model.actuator(name).id]
        return {"width": float(jitter(0.2 * size, rng) * command)}

    def command(self, model, ctrl):
        ctrl, at = ctrl.copy(), columns(model, self.target)
        ctrl[:, at] -= np.clip(ctrl[:, at], -self["width"], self["width"])
        return ctrl


class SupplySag(World):
    """The supply's voltage falls while the motors work and recovers when they rest."""

    kind = "supply_sag"

    @classmethod
    def draw(cls, scene, name, size, rng):
        return {"depth": min(0.6, jitter(0.3 * size, rng)), "recovery": rng.uniform(0.8, 1.6)}

    def act(self, model, scene):
        largest, load = np.maximum(scene.force, 1e-6), 0.0
        keep = np.exp(-model.opt.timestep / self["recovery"])

        def act(data):
            nonlocal load
            load = keep * load + (1 - keep) * float(np.mean(np.abs(data.actuator_force) / largest))
            data.qfrc_applied -= min(2.0 * self["depth"] * load, 0.9) * data.qfrc_actuator

        return act


class PeriodicDisturbance(AtJoint):
    """A torque that swings by itself: an unbalanced fan, a neighbouring machine."""

    kind = "periodic_disturbance"

    @classmethod
    def draw(cls, scene, name, size, rng):
        return {
            "torque": jitter(0.25 * size, rng) * scene.torque[scene.dof(name)],
            "frequency": rng.uniform(1.2, 2.6),
            "phase": rng.uniform(-np.pi, np.pi),
        }

    def act(self, model, scene):
        dof = model.joint(self.name).dofadr[0]

        def act(data):
            angle = 2 * np.pi * self["frequency"] * data.time + self["phase"]
            data.qfrc_applied[dof] += self["torque"] * np.sin(angle)

        return act


class DriftingGain(AtActuator):
    """A motor weakens as it warms, from the start of every recording."""

    kind = "drifting_gain"

    @classmethod
    def draw(cls, scene, name, size, rng):
        return {"rate": jitter(0.05 * size, rng)}

    def act(self, model, scene):
        actuator = model.actuator(self.name)
        dof, gear = model.joint(scene.joint_of(self.name)).dofadr[0], actuator.gear[0]

        def act(data):
            lost = min(self["rate"] * data.time, 0.9)
            data.qfrc_applied[dof] -= lost * gear * data.actuator_force[actuator.id]

        return act


class HiddenSecondMass(AtBody):
    """A mass on a spring inside a body: a loose battery, a hanging cable, a tank."""

    kind = "hidden_second_mass"

    @classmethod
    def draw(cls, scene, name, size, rng):
        return {
            "mass": jitter(0.25 * size, rng) * scene.model.body(name).mass[0],
            "frequency": rng.uniform(1.5, 2.5),
        }

    def change(self, spec, scene):
        body = scene.model.body(self.name)
        first = scene.model.jnt_axis[body.jntadr[0]]
        sideways = np.cross(body.ipos, first)
        axis = first if np.linalg.norm(sideways) < 1e-6 else sideways / np.linalg.norm(sideways)
        stiffness = self["mass"] * (2 * np.pi * self["frequency"]) ** 2
        inner = spec.body(self.name).add_body(name="hidden", pos=1.5 * body.ipos)
        inner.add_joint(
            name="hidden",
            type=mujoco.mjtJoint.mjJNT_SLIDE,
            axis=axis,
            stiffness=[stiffness, 0, 0],
            damping=[0.1 * np.sqrt(stiffness * self["mass"]), 0, 0],
        )
        inner.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[0.01, 0, 0],
            mass=self["mass"],
            contype=0,
            conaffinity=0,
        )


OUTSIDE: dict[str, type[Secret]] = {
    cls.kind: cls for cls in (SupplySag, PeriodicDisturbance, DriftingGain, HiddenSecondMass)
}
"""Effects that the catalogue does not have."""
