"""What an actuator's force is multiplied by where it acts: at a joint, a tendon or a site."""

import mujoco
import numpy as np

from garat_jax.effects.at_joint import AT_JOINT

FREE = int(mujoco.mjtJoint.mjJNT_FREE)
AXES: dict[int | None, int] = {FREE: 6, int(mujoco.mjtJoint.mjJNT_BALL): 3}
"""Components of `gear` at a joint of more than one dof; anywhere else but at a site one counts."""
AT_SITE = int(mujoco.mjtTrn.mjTRN_SITE)


def pushes(host: mujoco.MjModel, actuator: int) -> bool:
    """Say whether what an actuator gives is a force, N, and no torque.

    Args:
        host: The compiled model.
        actuator: The actuator's index.
    """
    joint_type = _joint_type(host, actuator)
    if host.actuator_trntype[actuator] == AT_SITE or joint_type == FREE:
        return not np.any(host.actuator_gear[actuator, 3:])
    return joint_type == int(mujoco.mjtJoint.mjJNT_SLIDE)


def gear_of(host: mujoco.MjModel, actuator: int) -> float:
    """Return the factor from an actuator's force to its torque, never 0: 1 where the gear is nil.

    With several axes it is the gear's length, and the torque is that along its direction.

    Args:
        host: The compiled model.
        actuator: The actuator's index.
    """
    transmission = int(host.actuator_trntype[actuator])
    return _factor(host.actuator_gear[actuator], transmission, _joint_type(host, actuator))


def gear_in(spec: mujoco.MjSpec, actuator: mujoco.MjsActuator) -> float:
    """Return the same of an actuator of a model that is not compiled yet."""
    transmission = int(actuator.trntype)
    joint_type = int(spec.joint(actuator.target).type) if transmission in AT_JOINT else None
    return _factor(actuator.gear, transmission, joint_type)


def _joint_type(host: mujoco.MjModel, actuator: int) -> int | None:
    """Return the type of the joint at which an actuator acts, None if it acts elsewhere."""
    if int(host.actuator_trntype[actuator]) not in AT_JOINT:
        return None
    return int(host.jnt_type[host.actuator_trnid[actuator, 0]])


def _factor(gear: np.ndarray, transmission: int, joint_type: int | None) -> float:
    num_axes = 6 if transmission == AT_SITE else AXES.get(joint_type, 1)
    return float(gear[0] if num_axes == 1 else np.linalg.norm(gear[:num_axes])) or 1.0
