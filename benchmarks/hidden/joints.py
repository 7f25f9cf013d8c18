"""Secrets at joints: friction, springs, inertia, gears and encoders."""

import mujoco
import numpy as np

from .robots import Scene
from .secrets import AtDrivenJoint, AtJoint, jitter, signed, slide

SMALLEST_FRICTION = 1e-9
"""Friction loss that makes MuJoCo reserve the constraint's row."""
YIELDS = 0.002
"""How far an end of a play gives way under the joint's torque, relative to the play: what is hidden
is the play, which a law with rigid ends would see larger by twice that."""


class ViscousDamping(AtJoint):
    kind = "viscous_damping"

    @classmethod
    def draw(cls, scene, name, size, rng):
        dof = scene.dof(name)
        return {"coefficient": jitter(0.15 * size, rng) * scene.torque[dof] / scene.speed[dof]}

    def change(self, spec, scene):
        spec.joint(self.name).damping[0] += self["coefficient"]


class CoulombFriction(AtJoint):
    kind = "coulomb_friction"

    @classmethod
    def draw(cls, scene, name, size, rng):
        return {"torque": jitter(0.12 * size, rng) * scene.torque[scene.dof(name)]}

    def change(self, spec, scene):
        spec.joint(self.name).frictionloss += self["torque"]


class VaryingFriction(AtJoint):
    """Dry friction whose size changes with the motion, as MuJoCo's constraint of that size.

    It is added to other dry friction of the joint.
    """

    def change(self, spec, scene):
        spec.joint(self.name).frictionloss += SMALLEST_FRICTION

    def act(self, model, scene):
        dof = int(model.joint(self.name).dofadr[0])

        def act(data):
            model.dof_frictionloss[dof] += self.friction(data, dof)

        return act

    def friction(self, data: mujoco.MjData, dof: int) -> float:
        """Return the friction's size now."""
        raise NotImplementedError


class AsymmetricFriction(VaryingFriction):
    kind = "asymmetric_friction"

    @classmethod
    def draw(cls, scene, name, size, rng):
        dof = scene.dof(name)
        torque = scene.torque[dof]
        ways = rng.permutation(["positive", "negative"])
        drawn = {}
        for part, unit, shares in (
            ("coulomb", torque, (0.18, 0.05)),
            ("viscous", torque / scene.speed[dof], (0.12, 0.04)),
        ):
            drawn |= {
                f"{part}_{way}": jitter(share * size, rng) * unit
                for way, share in zip(ways, shares, strict=True)
            }
        return drawn

    def friction(self, data, dof):
        speed = data.qvel[dof]
        way = "positive" if speed > 0 else "negative"
        data.qfrc_applied[dof] -= self[f"viscous_{way}"] * speed
        return self[f"coulomb_{way}"]


class StribeckFriction(VaryingFriction):
    kind = "stribeck_friction"

    @classmethod
    def draw(cls, scene, name, size, rng):
        dof = scene.dof(name)
        coulomb = jitter(0.1 * size, rng) * scene.torque[dof]
        return {
            "coulomb": coulomb,
            "static": coulomb * rng.uniform(1.6, 2.2),
            "velocity": rng.uniform(0.2, 0.4) * scene.speed[dof],
        }

    def friction(self, data, dof):
        share = np.exp(-((data.qvel[dof] / self["velocity"]) ** 2))
        return self["coulomb"] + (self["static"] - self["coulomb"]) * share


class LoadFriction(VaryingFriction):
    kind = "load_friction"

    @classmethod
    def names(cls, scene):
        return list(scene.driven())

    @classmethod
    def draw(cls, scene, name, size, rng):
        return {"ratio": min(0.6, jitter(0.18 * size, rng))}

    def friction(self, data, dof):
        return self["ratio"] * abs(data.qfrc_actuator[dof])


class QuadraticDrag(AtJoint):
    kind = "quadratic_drag"

    @classmethod
    def draw(cls, scene, name, size, rng):
        dof = scene.dof(name)
        return {"coefficient": jitter(0.12 * size, rng) * scene.torque[dof] / scene.speed[dof] ** 2}

    def act(self, model, scene):
        dof, coefficient = int(model.joint(self.name).dofadr[0]), self["coefficient"]

        def act(data):
            data.qfrc_applied[dof] -= coefficient * abs(data.qvel[dof]) * data.qvel[dof]

        return act


class JointStiffness(AtJoint):
    kind = "joint_stiffness"

    @classmethod
    def draw(cls, scene, name, size, rng):
        dof = scene.dof(name)
        travel = scene.travel[dof]
        return {
            "stiffness": jitter(0.15 * size, rng) * scene.torque[dof] / travel,
            "reference": scene.robot.start.get(name, 0.0) + rng.uniform(-0.8, 0.8) * travel,
        }

    def change(self, spec, scene):
        joint, reference = spec.joint(self.name), self["reference"]
        degrees = spec.compiler.degree and joint.type == mujoco.mjtJoint.mjJNT_HINGE
        joint.springref = np.rad2deg(reference) if degrees else reference
        joint.stiffness[0] = self["stiffness"]


