"""Secrets at actuators' forces, bodies, contacts and of the world; all secrets by kind."""

import mujoco
import numpy as np

from garat_jax.diagnosis.hidden import add_point_mass

from . import joints
from .robots import Scene
from .secrets import (
    OUTSIDE,
    ActuatorDelay,
    ActuatorLag,
    AtActuator,
    AtBody,
    AtMotor,
    MotorDeadband,
    Secret,
    World,
    jitter,
    signed,
)


class MotorGain(AtActuator):
    kind = "motor_gain"

    @classmethod
    def draw(cls, scene, name, size, rng):
        return {"scale": 1.0 + signed(0.15 * size, rng)}

    def tune(self, model):
        at = model.actuator(self.name).id
        model.actuator_gainprm[at] *= self["scale"]
        model.actuator_biasprm[at] *= self["scale"]


class TorqueSaturation(AtActuator):
    kind = "torque_saturation"

    @classmethod
    def draw(cls, scene, name, size, rng):
        return {"limit": _largest(scene, name) * jitter(max(0.9 - 0.22 * size, 0.2), rng)}

    def change(self, spec, scene):
        actuator = spec.actuator(self.name)
        limit = self["limit"] / actuator.gear[0]
        actuator.forcelimited, actuator.forcerange = 1, [-limit, limit]


class BackEmf(AtActuator):
    kind = "back_emf"

    @classmethod
    def draw(cls, scene, name, size, rng):
        dof = scene.dof(scene.joint_of(name))
        return {"coefficient": jitter(0.15 * size, rng) * scene.torque[dof] / scene.speed[dof]}

    def act(self, model, scene):
        dof = int(model.joint(scene.joint_of(self.name)).dofadr[0])

        def act(data):
            data.qfrc_applied[dof] -= self["coefficient"] * data.qvel[dof]

        return act


class MotorCurve(AtMotor):
    kind = "motor_curve"

    @classmethod
    def draw(cls, scene, name, size, rng):
        largest = _largest(scene, name) * jitter(max(1.2 - 0.3 * size, 0.3), rng)
        return {"saturation": largest, "linear": rng.uniform(0.3, 0.5) * largest}

    def command(self, model, ctrl):
        ctrl, actuator = ctrl.copy(), model.actuator(self.name)
        slope = actuator.gainprm[0] * actuator.gear[0]
        ctrl[:, actuator.id] = self.bend(ctrl[:, actuator.id] * slope) / slope
        return ctrl

    def bend(self, torque: np.ndarray) -> np.ndarray:
        """Return the torque that the motor gives for one that is linear in the current, N m."""
        linear, room = self["linear"], self["saturation"] - self["linear"]
        size = np.abs(torque)
        bent = linear + room * (1 - np.exp(-np.maximum(size - linear, 0.0) / room))
        return np.sign(torque) * np.where(size < linear, size, bent)


def _largest(scene: Scene, actuator: str) -> float:
    """Return an actuator's largest torque at its joint."""
    found = scene.model.actuator(actuator)
    return scene.force[found.id] * found.gear[0]


class PayloadMass(AtBody):
    kind = "payload_mass"

    @classmethod
    def draw(cls, scene, name, size, rng):
        body = scene.model.body(name)
        place = body.ipos * rng.uniform(0.8, 1.9)
        mass = jitter(0.15 * size, rng) * body.subtreemass[0]
        return {"mass": mass, **dict(zip("xyz", map(float, place), strict=True))}

    def change(self, spec, scene):
        add_point_mass(spec.body(self.name), self["mass"], [self[axis] for axis in "xyz"])


class ComOffset(AtBody):
    kind = "com_offset"

    @classmethod
    def names(cls, scene):
        model = scene.model
        return [n for n in super().names(scene) if np.linalg.norm(model.body(n).ipos) > 0.02]

    @classmethod
    def draw(cls, scene, name, size, rng):
        body = scene.model.body(name)
        length = np.linalg.norm(body.ipos)
        sideways = np.cross(body.ipos, scene.model.jnt_axis[body.jntadr[0]])
        shift = signed(0.2 * size, rng) * body.ipos + signed(0.1 * size, rng) * sideways
        return dict(zip("xyz", map(float, np.clip(shift, -length, length)), strict=True))

    def tune(self, model):
        model.body_ipos[model.body(self.name).id] += [self[axis] for axis in "xyz"]
        mujoco.mj_setConst(model, mujoco.MjData(model))


