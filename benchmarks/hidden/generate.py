"""Draw the benchmark's cases from one seed and record each as CSV files with its truth."""

import dataclasses
import itertools
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import signal

from garat_jax.diagnosis.hidden import write_csv
from garat_jax.effects import CATALOGUE
from garat_jax.plain import to_plain

from .bodies import CATALOGUED, SECRETS
from .measure import Eye, experiment, measure
from .robots import ROBOTS, Scene, survey
from .secrets import OUTSIDE, SIZES, Secret

NUM_RECORDINGS = 4
RATES = (100.0, 200.0, 250.0, 500.0, 1000.0)
NOISES = ("white", "coloured", "quantised")
NUM_PAIRS, NUM_CLEAN, NUM_OUTSIDE = 20, 20, 20
WITH_DELAY = 0.3
"""Share of the cases in which all commands are late as a nuisance."""
LARGEST_DELAY = 0.04
TIMINGS = ("actuator_delay", "actuator_lag", "sensor_delay")
"""Kinds that a nuisance delay would hide; they go without one."""
COLOUR = 0.02
"""Seconds over which coloured noise is correlated."""
VISIBLE = 3.0
"""A secret alone makes the model err by this many standard deviations of noise, at least."""
GROWTH = 1.5
"""A secret that does not show is enlarged by this factor ..."""
MOST_ENLARGED = 4
"""... so often, before another place is tried."""
MOST_DRAWN = 10
"""A set that shows on no robot is drawn anew, with another rate and noise, so often in all."""


class Case(NamedTuple):
    """One set of recordings that is to be drawn.

    Attributes:
        name: Unique, and what it is.
        category: `single`, `pair`, `clean` or `outside`.
        kinds: The secrets.
        size: Key of `SIZES`.
        seed: The benchmark's seed and the case's number.
    """

    name: str
    category: str
    kinds: tuple[str, ...]
    size: str
    seed: tuple[int, int]


@dataclasses.dataclass(frozen=True)
class Truth:
    """What one set of recordings hides.

    Attributes:
        case: What was to be drawn.
        robot: Key of `ROBOTS`.
        secrets: The effects.
        rate: Samples a second.
        seconds: Length of a recording.
        noise: One of `NOISES`.
        delay: Seconds by which all commands are late as a nuisance.
        visibility: Of each secret alone: the model's error over half a second, in standard
            deviations of the noise of the signal that shows it most.
    """

    case: Case
    robot: str
    secrets: tuple[Secret, ...]
    rate: float
    seconds: float
    noise: str
    delay: float
    visibility: tuple[float, ...]

    def to_json(self) -> dict:
        """Return what a file or a table says of it."""
        effects = [
            {"kind": s.kind, "target": s.target, "parameters": dict(s.parameters)}
            for s in self.secrets
        ]
        rest = ("robot", "rate", "seconds", "noise", "delay", "visibility")
        row = {"case": self.case.name, "category": self.case.category, "size": self.case.size}
        return to_plain(row | {n: getattr(self, n) for n in rest} | {"secrets": effects})


