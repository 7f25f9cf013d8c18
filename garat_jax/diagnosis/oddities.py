"""What is odd about a recording but usable: units that cannot well be, commands beyond limits.

Three things tell a unit. Measured velocity must be the derivative of measured position, mechanisms
are sampled faster than twice a second, and a motion must be one that the model can nearly make.
"""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from garat_jax.diagnosis.activation import never_forgetting
from garat_jax.diagnosis.columns import actuator_names, signals
from garat_jax.diagnosis.localise import missing_torque
from garat_jax.diagnosis.units import UNITS
from garat_jax.diagnosis.velocity import estimate_velocity
from garat_jax.effects.at_joint import clamps
from garat_jax.effects.elements import DOFS_OF_JOINT

if TYPE_CHECKING:
    from garat_jax.diagnosis.measurements import Recording

LARGEST_ANGLE = 50.0
"""Radians, eight turns, beyond which an angle may well be in degrees."""
FULL_TURN = 2 * np.pi
"""Radians within which an angle may be anything."""
SLACK = 0.5
"""Radians by which a measured angle may leave the joint's range without a word."""
SLOWEST = 0.5
"""Seconds between samples beyond which time is hardly in seconds."""
CLOCKS = ("ms", "us", "ns")
ALIKE = 0.9
"""Cosine between velocity and the positions' derivative from which their ratio means something."""
SAME = 1.5
"""Ratio of the two up to which they are in the same unit: gears and scales of sensors may err."""
NEAR = 1.15
"""Factor within which a ratio is that of a unit."""
BETTER = 2.0
"""How much better the model must make the motion in degrees than the one in radians."""


def oddities(
    recording: "Recording", model: mujoco.MjModel, wrapped: Sequence[int] = ()
) -> list[str]:
    """Say what is odd about a recording, one line each.

    Args:
        recording: The recording.
        model: The model.
        wrapped: Joints whose angles jumped by a turn of 2π, which are in radians.
    """
    ratios = _velocity_ratios(recording, model)
    clock = _clock(recording, ratios, model)
    lines = []
    if clock != "s":
        lines.append(
            f"the samples are {recording.interval:.4g} s apart; is time in {clock}? {_mend(clock)}"
        )
    in_time = {dof: ratio * UNITS[clock].factor for dof, ratio in ratios.items()}
    by_velocity = _contradictions(in_time, model)
    lines += by_velocity.values()
    told = {*by_velocity, *model.jnt_dofadr[list(wrapped)].tolist()}
    lines += _angles(recording, model, told, timed=clock == "s")
    lines += _commands(recording, model)
    return [f"{recording.name}: {line}" for line in lines]


def _mend(unit: str) -> str:
    return f'give it in {UNITS[unit].si}, or unit = "{unit}" in a map file (--map)'


def _velocity_ratios(recording: "Recording", model: mujoco.MjModel) -> dict[int, float]:
    """Return measured velocity over derivative of position, by dof, where both move alike."""
    if not recording.velocity_measured:
        return {}
    spans = [slice(a, b) for a, b in recording.spans]
    derived = np.concatenate(
        [estimate_velocity(model, recording.time[at], recording.qpos[at]) for at in spans]
    )
    measured = np.concatenate([recording.qvel[at] for at in spans])
    sizes = np.linalg.norm(measured, axis=0), np.linalg.norm(derived, axis=0)
    product = np.sum(measured * derived, axis=0)
    alike = np.abs(product) > ALIKE * sizes[0] * sizes[1]
    return {
        int(dof): float(np.sign(product[dof]) * sizes[0][dof] / sizes[1][dof])
        for dof in np.flatnonzero(alike)
    }


def _clock(recording: "Recording", ratios: dict[int, float], model: mujoco.MjModel) -> str:
    """Return the unit that time is in, by its interval and by how fast things move."""
    told = list(ratios.values())
    if any(_is_near(ratio, 1.0, SAME) for ratio in told):
        return "s"
    for unit in CLOCKS:
        if told and all(_is_near(ratio, 1 / UNITS[unit].factor) for ratio in told):
            hinges = [signals(model)[model.nq + dof].unit == "rad/s" for dof in ratios]
            if any(hinges) or recording.interval > SLOWEST:  # a slide may be in mm/s instead
                return unit
    fitting = [u for u in ("s", *CLOCKS) if recording.interval * UNITS[u].factor <= SLOWEST]
    return fitting[0] if fitting else CLOCKS[-1]


def _is_near(value: float, wanted: float, factor: float = NEAR) -> bool:
    return wanted / factor < value < wanted * factor