class AirDrag(AtBody):
    kind = "air_drag"

    @classmethod
    def names(cls, scene):
        fast = scene.body_speed > 0.3
        return [n for n in super().names(scene) if fast[scene.model.body(n).id]]

    @classmethod
    def draw(cls, scene, name, size, rng):
        body = scene.model.body(name)
        dof = scene.model.body_dofadr[body.id]
        power = scene.torque[dof] * scene.speed[dof]
        coefficient = jitter(0.12 * size, rng) * power / scene.body_speed[body.id] ** 3
        return {"coefficient": float(coefficient)}

    def act(self, model, scene):
        body, velocity = model.body(self.name).id, np.zeros(6)

        def act(data):
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, velocity, 0)
            along = velocity[3:]
            data.xfrc_applied[body, :3] -= self["coefficient"] * np.linalg.norm(along) * along

        return act


class GravityTilt(World):
    kind = "gravity_tilt"

    @classmethod
    def draw(cls, scene, name, size, rng):
        return {"roll": signed(0.04 * size, rng), "pitch": signed(0.04 * size, rng)}

    def change(self, spec, scene):
        quaternion = np.zeros(4)
        mujoco.mju_euler2Quat(quaternion, [self["roll"], self["pitch"], 0.0], "XYZ")
        turned = np.zeros(3)
        mujoco.mju_rotVecQuat(turned, spec.option.gravity, quaternion)
        spec.option.gravity = turned


class GravityScale(World):
    kind = "gravity_scale"

    @classmethod
    def draw(cls, scene, name, size, rng):
        return {"scale": 1.0 + signed(0.1 * size, rng)}

    def change(self, spec, scene):
        spec.option.gravity = spec.option.gravity * self["scale"]


class AtTouching(Secret):
    """Acts at the geom that touches the ground."""

    element = "geom"

    @classmethod
    def names(cls, scene):
        model = scene.model
        touching = [g for g in range(model.ngeom) if model.geom_contype[g]]
        return [model.geom(g).name for g in touching if model.geom_bodyid[g] != 0]


class ContactFriction(AtTouching):
    kind = "contact_friction"

    @classmethod
    def draw(cls, scene, name, size, rng):
        now = scene.model.geom(name).friction[0]
        return {"sliding": now * (1.0 + signed(0.3 * size, rng))}

    def change(self, spec, scene):
        spec.geom(self.name).friction[0] = self["sliding"]


class ContactCompliance(AtTouching):
    kind = "contact_compliance"

    @classmethod
    def names(cls, scene):
        return [name for name in super().names(scene) if scene.robot.name == "hopper"]

    @classmethod
    def draw(cls, scene, name, size, rng):
        return {
            "time_constant": 0.02 * (1.0 + jitter(0.6 * size, rng)),
            "damping_ratio": max(0.2, 1.0 - jitter(0.25 * size, rng)),
        }

    def change(self, spec, scene):
        for geom in spec.geoms:
            geom.solref = [self["time_constant"], self["damping_ratio"]]


class SensorDelay(Secret):
    element = "all"
    kind = "sensor_delay"

    @classmethod
    def draw(cls, scene, name, size, rng):
        return {"delay": jitter(0.01 * size, rng)}

    def late(self):
        return self["delay"]


CATALOGUED: dict[str, type[Secret]] = {
    cls.kind: cls
    for cls in (
        joints.ViscousDamping,
        joints.CoulombFriction,
        joints.AsymmetricFriction,
        joints.StribeckFriction,
        joints.LoadFriction,
        joints.QuadraticDrag,
        joints.JointStiffness,
        joints.TorqueOffset,
        joints.CoggingTorque,
        joints.RotorInertia,
        joints.Backlash,
        joints.JointFlexibility,
        MotorGain,
        MotorDeadband,
        TorqueSaturation,
        BackEmf,
        MotorCurve,
        ActuatorLag,
        ActuatorDelay,
        PayloadMass,
        ComOffset,
        AirDrag,
        GravityTilt,
        GravityScale,
        ContactFriction,
        ContactCompliance,
        joints.EncoderOffset,
        joints.EncoderScale,
        SensorDelay,
    )
}
"""The kinds that the catalogue is to have, by their names there."""
SECRETS: dict[str, type[Secret]] = {**CATALOGUED, **OUTSIDE}
