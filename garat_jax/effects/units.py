"""Units of parameters where they act: those of a slide joint differ from a hinge's."""

import mujoco

from garat_jax.effects.base import Parameter
from garat_jax.effects.elements import element_id
from garat_jax.effects.gear import pushes


def unit_at(parameter: Parameter, host: mujoco.MjModel, target: str) -> str:
    """Return a parameter's unit at a target: a slide joint has N and m for N m and rad.

    So has an actuator that drives one, or pushes a site or a free body.
    """
    element, _, name = target.partition("/")
    if element == "joint":
        is_linear = host.jnt_type[element_id(host, "joint", name)] == mujoco.mjtJoint.mjJNT_SLIDE
    else:
        is_linear = element == "actuator" and pushes(host, element_id(host, "actuator", name))
    return at_slide(parameter.unit) if is_linear else parameter.unit


def at_slide(unit: str) -> str:
    """Return the unit that a slide joint has in place of a hinge's."""
    return "kg" if unit == "kg m²" else unit.replace("N m", "N").replace("rad", "m")
