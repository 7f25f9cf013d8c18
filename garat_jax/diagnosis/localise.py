"""Where a model fails: the torque that it lacks, by joint, and what that torque goes with.

The missing torque is inverse dynamics of the measured motion minus the torque that the model's
actuators give, both smoothed by the same filter. It is a second view, independent of the fit.
"""

import copy
import dataclasses
import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from scipy import signal

from garat_jax.diagnosis.activation import LONGEST, follow_commands, forgets_in, known_spans
from garat_jax.diagnosis.columns import signals, torques
from garat_jax.diagnosis.filters import even_steps, held, interpolated
from garat_jax.diagnosis.sensing import DISPLACED, as_they_are
from garat_jax.diagnosis.tables import FEWEST_SAMPLES
from garat_jax.dynamics import Dynamics, apply_effects, initial_state, sensed, view
from garat_jax.effects.elements import DOFS_OF_JOINT, element_names
from garat_jax.effects.gear import gear_of
from garat_jax.effects.units import at_slide
from garat_jax.engine import HostModel

if TYPE_CHECKING:
    from garat_jax.diagnosis.measurements import Recording

WINDOW = 0.06
"""Seconds of the smoothing filter: short against a robot joint's motion."""
SLOW = 0.25
"""Speed below which a joint counts as slow, relative to its root mean square."""
MUCH = 0.5
"""Part of the largest commanded torque from which commands count as large."""
ALIKE = 0.01
"""Difference of two timesteps, relative to one, that does not count."""
BY_CONTACTS = "in proportion to the contacts"
"""The regime of what the contacts give."""
WORTH_TELLING = 0.05
"""Smallest share of the missing torque that a regime is told for."""


@dataclasses.dataclass(frozen=True)
class Place:
    """One line of the where-it-fails map.

    Attributes:
        signal: The joint.
        share: Share of all the missing torque's squares that the regime at this joint explains.
        regime: When, in words.
        evidence: What shows it, in words, with numbers.
    """

    signal: str
    share: float
    regime: str
    evidence: str


class MissingTorque(NamedTuple):
    """The torque that a model lacks, by dof, over all recordings; also drawn in the report.

    Attributes:
        dofs: Name of each dof's joint.
        actuators: Name of each actuator.
        slides: Whether each dof is a translation, in N and m.
        time: Seconds, [M].
        elapsed: Part of its recording that has passed, 0 to 1, [M].
        position: [M, nv]; zero for dofs of ball and free joints.
        velocity: [M, nv].
        acceleration: [M, nv].
        command: Torque of the model's actuators, [M, nv].
        load: Gravity and Coriolis torque, [M, nv].
        contact: Torque of the model's contacts, [M, nv].
        torque: What is missing, [M, nv].
        ctrl: The actuators' commands, [M, nu].
        drive: Torque of each of the model's actuators at its joint, [M, nu].
        limited: Whether the force of each is at its limit, [M, nu].
    """

    dofs: tuple[str, ...]
    actuators: tuple[str, ...]
    slides: tuple[bool, ...]
    time: np.ndarray
    elapsed: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    command: np.ndarray
    load: np.ndarray
    contact: np.ndarray
    torque: np.ndarray
    ctrl: np.ndarray
    drive: np.ndarray
    limited: np.ndarray


def missing_torque(
    model: mujoco.MjModel, recordings: "Sequence[Recording]", world: Dynamics | None = None
) -> MissingTorque:
    """Compute the torque that a model lacks along the recordings.

    Args:
        model: The compiled model, its native fields as its effects leave them.
        recordings: What was measured.
        world: The same with its effects, whose commands and forces count as the model's.
    """
    recordings = [_as_it_was(world, recording) for recording in recordings]
    activations = [_activations(model, recording) for recording in recordings]
    parts = [
        _of_span(model, r, act, slice(*span), world)
        for r, act in zip(recordings, activations, strict=True)
        for span in _known(r, forgets_in(model))
    ]
    stacked = [np.concatenate(columns) for columns in zip(*parts, strict=True)]
    actuators = tuple(element_names(model, "actuator"))
    slides = tuple(signal.unit == "m/s" for signal in signals(model)[model.nq :])
    dofs = tuple(torque.name.removeprefix("torque.") for torque in torques(model))
    return MissingTorque(dofs, actuators, slides, *stacked)


def _as_it_was(world: Dynamics | None, recording: "Recording") -> "Recording":
    """Return a recording with the positions and velocities that sensors reported as measured."""
    sensors = tuple(e for e in world.effects if e.senses and not e.notes) if world else ()
    if world is None or not sensors:
        return recording
    reporting, nq = world.replace(effects=sensors), recording.qpos.shape[1]

    def report_one(state):
        seen = sensed(reporting, initial_state(reporting, state[:nq], state[nq:]))
        return jnp.concatenate([seen.qpos, seen.qvel])

    def report(states: np.ndarray) -> np.ndarray:
        with jax.enable_x64(True):
            return np.asarray(jax.vmap(report_one)(jnp.asarray(states)))

    measured = np.concatenate([recording.qpos, recording.qvel], axis=1)
    unit = np.maximum(measured.std(axis=0), DISPLACED)
    states = as_they_are(measured, report(measured), report, unit)
    return dataclasses.replace(recording, qpos=states[:, :nq], qvel=states[:, nq:])


