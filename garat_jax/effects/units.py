"""Units of parameters where they act: those of a slide joint differ from a hinge's."""

import mujoco

from garat_jax.effects.base import Parameter, element_id


def unit_at(parameter: Parameter, host: mujoco.MjModel, target: str) -> str:
    """Return a parameter's unit at a target: a slide joint has N and m for N m and rad.

    So has an actuator that drives one.
    """
    joint = _joint_at(host, target)
    if joint is None or host.jnt_type[joint] != mujoco.mjtJoint.mjJNT_SLIDE:
        return parameter.unit
    return at_slide(parameter.unit)


def at_slide(unit: str) -> str:
    """Return the unit that a slide joint has in place of a hinge's."""
    return "kg" if unit == "kg m²" else unit.replace("N m", "N").replace("rad", "m")


def _joint_at(host: mujoco.MjModel, target: str) -> int | None:
    """Return the joint that a target is or drives, None for any other target."""
    element, _, name = target.partition("/")
    if element == "joint":
        return element_id(host, "joint", name)
    if element != "actuator":
        return None
    actuator = element_id(host, "actuator", name)
    of_joints = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    is_of_joint = int(host.actuator_trntype[actuator]) in map(int, of_joints)
    return int(host.actuator_trnid[actuator, 0]) if is_of_joint else None