class TorqueOffset(AtJoint):
    kind = "torque_offset"

    @classmethod
    def draw(cls, scene, name, size, rng):
        return {"torque": signed(0.15 * size, rng) * scene.torque[scene.dof(name)]}

    def act(self, model, scene):
        dof = int(model.joint(self.name).dofadr[0])

        def act(data):
            data.qfrc_applied[dof] += self["torque"]

        return act


class CoggingTorque(AtJoint):
    kind = "cogging_torque"

    @classmethod
    def names(cls, scene: Scene):
        return [name for name in super().names(scene) if not slide(scene, name)]

    @classmethod
    def draw(cls, scene, name, size, rng):
        return {
            "amplitude": jitter(0.15 * size, rng) * scene.torque[scene.dof(name)],
            "periods": float(rng.choice([6, 8, 12, 16])),
            "phase": rng.uniform(-np.pi, np.pi),
        }

    def act(self, model, scene):
        joint = model.joint(self.name)
        dof, place = int(joint.dofadr[0]), int(joint.qposadr[0])

        def act(data):
            angle = self["periods"] * data.qpos[place] + self["phase"]
            data.qfrc_applied[dof] += self["amplitude"] * np.sin(angle)

        return act


class RotorInertia(AtJoint):
    kind = "rotor_inertia"

    @classmethod
    def draw(cls, scene, name, size, rng):
        return {"inertia": jitter(0.2 * size, rng) * scene.inertia[scene.dof(name)]}

    def change(self, spec, scene):
        spec.joint(self.name).armature += self["inertia"]


class Geared(AtDrivenJoint):
    """The actuator turns a rotor of its own, which the link follows through a coupling.

    The rotor carries the joint's armature and, of a servo, the sensor; the recorded joint is the
    link's.
    """

    @classmethod
    def names(cls, scene):
        armature = scene.model.dof_armature
        return [name for name in super().names(scene) if armature[scene.dof(name)] > 0]

    def change(self, spec, scene):
        joint, rotor = spec.joint(self.name), f"rotor of {self.name}"
        link = joint.parent
        body = link.parent.add_body(name=rotor, pos=link.pos, quat=link.quat)
        body.add_joint(
            name=rotor,
            type=joint.type,
            axis=joint.axis,
            pos=joint.pos,
            armature=joint.armature,
            damping=np.zeros(3),  # the model's defaults are the link's
        )
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[1e-3, 0, 0],
            mass=1e-7,
            contype=0,
            conaffinity=0,
        )
        joint.armature = 0
        for actuator in spec.actuators:
            if actuator.target == self.name:
                actuator.target = rotor

    def act(self, model, scene):
        joint, rotor = model.joint(self.name), model.joint(f"rotor of {self.name}")
        at, behind = int(joint.qposadr[0]), int(rotor.qposadr[0])
        dof, dof_behind = int(joint.dofadr[0]), int(rotor.dofadr[0])
        stiffness, damping, play = self.coupling(scene)

        def act(data):
            twist = data.qpos[behind] - data.qpos[at]
            stretch = twist - min(max(twist, -play), play)
            torque = stiffness * stretch
            if stretch or not play:
                torque += damping * (data.qvel[dof_behind] - data.qvel[dof])
            data.qfrc_applied[dof] += torque
            data.qfrc_applied[dof_behind] -= torque

        return act

    def coupling(self, scene: Scene) -> tuple[float, float, float]:
        """Return the coupling's stiffness, damping and the free play to either side."""
        raise NotImplementedError


def _link_inertia(scene: Scene, dof: int) -> float:
    """Return the inertia that the coupling at a joint turns, without its rotor's."""
    return max(scene.inertia[dof] - scene.model.dof_armature[dof], 1e-4)


class Backlash(Geared):
    kind = "backlash"

    @classmethod
    def draw(cls, scene, name, size, rng):
        return {"gap": jitter(0.03 * size, rng)}

    def coupling(self, scene):
        dof = scene.dof(self.name)
        stiffness = scene.torque[dof] / (YIELDS * self["gap"])
        rotor, link = scene.model.dof_armature[dof], _link_inertia(scene, dof)
        damping = np.sqrt(stiffness * rotor * link / (rotor + link))
        return stiffness, damping, self["gap"] / 2


class JointFlexibility(Geared):
    kind = "joint_flexibility"

    @classmethod
    def draw(cls, scene, name, size, rng):
        dof = scene.dof(name)
        stiffness = scene.torque[dof] / jitter(0.03 * size, rng)
        damping = rng.uniform(0.1, 0.3) * np.sqrt(stiffness * _link_inertia(scene, dof))
        return {"stiffness": stiffness, "damping": damping}

    def coupling(self, scene):
        return self["stiffness"], self["damping"], 0.0


class EncoderOffset(AtJoint):
    kind = "encoder_offset"

    @classmethod
    def draw(cls, scene, name, size, rng):
        return {"offset": signed(0.04 * size, rng)}

    def sense(self, joints, qpos, qvel):
        qpos[:, joints.index(self.name)] += self["offset"]


class EncoderScale(AtJoint):
    kind = "encoder_scale"

    @classmethod
    def draw(cls, scene, name, size, rng):
        return {"scale": 1.0 + signed(0.05 * size, rng)}

    def sense(self, joints, qpos, qvel):
        at = joints.index(self.name)
        qpos[:, at] *= self["scale"]
        qvel[:, at] *= self["scale"]