def _known(recording: "Recording", seconds: float) -> Sequence[tuple[int, int]]:
    """Return the spans in which activations are known, long enough to be smoothed; all if none."""
    known = known_spans(recording, seconds)
    return [(a, b) for a, b in known if b - a >= FEWEST_SAMPLES] or recording.spans


def localise(missing: MissingTorque) -> list[Place]:
    """Say in words at which joint and in which regime torque is missing, largest share first."""
    total = float(np.sum(np.var(missing.torque, axis=0) + np.mean(missing.torque, axis=0) ** 2))
    if total == 0.0:
        return []
    places = []
    for dof, name in enumerate(missing.dofs):
        torque = missing.torque[:, dof]
        of_joint = float(np.mean(torque**2)) / total
        slides = missing.slides[dof]
        for regime, feature, unit, words in _features(missing, dof):
            norm = float(feature @ feature)
            if norm == 0.0:
                continue
            size = float(feature @ torque) / norm
            share = of_joint * size**2 * norm / max(float(torque @ torque), 1e-300)
            if share >= WORTH_TELLING:
                unit = at_slide(unit) if slides else unit
                # Words may say the direction in place of a sign.
                shown = f"{abs(size):.3g}" if "{sign}" in words else f"{size:+.3g}"
                evidence = (
                    f"{100 * share:.0f} % of the missing torque is at {name}, {regime}: "
                    f"{shown}{' ' * bool(unit)}{unit}"
                    + words.format(
                        sign="with" if size > 0 else "against",
                        torque=at_slide("N m") if slides else "N m",
                    )
                )
                places.append(Place(name, share, regime, evidence))
    return sorted(places, key=lambda place: -place.share)


def _features(m: MissingTorque, dof: int):
    """Yield (regime, feature [M], unit of its size at a hinge, words) for one dof.

    In the words stand {sign} for that of the size and {torque} for the unit of a torque there.
    """
    speed, position = m.velocity[:, dof], m.position[:, dof]
    command, load, contact = m.command[:, dof], m.load[:, dof], m.contact[:, dof]
    scale = float(np.sqrt(np.mean(speed**2))) + 1e-12
    direction = np.tanh(speed / (0.05 * scale))
    slow = np.abs(speed) < SLOW * scale
    ones = np.ones_like(speed)
    yield "against or with the motion", direction, "N m", " {sign} the motion, at any speed"
    yield "at low speed, around reversals", direction * slow, "N m", " {sign} the motion"
    yield "in proportion to speed", speed, "N m s/rad", ", {sign} the motion"
    square = speed * np.abs(speed)
    yield "in proportion to speed squared", square, "N m s²/rad²", ", {sign} the motion"
    yield "always", ones, "N m", " whatever the joint does"
    yield "in proportion to the command", command, "", " of the commanded torque"
    much = MUCH * float(np.abs(command).max(initial=0.0))
    beyond = np.sign(command) * np.maximum(np.abs(command) - much, 0.0)
    words = f" of the commanded torque beyond {much:.3g}" + " {torque}"
    yield "when much is commanded", beyond, "", words
    change = np.gradient(command) if len(command) > 1 else np.zeros_like(command)
    yield "when the command changes", change, "", " of its change in a sample"
    yield "in proportion to the load", load, "", " of the model's own load torque"
    yield BY_CONTACTS, contact, "", " of the model's own contact torque"
    inertial = m.acceleration[:, dof]
    yield "in proportion to acceleration", inertial, "kg m²", ", {sign} the acceleration"
    yield "with position", position - position.mean(), "N m/rad", ""
    drift = m.elapsed - m.elapsed.mean()
    yield "drifting with time", drift, "N m", " from start to end, whatever is commanded"
    words = " of the commanded torque from start to end"
    yield "drifting with time, with the command", drift * command, "", words


def _activations(model: mujoco.MjModel, recording: "Recording") -> np.ndarray:
    """Return the activations at the samples of a recording, [T, na]."""
    time, step = recording.time, model.opt.timestep
    if not model.na:
        return np.zeros((len(time), 0))
    # Of a long gap no more is followed than makes an activation forget.
    lasting = np.minimum(np.diff(time), LONGEST)
    at = np.cumsum([0.0, *lasting])
    steps = np.arange(int(np.ceil(at[-1] / step)) + 1) * step
    begin = np.concatenate([recording.qpos[0], recording.qvel[0]])
    followed = follow_commands(model, begin, held(steps, at, recording.ctrl), step)
    return interpolated(at, steps, followed)


