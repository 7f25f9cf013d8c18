"""Make "measurements" that hide one physical effect, with C MuJoCo alone.

Nothing here uses the catalogue's laws or the engine: effects are native fields of MuJoCo, forces
and changed commands in a plain `mj_step` loop at a finer timestep than the model's.
"""

import csv
import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

REFINEMENT = 32
"""Physics substeps in one timestep of the model under diagnosis, at least."""
ANGLE_NOISE, SPEED_NOISE = 1e-3, 1e-2
"""Standard deviation of the sensors' white noise, rad and rad/s."""
SIZE_RANGE = (0.7, 1.4)
"""A hidden effect has its typical size times a factor drawn from here."""


class Hidden(NamedTuple):
    """What was recorded, and the truth.

    Attributes:
        fit: Recordings to find the effect with.
        holdout: Recordings to prove it on.
        kind: The catalogue's name of the effect; "none" or a name outside the catalogue too.
        target: Where it acts; empty for none.
        parameters: Its true parameters.
    """

    fit: tuple[Path, ...]
    holdout: tuple[Path, ...]
    kind: str
    target: str
    parameters: Mapping[str, float]


@dataclasses.dataclass(frozen=True)
class Secret:
    """How an effect enters the truth.

    Attributes:
        element: What it acts on: `joint`, `actuator`, `body`, `world`, or "" for nothing.
        parameters: Typical size of each parameter; "no effect" plus a change that is scaled.
        change: Changes the spec before it is compiled.
        force: Generalised force on the first joint at a time [s], N m.
        late: Seconds by which commands are late.
        gain: Factor on the commands at times [s].
    """

    element: str
    parameters: Mapping[str, float] = dataclasses.field(default_factory=dict)
    change: Callable[[mujoco.MjSpec, Mapping[str, float]], None] = lambda spec, p: None
    force: Callable[[float, Mapping[str, float]], float] | None = None
    late: Callable[[Mapping[str, float]], float] = lambda p: 0.0
    gain: Callable[[np.ndarray, Mapping[str, float]], np.ndarray | float] = lambda t, p: 1.0


def _add_damping(spec: mujoco.MjSpec, p: Mapping[str, float]) -> None:
    spec.joints[0].damping[0] += p["coefficient"]


def _add_friction(spec: mujoco.MjSpec, p: Mapping[str, float]) -> None:
    spec.joints[0].frictionloss += p["torque"]


def _add_armature(spec: mujoco.MjSpec, p: Mapping[str, float]) -> None:
    spec.joints[0].armature += p["inertia"]


def _add_payload(spec: mujoco.MjSpec, p: Mapping[str, float]) -> None:
    add_point_mass(spec.bodies[-1], p["mass"], (0.0, 0.0, p["z"]))


def add_point_mass(body: mujoco.MjsBody, mass: float, place: Sequence[float]) -> None:
    """Fix a mass [kg] to a body at a place in its frame [m]; it touches nothing."""
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[1e-3, 0, 0],
        pos=place,
        mass=mass,
        contype=0,
        conaffinity=0,
    )


def _scale_gravity(spec: mujoco.MjSpec, p: Mapping[str, float]) -> None:
    spec.option.gravity = spec.option.gravity * p["scale"]


SECRETS: dict[str, Secret] = {
    "none": Secret(""),
    "viscous_damping": Secret("joint", {"coefficient": 0.03}, change=_add_damping),
    "coulomb_friction": Secret("joint", {"torque": 0.06}, change=_add_friction),
    "torque_offset": Secret("joint", {"torque": 0.1}, force=lambda t, p: p["torque"]),
    "rotor_inertia": Secret("joint", {"inertia": 0.01}, change=_add_armature),
    "motor_gain": Secret("actuator", {"scale": 0.25}, gain=lambda t, p: p["scale"]),
    "actuator_delay": Secret("actuator", {"delay": 0.02}, late=lambda p: p["delay"]),
    "payload_mass": Secret("body", {"mass": 0.1, "z": -0.5}, change=_add_payload),
    "gravity_scale": Secret("world", {"scale": 0.15}, change=_scale_gravity),
    "periodic_disturbance": Secret(
        "joint", {"torque": 0.15}, force=lambda t, p: p["torque"] * np.sin(2 * np.pi * 1.7 * t)
    ),
    "fading_gain": Secret(
        "actuator", {"rate": 0.05}, gain=lambda t, p: np.maximum(0.0, 1.0 - p["rate"] * t)[:, None]
    ),
}
OUTSIDE = ("periodic_disturbance", "fading_gain")
"""Secrets that the catalogue does not have."""
DRAWN = tuple(name for name in SECRETS if name not in ("none", *OUTSIDE))
"""Kinds that `make_recordings` draws from; their names are the catalogue's."""


def draw(kind: str, rng: np.random.Generator) -> dict[str, float]:
    """Draw the parameters of a hidden effect: well visible, of either sign where it can be."""
    factor = rng.uniform(*SIZE_RANGE)
    sign = rng.choice([-1.0, 1.0])
    typical = SECRETS[kind].parameters
    if kind in ("motor_gain", "gravity_scale"):
        return {"scale": 1.0 + sign * factor * typical["scale"]}
    if kind == "torque_offset":
        return {"torque": sign * factor * typical["torque"]}
    if kind == "payload_mass":
        return {"mass": factor * typical["mass"], "z": typical["z"] * rng.uniform(0.8, 1.0)}
    return {name: factor * size for name, size in typical.items()}