def _contradictions(ratios: dict[int, float], model: mujoco.MjModel) -> dict[int, str]:
    """Say where velocities are not the positions' derivatives, by dof."""
    listed = signals(model)
    found = {}
    for dof, ratio in ratios.items():
        if _is_near(ratio, 1.0, SAME):
            continue
        speed, (place, si) = listed[model.nq + dof], _position_of(dof, model)
        line = f"{speed.name} is {ratio:.4g} times the derivative of {place}"
        faster = [u for u, (s, f) in UNITS.items() if s == speed.unit and _is_near(ratio, 1 / f)]
        further = [u for u, (s, f) in UNITS.items() if s == si and _is_near(ratio, f)]
        if faster:
            line += f"; is {speed.name} in {faster[0]}? {_mend(faster[0])}"
        elif further:
            line += f"; is {place} in {further[0]}? {_mend(further[0])}"
        elif _is_near(-ratio, 1.0, SAME):
            line += "; one of them counts the other way: sign = -1 in a map file (--map) turns it"
        else:
            line += "; one of them, or time, is in another unit"
        found[dof] = line
    return found


def _position_of(dof: int, model: mujoco.MjModel) -> tuple[str, str]:
    """Return the column whose derivative a dof's velocity is, and its unit; "" of a rotation."""
    joint = model.dof_jntid[dof]
    offset, start = dof - model.jnt_dofadr[joint], model.jnt_qposadr[joint]
    dofs = DOFS_OF_JOINT[int(model.jnt_type[joint])]
    if dofs == 1 or offset < dofs - 3:
        return signals(model)[start + offset]
    return f"the rotation in {signals(model)[start].name.removesuffix('.0')}", ""


def _angles(
    recording: "Recording", model: mujoco.MjModel, told: set[int], timed: bool
) -> list[str]:
    """Say which angles look like degrees, but for dofs whose unit is told already."""
    lines, far = [], []
    for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE):
        dof = int(model.jnt_dofadr[joint])
        angle = recording.qpos[:, model.jnt_qposadr[joint]]
        largest = float(np.abs(angle).max())
        low, high = model.jnt_range[joint]
        limited = bool(model.jnt_limited[joint])
        beyond = limited and (angle.min() < low - SLACK or angle.max() > high + SLACK)
        name = signals(model)[model.jnt_qposadr[joint]].name
        if dof in told:
            continue
        if largest > LARGEST_ANGLE or beyond:
            span = f" and the joint's range is {low:.3g} to {high:.3g} rad" if limited else ""
            lines.append(
                f"{name} reaches {largest:.4g} rad{span}; is it in degrees? multiply by pi/180"
            )
        elif largest > FULL_TURN:
            far.append((int(joint), f"{name} (up to {largest:.4g} rad)"))
    if far and timed:
        as_is, in_degrees = _misfits(recording, model, [joint for joint, _ in far])
        if as_is > BETTER * in_degrees:
            lines.append(
                f"{', '.join(said for _, said in far)}: the model makes this motion "
                f"{as_is / in_degrees:.2g} times better in degrees than in radians; is it in "
                "degrees? multiply by pi/180"
            )
    return lines


def _misfits(
    recording: "Recording", model: mujoco.MjModel, joints: list[int]
) -> tuple[float, float]:
    """Return which part of its torques the model lacks for a motion, as it is and in degrees."""
    places, dofs = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
    qpos, qvel = recording.qpos.copy(), recording.qvel.copy()
    qpos[:, places] *= UNITS["deg"].factor
    qvel[:, dofs] *= UNITS["deg"].factor
    found = []
    for motion in (recording, dataclasses.replace(recording, qpos=qpos, qvel=qvel)):
        m = missing_torque(model, [motion])
        inertial = m.torque + m.command - m.load
        there = sum(float(np.sum(part[:, dofs] ** 2)) for part in (inertial, m.load, m.command))
        found.append(float(np.sqrt(np.sum(m.torque[:, dofs] ** 2) / max(there, 1e-300))))
    return found[0], found[1]


def _commands(recording: "Recording", model: mujoco.MjModel) -> list[str]:
    """Say which commands the model clamps, and which actuators do not follow from them."""
    lines = [
        f"actuator {name} integrates its commands, and where it began is not recorded: taken to "
        "have given no force there"
        for name in never_forgetting(model)
    ]
    is_clamped = clamps(model)
    for i, name in enumerate(actuator_names(model)):
        low, high = model.actuator_ctrlrange[i]
        command = recording.ctrl[:, i]
        beyond = (command < low - 1e-6) | (command > high + 1e-6)
        if model.actuator_ctrllimited[i] and beyond.any():
            lines.append(
                f"ctrl.{name} is beyond its range {low:g} to {high:g} in "
                f"{int(beyond.sum())} of {len(command)} samples (from {command.min():.4g} to "
                f"{command.max():.4g}); the model "
                f"{'clamps it' if is_clamped[i] else 'takes it as it is'}"
            )
    return lines