def _of_effects(world: Dynamics | None, time: np.ndarray, qpos, qvel, ctrl):
    """Return commands [T, nu] as effects leave them, and their forces [T, nv], at even times."""
    if world is None:
        return ctrl, np.zeros_like(qvel)
    effects = tuple(effect.along_path() for effect in world.effects)
    if not any(effect.acts for effect in effects):
        return ctrl, np.zeros_like(qvel)
    interval = float(np.median(np.diff(time)))
    substeps = max(1, int(np.ceil(interval / world.timestep - ALIKE)))
    if abs(interval / substeps / world.timestep - 1.0) > ALIKE:
        host = copy.copy(world.host.model)
        host.opt.timestep = interval / substeps  # by which the effects' memories advance
        world = dataclasses.replace(world, host=HostModel(host))
    inputs = (jnp.asarray(x, jnp.float32) for x in (qpos, qvel, ctrl))
    sent, force = _acting(dataclasses.replace(world, effects=effects), *inputs, substeps)
    return np.asarray(sent, float), np.asarray(force, float)


@functools.partial(jax.jit, static_argnums=4)
def _acting(world: Dynamics, qpos, qvel, ctrl, substeps: int):
    """Return the means over each sample's substeps of commands [T, nu] and forces [T, nv]."""
    model, state = view(world), initial_state(world, qpos[0], qvel[0])

    def sample(memory, inputs):
        qpos, qvel, command = inputs
        seen = state._replace(qpos=qpos, qvel=qvel)

        def substep(memory, _):
            _, sent, force, memory = apply_effects(world, model, seen, command, memory)
            return memory, (sent, force)

        memory, (sent, force) = jax.lax.scan(substep, memory, length=substeps)
        return memory, (sent.mean(axis=0), force.mean(axis=0))

    return jax.lax.scan(sample, state.memory, (qpos, qvel, ctrl))[1]


def _of_span(
    model: mujoco.MjModel,
    recording: "Recording",
    activations: np.ndarray,
    span: slice,
    world: Dynamics | None,
):
    """Return the columns of `MissingTorque` for one span of one recording, at even steps."""
    sampled = recording.time[span]
    time = even_steps(sampled)
    qpos = interpolated(time, sampled, recording.qpos[span])
    velocity = interpolated(time, sampled, recording.qvel[span])
    ctrl = held(time, sampled, recording.ctrl[span])
    act = interpolated(time, sampled, activations[span]) if model.na else np.zeros((len(time), 0))
    interval = float(np.median(np.diff(time)))
    size = window_size(time)
    acceleration = signal.savgol_filter(velocity, size, 2, deriv=1, delta=interval, axis=0)
    speed = signal.savgol_filter(velocity, size, 2, axis=0)
    low, high = model.actuator_forcerange.T
    sent, force = _of_effects(world, time, qpos, speed, ctrl)
    data = mujoco.MjData(model)
    gears = np.asarray([gear_of(model, actuator) for actuator in range(model.nu)])
    rows = []
    for k in range(len(time)):
        data.qpos[:], data.qvel[:] = qpos[k], speed[k]
        data.qacc[:], data.ctrl[:], data.act[:] = acceleration[k], sent[k], act[k]
        mujoco.mj_inverse(model, data)
        needed, load = data.qfrc_inverse.copy(), data.qfrc_bias.copy()
        contact = _contact_torque(model, data)
        mujoco.mj_fwdActuation(model, data)
        drive = data.actuator_force * gears
        at_limit = (data.actuator_force <= low) | (data.actuator_force >= high)
        limited = at_limit & (model.actuator_forcelimited != 0)
        rows.append((needed, load, contact, data.qfrc_actuator.copy(), drive, limited))
    needed, load, contact, given, drive, limited = map(np.asarray, zip(*rows, strict=True))
    smoothed = signal.savgol_filter(np.hstack([given, force, drive]), size, 2, axis=0)
    given, force, drive = np.split(np.asarray(smoothed), [model.nv, 2 * model.nv], axis=1)
    missing = needed - force - given
    position = _positions(model, qpos)
    elapsed = (time - recording.time[0]) / (recording.time[-1] - recording.time[0])
    edge = slice(size // 2, len(time) - size // 2)
    of_dofs = (time, elapsed, position, speed, acceleration, given, load, contact, missing)
    columns = (*of_dofs, ctrl, drive, limited)
    return tuple(column[edge] for column in columns)


def window_size(time: np.ndarray) -> int:
    """Return how many samples the smoothing filter takes in, odd, of times at even steps."""
    size = max(5, 2 * round(0.5 * WINDOW / float(np.median(np.diff(time)))) + 1)
    return min(size, len(time) - 1 + len(time) % 2)


def _contact_torque(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Return the torque of the contacts after inverse dynamics, [nv]."""
    torque = np.zeros(model.nv)
    if data.ncon:
        of_contacts = data.efc_type >= int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)
        mujoco.mj_mulJacTVec(model, data, torque, data.efc_force * of_contacts)
    return torque


def _positions(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    positions = np.zeros((len(qpos), model.nv))
    for joint in range(model.njnt):
        if DOFS_OF_JOINT[int(model.jnt_type[joint])] == 1:
            positions[:, model.jnt_dofadr[joint]] = qpos[:, model.jnt_qposadr[joint]]
    return positions
