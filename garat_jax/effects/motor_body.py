"""A motor as a body of its own in MJCF, beside the link that it drives.

Both turn in the same body, so that the motor's angle is in the joint's coordinate, and everything
at the joint can stay as it is.
"""

import mujoco
import numpy as np

from garat_jax.effects.at_joint import drivers
from garat_jax.effects.body import write_inertials
from garat_jax.effects.elements import free_name

NEGLIGIBLE = 1e-9
"""Mass [kg] and inertia [kg m²] of the motor's body, whose inertia is its joint's armature."""


def add_motor(spec: mujoco.MjSpec, host: mujoco.MjModel, name: str, inertia: float) -> str:
    """Move a joint's motor, with its actuators and keyframes, to a body; return that one's name."""
    write_inertials(spec)
    joint, motor = spec.joint(name), free_name(f"{name}_motor", spec.body, spec.joint)
    index = host.joint(name).id
    link = host.jnt_bodyid[index]
    body = joint.parent.parent.add_body(
        name=motor,
        pos=host.body_pos[link],
        quat=host.body_quat[link],
        ipos=[0.0, 0.0, 0.0],
        explicitinertial=True,
        mass=NEGLIGIBLE,
        inertia=[NEGLIGIBLE] * 3,
    )
    apart = body.add_joint(
        name=motor,
        type=joint.type,
        pos=host.jnt_pos[index],
        axis=host.jnt_axis[index],
        ref=joint.ref,
        armature=inertia,
        limited=mujoco.mjtLimited.mjLIMITED_FALSE,
        actfrclimited=joint.actfrclimited,
        actfrcrange=joint.actfrcrange,
    )
    for unset in ("stiffness", "damping", "frictionloss", "springdamper"):
        setattr(apart, unset, 0.0 * np.asarray(getattr(apart, unset)))
    joint.armature -= inertia
    joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
    for number in drivers(host, index):
        actuator = spec.actuators[number]
        actuator.target = motor
        if actuator.inheritrange:  # the motor's joint has no range
            actuator.ctrlrange, actuator.inheritrange = host.actuator_ctrlrange[number], 0.0
    _add_to_keys(spec, name, motor)
    return motor


def add_gear(spec: mujoco.MjSpec, joint: str, motor: str) -> mujoco.MjsTendon:
    """Return a new tendon, idle so far, whose length is the motor's angle less the joint's."""
    name = free_name(f"{joint}_gear", spec.tendon)
    gear = spec.add_tendon(name=name, limited=mujoco.mjtLimited.mjLIMITED_FALSE)
    for unset in ("stiffness", "damping", "frictionloss", "armature", "margin"):
        setattr(gear, unset, 0.0 * np.asarray(getattr(gear, unset)))
    gear.springlength = [0.0, 0.0]
    gear.wrap_joint(motor, 1.0)
    gear.wrap_joint(joint, -1.0)
    return gear


def _add_to_keys(spec: mujoco.MjSpec, joint: str, motor: str) -> None:
    """Put the motor where its joint is in every keyframe, which has no place for it yet."""
    bare = spec.copy()
    for key in bare.keys:
        bare.delete(key)
    host = bare.compile()
    own, new = host.joint(joint), host.joint(motor)
    for key in spec.keys:
        for field in ("qpos", "qvel"):
            values, address = getattr(key, field), f"{field.replace('qvel', 'dof')}adr"
            if len(values):
                place = getattr(own, address)[0]
                setattr(key, field, np.insert(values, getattr(new, address)[0], values[place]))
