"""The columns that a recording of a model may have: their names and units."""

from typing import NamedTuple

import mujoco

from garat_jax.effects.elements import DOFS_OF_JOINT, element_names
from garat_jax.errors import UserError


class Signal(NamedTuple):
    """One measured number: its column's name and its unit."""

    name: str
    unit: str


def signals(model: mujoco.MjModel) -> tuple[Signal, ...]:
    """List the measured numbers of a model's state: positions [nq], then velocities [nv].

    Raises:
        UserError: A joint of the model has no name.
    """
    positions, velocities = [], []
    for joint, name in enumerate(joint_names(model)):
        kind = int(model.jnt_type[joint])
        dofs = DOFS_OF_JOINT[kind]
        if dofs == 1:
            unit = "m" if kind == mujoco.mjtJoint.mjJNT_SLIDE else "rad"
            positions.append(Signal(f"qpos.{name}", unit))
            velocities.append(Signal(f"qvel.{name}", f"{unit}/s"))
            continue
        places = ["m"] * (dofs - 3)
        units = [*places, "1", "1", "1", "1"]
        positions += [Signal(f"qpos.{name}.{i}", unit) for i, unit in enumerate(units)]
        units = [*(f"{unit}/s" for unit in places), "rad/s", "rad/s", "rad/s"]
        velocities += [Signal(f"qvel.{name}.{i}", unit) for i, unit in enumerate(units)]
    return (*positions, *velocities)


def torques(model: mujoco.MjModel) -> tuple[Signal, ...]:
    """List the torques that may be measured, one a dof, [nv]."""
    force = {"rad/s": "N m", "m/s": "N"}
    return tuple(
        Signal(name.replace("qvel.", "torque.", 1), force[unit])
        for name, unit in signals(model)[model.nq :]
    )


def joint_names(model: mujoco.MjModel) -> list[str]:
    """List the joints' names.

    Raises:
        UserError: One has none.
    """
    return _named(model, "joint")


def actuator_names(model: mujoco.MjModel) -> list[str]:
    """List the actuators' names.

    Raises:
        UserError: One has none.
    """
    return _named(model, "actuator")


def _named(model: mujoco.MjModel, element: str) -> list[str]:
    names = element_names(model, element)
    if "" in names:
        raise UserError(
            f"{element} {names.index('')} of the model has no name; name it in the MJCF, since the "
            "columns of a recording are named after it"
        )
    return names
