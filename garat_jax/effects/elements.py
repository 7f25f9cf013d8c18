"""Elements of a model: their names and indices, and what joints of a kind have."""

import itertools
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from garat_jax.errors import UserError, unknown_name

DOFS_OF_JOINT = {
    int(mujoco.mjtJoint.mjJNT_FREE): 6,
    int(mujoco.mjtJoint.mjJNT_BALL): 3,
    int(mujoco.mjtJoint.mjJNT_SLIDE): 1,
    int(mujoco.mjtJoint.mjJNT_HINGE): 1,
}

OBJECT_TYPES = {
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "joint": mujoco.mjtObj.mjOBJ_JOINT,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
}
COUNTS = {"body": "nbody", "joint": "njnt", "geom": "ngeom"}


def element_names(host: mujoco.MjModel, element: str) -> list[str]:
    """List the names of a model's bodies, joints, geoms or actuators; nameless ones are ''.

    Raises:
        UserError: Of actuators, as `num_actuators`.
    """
    num = num_actuators(host) if element == "actuator" else getattr(host, COUNTS[element])
    return [mujoco.mj_id2name(host, OBJECT_TYPES[element], i) or "" for i in range(num)]


def num_actuators(host: mujoco.MjModel) -> int:
    """Return how many actuators a model has, each of which has one command.

    Raises:
        UserError: One takes several commands, so that its number is not its command's.
    """
    if host.nactuator != host.nu:
        several = np.flatnonzero(host.actuator_ctrlnum != 1)
        names = [mujoco.mj_id2name(host, OBJECT_TYPES["actuator"], i) or str(i) for i in several]
        raise UserError(
            f"actuator/{', actuator/'.join(names)} does not take one command, as pid and "
            "orientation do not; effects and recordings need a model whose actuators do"
        )
    return host.nu


def element_id(host: mujoco.MjModel, element: str, name: str) -> int:
    """Return an element's index.

    Raises:
        UserError: The model has no such element; the message names the nearest ones.
    """
    names = element_names(host, element)
    if name not in names:
        raise unknown_name(element, name, [known for known in names if known])
    return names.index(name)


def free_name(name: str, *finders: Callable[[str], Any]) -> str:
    """Return a name that nothing has: this one, or with the first number from 2 on.

    Args:
        name: As it would be called.
        finders: Return the element of a spec that has a name, None if none has, as `spec.body`.
    """
    numbered = (f"{name}_{number}" for number in itertools.count(2))
    return next(
        free
        for free in itertools.chain([name], numbered)
        if all(find(free) is None for find in finders)
    )


def as_written(spec: mujoco.MjSpec, joint: mujoco.MjsJoint, position: float) -> float:
    """Return a joint's position [rad or m] in the unit that the spec writes it in."""
    in_degrees = spec.compiler.degree and joint.type == mujoco.mjtJoint.mjJNT_HINGE
    return float(np.rad2deg(position) if in_degrees else position)


def quaternions(host: mujoco.MjModel) -> list[int]:
    """Return where in qpos the quaternions of ball and free joints start."""
    kinds = mujoco.mjtJoint
    offset = {int(kinds.mjJNT_FREE): 3, int(kinds.mjJNT_BALL): 0}
    joints = zip(host.jnt_type, host.jnt_qposadr, strict=True)
    return [int(start) + offset[kind] for kind, start in joints if kind in offset]
