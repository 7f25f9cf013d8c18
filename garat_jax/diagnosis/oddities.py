"""What is odd about a recording but usable: columns, units and samples that cannot well be right.

Three things tell a unit. Measured velocity must be the derivative of measured position, mechanisms
are sampled faster than twice a second, and hardly ever more than ten thousand times, and a motion
must be one that the model can nearly make.
"""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from garat_jax.diagnosis.activation import never_forgetting
from garat_jax.diagnosis.columns import actuator_names, signals
from garat_jax.diagnosis.localise import MissingTorque, missing_torque
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
FASTEST = 9e-5
"""Seconds between samples below which time may well be in minutes."""
CLOCKS = ("ms", "us", "ns")
ALIKE = 0.9
"""Cosine between velocity and the positions' derivative from which their ratio means something."""
SAME = 1.5
"""Ratio of the two up to which they are in the same unit: gears and scales of sensors may err."""
NEAR = 1.15
"""Factor within which a ratio is that of a unit."""
OFF = 10.0
"""How far a position is off its neighbours' line, relative to all but a twentieth of the others,
and `FAR`, relative to all that it does, from which it is an error and no motion."""
FAR = 0.02
FLICKER = 3.0
"""Ticks of an encoder that a position may be off its neighbours' line all the same."""
TICKS = 10.0
"""Ticks that it has to move by for its velocity to be held against it."""
SPRINGY = 0.8
"""Cosine between a missing torque and the position from which a spring may be what is missing."""
SURE = 30.0
"""How far a position moves, relative to what noise does from a sample to the next, from which it
is sure what its velocity is."""
UNLIKE = 0.7
"""What position does beside the integral of velocity, relative to what it does, from which that is
no velocity of its own."""
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
    lines += _unlike(recording, model, {*ratios})
    lines += _off_for_a_sample(recording, model)
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
    if recording.interval < FASTEST and not told:
        return "min"
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


def _unlike(recording: "Recording", model: mujoco.MjModel, alike: set[int]) -> list[str]:
    """Say which measured velocities of hinges and slides are none, but for dofs that are alike.

    Their integral is held against positions, beyond what their noise adds up to. One that is like
    the positions in another unit is a velocity.
    """
    lines, listed = [], signals(model)
    single = np.flatnonzero([DOFS_OF_JOINT[int(kind)] == 1 for kind in model.jnt_type])
    for joint in single if recording.velocity_measured else ():
        dof, place = int(model.jnt_dofadr[joint]), int(model.jnt_qposadr[joint])
        sums, noisy, walks, is_coarse = np.zeros(3), 0.0, 0.0, True
        for a, b in recording.spans:
            time = recording.time[a:b]
            position, speed = recording.qpos[a:b, place], recording.qvel[a:b, dof]
            moved = np.concatenate([[0.0], np.cumsum(np.diff(time) * (speed[1:] + speed[:-1]) / 2)])
            both = _without_line(time, position), _without_line(time, moved)
            sums += both[0] @ both[0], both[0] @ both[1], both[1] @ both[1]
            noisy += np.sum(_off_neighbours(time, position) ** 2)
            noise = np.sum(_off_neighbours(time, speed) ** 2) * np.median(np.diff(time)) ** 2
            walks += noise * len(time)
            is_coarse &= bool(np.ptp(position) < TICKS * _tick(position))
        moves, product, integral = sums
        rests = moves - 2.0 * product + integral - walks
        is_clear = moves > SURE**2 * noisy and not is_coarse
        is_like = product**2 > ALIKE**2 * moves * integral
        if dof not in alike and is_clear and not is_like and rests > UNLIKE**2 * moves:
            speed, what = listed[model.nq + dof].name, "is not the derivative"
            if not recording.qvel[:, dof].any():
                what = "is 0 throughout, which is not the derivative"
            lines.append(
                f"{speed} {what} of {listed[place].name}: leave the columns of velocities out, and "
                "they are estimated, or see whether columns have been swapped"
            )
    return lines


def _tick(position: np.ndarray) -> float:
    """Return the smallest step from a sample to the next, an encoder's or less; 0 for none."""
    steps = np.abs(np.diff(position))
    return float(steps[steps > 0.0].min(initial=np.inf)) if steps.any() else 0.0


def _without_line(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values [T] less the line nearest to them."""
    return values - np.polyval(np.polyfit(time, values, 1), time)


def _off_neighbours(time: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return how far positions [T] are off the line through their neighbours, [T - 2]."""
    part = (time[1:-1] - time[:-2]) / (time[2:] - time[:-2])
    return position[1:-1] - position[:-2] - part * (position[2:] - position[:-2])


def _off_for_a_sample(recording: "Recording", model: mujoco.MjModel) -> list[str]:
    """Say which positions jump for a sample and back, as nothing moves."""
    lines = []
    for place, position in enumerate(recording.qpos.T):
        jumps: list[tuple[float, float]] = []
        for a, b in recording.spans:
            off = _off_neighbours(recording.time[a:b], position[a:b])
            least = max(OFF * np.quantile(np.abs(off), 0.95), FAR * np.ptp(position[a:b]))
            least = max(least, FLICKER * _tick(position[a:b]))
            beside = np.pad(off, 1)[:-2], np.pad(off, 1)[2:]
            is_back = [(part * off < 0) & (np.abs(part) > np.abs(off) / 4) for part in beside]
            at = np.flatnonzero((np.abs(off) > least) & is_back[0] & is_back[1])
            since = recording.time - recording.time[0]
            jumps += [(float(since[a + 1 + k]), float(off[k])) for k in at]
        if jumps:
            name, unit = signals(model)[place]
            when = ", ".join(f"{time:.6g}" for time, _ in jumps[:5])
            when += ", ..." if len(jumps) > 5 else ""
            lines.append(
                f"{name} is {max(jumps, key=lambda j: abs(j[1]))[1]:.3g}{' ' * bool(unit)}{unit} "
                f"off its neighbours for a sample, {when} s after the start: leave such samples "
                "out, or they count as noise"
            )
    return lines


def commands_turned(missing: MissingTorque) -> list[str]:
    """Say where the motion may be that of the opposite commands, a line for each dof.

    Twice what is commanded is missing there then, and hardly anything else; but where it also goes
    with the position a spring may be missing.
    """
    lines = []
    parts = missing.torque.T, missing.command.T, missing.position.T
    for name, torque, command, position in zip(missing.dofs, *parts, strict=True):
        size = float(command @ command)
        ratio = float(torque @ command) / size if size > 0.0 else 0.0
        springy = abs(_cosine(torque, position - position.mean())) > SPRINGY
        if abs(_cosine(torque, command)) > ALIKE and _is_near(-ratio, 2.0) and not springy:
            lines.append(
                f"the torque that the model lacks at {name} is {ratio:.3g} times what is commanded "
                "there; do these commands count the other way? sign = -1 in a map file (--map) "
                "turns them"
            )
    return lines


def _cosine(a: np.ndarray, b: np.ndarray) -> float:
    """Return the cosine of two vectors' angle, 0 if either is zero."""
    return float(a @ b) / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-300)


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