def excite(index: int, time: np.ndarray, limit: float, rng: np.random.Generator) -> np.ndarray:
    """Make a command [T]: multi-sine, steps, slow reversals, or steps on a multi-sine, in turn."""
    frequencies = np.asarray([0.23, 0.41, 0.71, 1.1, 1.7])
    phases = rng.uniform(0, 2 * np.pi, len(frequencies))
    sines = np.sin(2 * np.pi * time[:, None] * frequencies + phases).mean(axis=1) * 1.5
    count = int(np.ceil(time[-1] / 0.4)) + 1
    steps = rng.uniform(-1, 1, count)[(time / 0.4).astype(int)]
    slow = np.sin(2 * np.pi * rng.uniform(0.2, 0.3) * time)
    return limit * np.stack([sines, steps, slow, 0.5 * sines + 0.5 * steps])[index % 4]


def finer_timestep(timestep: float, interval: float) -> float:
    """Return the largest timestep [s] that refines a model's enough and divides a sample."""
    return interval / int(np.ceil(interval * REFINEMENT / timestep - 1e-9))


def delayed(ctrl: np.ndarray, steps: int) -> np.ndarray:
    """Return commands [N, nu] that come some steps late; the first one is held before."""
    return ctrl[np.maximum(np.arange(len(ctrl)) - steps, 0)]


def simulate(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    ctrl: np.ndarray,
    samples: np.ndarray,
    act: Callable[[mujoco.MjData], None] | None = None,
) -> np.ndarray:
    """Step C MuJoCo under commands that may change every step.

    Args:
        model: The truth, with its fine timestep.
        data: The initial state; changed.
        ctrl: Commands, [N, nu].
        samples: Steps before which the state is sampled, [T], not decreasing, below N.
        act: Writes forces before every step.

    Returns:
        The true state at each sample, [T, nq + nv].
    """
    states = np.zeros((len(samples), model.nq + model.nv))
    changes = 1 + np.flatnonzero(np.any(np.diff(ctrl, axis=0) != 0, axis=1))
    stops = np.unique(np.concatenate([[0], changes, samples, [len(ctrl)]]))
    stops = np.arange(len(ctrl) + 1) if act else stops
    row = 0
    for begin, end in itertools.pairwise(stops):
        while row < len(samples) and samples[row] == begin:
            states[row] = np.concatenate([data.qpos, data.qvel])
            row += 1
        data.ctrl[:] = ctrl[begin]
        if act:
            act(data)
        mujoco.mj_step(model, data, end - begin)
    return states


def _measure(
    mjcf: Path, kind: str, parameters: Mapping[str, float], time: np.ndarray, ctrl: np.ndarray
) -> np.ndarray:
    """Return the true state [T, nq + nv] of a model with a secret under held commands [T, nu]."""
    secret = SECRETS[kind]
    spec = mujoco.MjSpec.from_file(str(mjcf))
    secret.change(spec, parameters)
    interval = time[1] - time[0]
    spec.option.timestep = finer_timestep(spec.option.timestep, interval)
    model = spec.compile()
    step, substeps = model.opt.timestep, round(interval / model.opt.timestep)
    fine = delayed(np.repeat(ctrl, substeps, axis=0), round(secret.late(parameters) / step))
    fine = fine * secret.gain(step * np.arange(len(fine)), parameters)
    force = secret.force

    def act(data: mujoco.MjData) -> None:
        assert force
        data.qfrc_applied[0] = force(data.time, parameters)

    samples = np.arange(len(time)) * substeps
    return simulate(model, mujoco.MjData(model), fine, samples, act if force else None)


def make_recordings(
    mjcf: Path,
    out: Path,
    seed: int,
    num_recordings: int = 4,
    seconds: float = 8.0,
    rate: float = 250.0,
    kind: str | None = None,
) -> Hidden:
    """Write recordings of a one-motor pendulum that differs from its model by a hidden effect.

    Args:
        mjcf: The model; its first joint and actuator carry the effect.
        out: Folder for the CSV files.
        seed: Draws the effect, its size, the excitation and the sensor noise.
        num_recordings: How many files; the last quarter (at least one) is held out.
        seconds: Length of each.
        rate: Samples a second.
        kind: A name in `SECRETS` instead of one drawn from the seed.
    """
    rng = np.random.default_rng(seed)
    drawn = str(rng.choice(DRAWN))
    kind = kind or drawn
    parameters = draw(kind, rng)
    model = mujoco.MjModel.from_xml_path(str(mjcf))
    joint, actuator = model.joint(0).name, model.actuator(0).name
    time = np.arange(round(seconds * rate)) / rate
    out.mkdir(parents=True, exist_ok=True)
    paths = []
    for index in range(num_recordings):
        ctrl = excite(index, time, 0.4 * model.actuator_ctrlrange[0, 1], rng)
        state = _measure(mjcf, kind, parameters, time, ctrl[:, None])
        state = state + rng.normal(size=state.shape) * [ANGLE_NOISE, SPEED_NOISE]
        paths.append(out / f"recording_{index}.csv")
        header = ["time", f"qpos.{joint}", f"qvel.{joint}", f"ctrl.{actuator}"]
        write_csv(paths[-1], header, np.column_stack([time, state, ctrl]))
    num_holdout = max(1, num_recordings // 4)
    names = {"joint": joint, "actuator": actuator, "body": model.body(model.nbody - 1).name}
    element = SECRETS[kind].element
    target = f"{element}/{names[element]}" if element in names else element
    return Hidden(
        tuple(paths[:-num_holdout]), tuple(paths[-num_holdout:]), kind, target, parameters
    )


def write_csv(path: Path, header: Sequence[str], rows: np.ndarray) -> None:
    """Write a recording: column names and rows [T, columns]."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows([f"{value:.9g}" for value in row] for row in rows)
