"""Parameters where they act: units and bounds at a slide joint differ from those at a hinge."""

import mujoco
import numpy as np

from garat_jax.effects.base import Parameter
from garat_jax.effects.elements import element_id
from garat_jax.effects.gear import pushes

LEVER = 0.1
"""Lever [m] at which a slide's bounds are a hinge's: 50 N m are 500 N, 100 N m s/rad 1e4 N s/m."""


def unit_at(parameter: Parameter, host: mujoco.MjModel, target: str) -> str:
    """Return a parameter's unit at a target: a slide joint has N and m for N m and rad."""
    return at_slide(parameter.unit) if _is_linear(host, target) else parameter.unit


def parameter_at(parameter: Parameter, host: mujoco.MjModel, target: str) -> Parameter:
    """Return a parameter as declared, or with wider bounds at a slide or a long body.

    At a slide forces, dampings and masses have them, by the power of a lever, and its unit; angles
    and speeds do not, nor has a bound that means "no effect". Places on a body that reaches further
    than half a metre may be as far as twice that.
    """
    unit, wider = unit_at(parameter, host, target), 1.0
    if unit != parameter.unit:
        per_angle = parameter.unit.count("rad") + parameter.unit.count("rad²")
        is_inertia, is_force = parameter.unit == "kg m²", parameter.unit.count("N m")
        wider = LEVER ** -(2 if is_inertia else is_force * (1 + per_angle))
    elif target.startswith("body/") and unit == "m":
        wider = max(1.0, 2.0 * _reach(host, target.partition("/")[2]))
    low, high = (
        bound if bound == parameter.nominal else bound * wider
        for bound in (parameter.low, parameter.high)
    )
    return parameter._replace(unit=unit, low=low, high=high)


def at_slide(unit: str) -> str:
    """Return the unit that a slide joint has in place of a hinge's."""
    return "kg" if unit == "kg m²" else unit.replace("N m", "N").replace("rad", "m")


def _reach(host: mujoco.MjModel, name: str) -> float:
    """Return how far a body reaches from its frame's origin, about, m."""
    body = host.body(name)
    gyration = np.sqrt(body.inertia.max() / max(float(body.mass[0]), 1e-9))
    return float(np.linalg.norm(body.ipos) + gyration)


def _is_linear(host: mujoco.MjModel, target: str) -> bool:
    """Say whether a target is a slide, or an actuator that drives one or pushes a body or site."""
    element, _, name = target.partition("/")
    if element == "joint":
        return host.jnt_type[element_id(host, "joint", name)] == mujoco.mjtJoint.mjJNT_SLIDE
    return element == "actuator" and pushes(host, element_id(host, "actuator", name))