def list_cases(seed: int) -> list[Case]:
    """List every case of a seed: each kind at three sizes, pairs, clean ones and those outside."""
    rng = np.random.default_rng([seed, 0])
    planned: list[tuple[str, str, tuple[str, ...], str]] = [
        (f"{k}-{s}", "single", (k,), s) for k, s in itertools.product(CATALOGUED, SIZES)
    ]
    for number in range(NUM_PAIRS):
        first, second = _draw_pair(rng)
        planned.append((f"pair-{number:02d}-{first}+{second}", "pair", (first, second), "medium"))
    planned += [(f"clean-{number:02d}", "clean", (), "medium") for number in range(NUM_CLEAN)]
    for number in range(NUM_OUTSIDE):
        kind = list(OUTSIDE)[number % len(OUTSIDE)]
        size = ("medium", "large")[number // len(OUTSIDE) % 2]
        planned.append((f"outside-{number:02d}-{kind}", "outside", (kind,), size))
    return [Case(*row, (seed, index + 1)) for index, row in enumerate(planned)]


def shuffled(cases: Sequence[Case], seed: int) -> list[Case]:
    """Return cases in a random order, each category and size in its share of every beginning."""
    rng = np.random.default_rng([seed, 1])
    groups: dict[tuple[str, str], list[Case]] = {}
    for case in cases:
        groups.setdefault((case.category, case.size), []).append(case)
    turns = [
        ((turn + rng.random()) / len(group), case)
        for group in groups.values()
        for turn, case in enumerate(group[i] for i in rng.permutation(len(group)))
    ]
    return [case for _, case in sorted(turns)]


ROOMS = (
    ("viscous_damping", "coulomb_friction", "stribeck_friction", "asymmetric_friction"),
    ("motor_gain", "torque_saturation", "motor_deadband", "motor_curve"),
    ("actuator_delay", "actuator_lag", "sensor_delay"),
    ("payload_mass", "com_offset", "gravity_scale", "air_drag", "gravity_tilt"),
    ("torque_offset", "joint_stiffness", "cogging_torque", "rotor_inertia", "quadratic_drag"),
    ("backlash", "joint_flexibility", "encoder_scale", "encoder_offset", "load_friction"),
)
"""The two effects of a pair come from different ones of these."""


def _draw_pair(rng: np.random.Generator) -> tuple[str, str]:
    rooms = rng.choice(len(ROOMS), 2, replace=False)
    first, second = (str(rng.choice(ROOMS[room])) for room in rooms)
    return first, second


class Surveys(dict[str, Scene]):
    """The robots' scenes, each measured once."""

    def __missing__(self, name: str) -> Scene:
        self[name] = survey(ROBOTS[name])
        return self[name]


def draw(case: Case, scenes: Surveys, robots: Sequence[str] = tuple(ROBOTS)) -> Truth:
    """Draw robot, places, sizes and nuisances of a case; enlarge what would not show.

    Raises:
        ValueError: None of the robots can carry the effects visibly.
    """
    rng = np.random.default_rng(case.seed)
    for _ in range(MOST_DRAWN):
        if truth := _draw_once(case, scenes, robots, rng):
            return truth
    raise ValueError(f"{case.name} does not show on any of {', '.join(robots)}")


def _draw_once(case: Case, scenes: Surveys, robots: Sequence[str], rng) -> Truth | None:
    """Draw a case, on the first robot of a random order on which it shows, or None."""
    timing = any(kind in TIMINGS for kind in case.kinds)
    late = rng.random() < WITH_DELAY and not timing
    delay = float(rng.uniform(0.0, LARGEST_DELAY)) if late else 0.0
    rate, seconds = float(rng.choice(RATES)), float(rng.choice([4.0, 6.0, 8.0]))
    noise = str(rng.choice(NOISES))
    turn = case.seed[1] if not case.kinds else int(rng.integers(len(robots)))
    for robot in (robots[(turn + i) % len(robots)] for i in range(len(robots))):
        scene, found = scenes[robot], []
        if not all(SECRETS[kind].targets(scene) for kind in case.kinds):
            continue
        eye = Eye(scene, rate, case.seed) if case.kinds else None
        for kind in case.kinds:
            assert eye
            secret = _place(scene, eye, kind, SIZES[case.size], rng)
            if secret is None:
                break
            found.append(secret)
        if len(found) == len(case.kinds):
            secrets, seen = tuple(s for s, _ in found), tuple(v for _, v in found)
            return Truth(case, robot, secrets, rate, seconds, noise, delay, seen)
    return None


def _place(scene: Scene, eye: Eye, kind: str, size: float, rng) -> tuple[Secret, float] | None:
    """Return a secret at a place where it shows and how much, or None."""
    cls = SECRETS[kind]
    for target in rng.permutation(cls.targets(scene))[:3]:
        name = target.partition("/")[2]
        for enlarged in range(MOST_ENLARGED + 1):
            secret = cls(str(target), cls.draw(scene, name, size * GROWTH**enlarged, rng))
            if not _is_sensible(secret):
                continue
            shows = eye.sees((secret,))
            if shows >= VISIBLE:
                return secret, shows
    return None


def _is_sensible(secret: Secret) -> bool:
    """Say whether a secret lies within the bounds of what a fit may find."""
    declared = CATALOGUE[secret.kind].parameters() if secret.kind in CATALOGUE else ()
    known = [(p, secret[p.name]) for p in declared if p.name in secret.parameters]
    return all(p.low <= value <= p.high for p, value in known)


def add_noise(states: np.ndarray, truth: Truth, rng: np.random.Generator) -> np.ndarray:
    """Return what real sensors say: with white or coloured noise, or of an encoder's steps."""
    size = np.repeat(ROBOTS[truth.robot].noise, states.shape[1] // 2)
    white = rng.normal(size=states.shape)
    if truth.noise == "coloured":
        keep = np.exp(-1.0 / (COLOUR * truth.rate))
        first = keep * rng.normal(size=(1, states.shape[1]))
        white = signal.lfilter([np.sqrt(1 - keep**2)], [1, -keep], white, axis=0, zi=first)[0]
    noisy = states + size * white
    if truth.noise == "quantised":
        step = np.sqrt(12.0) * size
        noisy = step * np.round(states / step)
        half = states.shape[1] // 2
        noisy[:, half:] = states[:, half:] + size[half:] * white[:, half:]
    return noisy


def generate(truth: Truth, scene: Scene, folder: Path) -> list[Path]:
    """Record a set: the model, four recordings of which the last is held out, and the truth.

    Returns:
        The recordings.
    """
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(scene.robot.mjcf, folder / scene.robot.mjcf.name)
    model, paths = scene.model, []
    joints = [model.joint(i).name for i in range(model.njnt)]
    header = ["time", *(f"qpos.{n}" for n in joints), *(f"qvel.{n}" for n in joints)]
    header += [f"ctrl.{model.actuator(i).name}" for i in range(model.nu)]
    for index in range(NUM_RECORDINGS):
        time, ctrl = experiment(scene, index, truth.rate, truth.seconds, truth.case.seed)
        states = measure(scene, truth.secrets, time, ctrl, truth.delay)
        rng = np.random.default_rng([*truth.case.seed, 2, index])
        paths.append(folder / f"recording_{index}.csv")
        write_csv(paths[-1], header, np.column_stack([time, add_noise(states, truth, rng), ctrl]))
    (folder / "truth.json").write_text(json.dumps(truth.to_json(), indent=2) + "\n")
    return paths
