"""Parameters where they act: units and bounds at a slide joint differ from those at a hinge."""

import mujoco

from garat_jax.effects.base import Parameter
from garat_jax.effects.elements import element_id
from garat_jax.effects.gear import pushes

LEVER = 0.1
"""Lever [m] at which a slide's bounds are a hinge's: 50 N m are 500 N, 100 N m s/rad 1e4 N s/m."""


def unit_at(parameter: Parameter, host: mujoco.MjModel, target: str) -> str:
    """Return a parameter's unit at a target: a slide joint has N and m for N m and rad."""
    return at_slide(parameter.unit) if _is_linear(host, target) else parameter.unit


def parameter_at(parameter: Parameter, host: mujoco.MjModel, target: str) -> Parameter:
    """Return a parameter as declared, or with a slide's unit and wider bounds at one.

    Forces, dampings and masses have them, by the power of a lever; angles and speeds do not, nor a
    bound that means "no effect".
    """
    if not _is_linear(host, target):
        return parameter
    unit = parameter.unit
    per_angle = unit.count("rad") + unit.count("rad²")
    power = 2 if unit == "kg m²" else unit.count("N m") * (1 + per_angle)
    wider = LEVER**-power
    low, high = (
        bound if bound == parameter.nominal else bound * wider
        for bound in (parameter.low, parameter.high)
    )
    return parameter._replace(unit=at_slide(unit), low=low, high=high)


def at_slide(unit: str) -> str:
    """Return the unit that a slide joint has in place of a hinge's."""
    return "kg" if unit == "kg m²" else unit.replace("N m", "N").replace("rad", "m")


def _is_linear(host: mujoco.MjModel, target: str) -> bool:
    """Say whether a target is a slide, or an actuator that drives one or pushes a body or site."""
    element, _, name = target.partition("/")
    if element == "joint":
        return host.jnt_type[element_id(host, "joint", name)] == mujoco.mjtJoint.mjJNT_SLIDE
    return element == "actuator" and pushes(host, element_id(host, "actuator", name))
