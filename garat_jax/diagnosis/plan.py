"""Plan an excitation, within the actuators' limits, that tells two effects apart.

What an effect changes in the signals, without what a free initial state can make, is a direction.
Where two directions are parallel, no fit can tell the effects apart. Random multi-sines, step
trains and chirps are tried, and the best one is varied; the angle decides, and that both
effects show.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from garat_jax.diagnosis.convert import write_csv
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.model_card import Model
from garat_jax.diagnosis.problem import Problem, StartSpace, linearise
from garat_jax.diagnosis.segments import choose_grid, cut
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.dynamics import native_model
from garat_jax.effects import Effect
from garat_jax.effects.base import element_names
from garat_jax.errors import UserError, choose, unknown_name

RATE = 100.0
"""Commands a second."""
HORIZON = 1.0
"""Seconds of a segment, whose initial state is free."""
TRIALS = 12
"""Random excitations that are tried."""
VARIATIONS = 12
"""Variations of the best one."""
UNLIMITED = 1.0
"""Command taken as the limit of an actuator that states none."""
VISIBLE = 1e-3
"""Change of the signals, relative to the larger effect's, below which an effect does not show."""


class Place(NamedTuple):
    """An effect at a target, as the user names it: KIND or KIND@TARGET."""

    kind: str
    target: str

    def __str__(self) -> str:
        return f"{self.kind} at {self.target}"


class Planned(NamedTuple):
    """An excitation.

    Attributes:
        time: Seconds, [T].
        ctrl: Commands, [T, nu].
        family: What it is, in words.
        before: Cosine of the two effects under a plain sine, 0 to 1.
        after: The same under this excitation.
    """

    time: np.ndarray
    ctrl: np.ndarray
    family: str
    before: float
    after: float


def parse_place(text: str, model: Model) -> Place:
    """Read KIND or KIND@TARGET; the target may be left out where there is only one.

    Raises:
        UserError: There is no such kind or target, or the target has to be named.
    """
    kind, _, target = text.partition("@")
    cls = choose("effect", kind, model.catalogue)
    targets = cls.targets(model.compile(engine="mujoco").host.model)
    if target and target not in targets:
        raise unknown_name(f"target of {kind}", target, targets)
    if not target and len(targets) != 1:
        listed = ", ".join(targets) or "nowhere in this model"
        raise UserError(f"{kind} can act at {listed}; write {kind}@TARGET")
    return Place(kind, target or targets[0])


def plan(
    model: Model,
    first: Place,
    second: Place,
    seconds: float,
    seed: int = 0,
    say: Callable[[str], None] = lambda message: None,
) -> Planned:
    """Find an excitation that tells two effects apart.

    Args:
        model: The model.
        first: One effect.
        second: The other.
        seconds: Length of the excitation.
        seed: Draws the excitations.
        say: Told what is being done.

    Raises:
        UserError: The model has no actuators, the effects are the same, or one shows in nothing.
    """
    host = native_model(model.compile(engine="mujoco"))
    if host.nu == 0:
        raise UserError(f"{model.path} has no actuators, so nothing can be commanded")
    if first == second:
        raise UserError(f"{first} and {second} are the same; name two effects")
    limited = host.actuator_ctrllimited.astype(bool)[:, None]
    limits = np.where(limited, host.actuator_ctrlrange, [-UNLIMITED, UNLIMITED])
    time = np.arange(round(seconds * RATE)) / RATE
    judge = _Judge(model, (first, second), time, (host.nq, host.nv, host.nu))
    rng = np.random.default_rng(seed)
    plain = _scaled(np.sin(2 * np.pi * 0.5 * time)[:, None] * np.ones(host.nu), limits, 0.3, 0.0)
    before = judge(plain)
    best = (np.inf, plain, "a sine", None)
    for trial in range(TRIALS + VARIATIONS):
        say(f"trying excitation {trial + 1} of {TRIALS + VARIATIONS}")
        if trial < TRIALS or best[3] is None:
            shape, family = _draw(trial, time, host.nu, rng)
            amplitude, bias = rng.uniform(0.1, 1.0), rng.uniform(-0.5, 0.5)
        else:
            shape, family, amplitude, bias = best[3]
            amplitude = float(np.clip(amplitude * np.exp(rng.normal(0, 0.4)), 0.05, 1.0))
            bias = float(np.clip(bias + rng.normal(0, 0.2), -0.9, 0.9))
        ctrl = _scaled(shape, limits, amplitude, bias)
        cosine = judge(ctrl)
        if cosine < best[0]:
            best = (cosine, ctrl, family, (shape, family, amplitude, bias))
    if not np.isfinite(best[0]):
        raise UserError(f"no excitation was found under which both {first} and {second} show")
    return Planned(time, best[1], best[2], before, best[0])


def write_plan(planned: Planned, model: Model, path: Path) -> Path:
    """Write an excitation as CSV: time and a column `ctrl.ACTUATOR` each."""
    names = element_names(model.compile(engine="mujoco").host.model, "actuator")
    columns = {f"ctrl.{name}": planned.ctrl[:, i] for i, name in enumerate(names)}
    return write_csv(path, {"time": planned.time, **columns})


def _draw(number: int, time: np.ndarray, num: int, rng: np.random.Generator):
    """Draw one of the families by turns: commands within -1 to 1, [T, num], and its name."""
    kind = number % 3
    if kind == 0:
        rates = rng.uniform(0.1, 3.0, (6, num))
        phases = rng.uniform(0, 2 * np.pi, (6, num))
        waves = np.sin(2 * np.pi * time[:, None, None] * rates + phases).mean(axis=1)
        return waves / np.abs(waves).max(axis=0), "a multi-sine"
    if kind == 1:
        hold = rng.uniform(0.15, 1.0)
        index = (time / hold).astype(int)
        return rng.uniform(-1, 1, (index[-1] + 1, num))[index], "a train of steps"
    low, high = rng.uniform(0.05, 0.5), rng.uniform(1.0, 5.0)
    rate = low + 0.5 * (high - low) * time / time[-1]
    return np.sin(2 * np.pi * rate[:, None] * time[:, None] + rng.uniform(0, 6, num)), "a chirp"


def _scaled(shape: np.ndarray, limits: np.ndarray, amplitude: float, bias: float) -> np.ndarray:
    """Put a shape within -1 to 1 into the limits, [T, nu]."""
    middle, half = limits.mean(axis=1), 0.5 * (limits[:, 1] - limits[:, 0])
    return np.clip(middle + half * (bias + amplitude * shape), limits[:, 0], limits[:, 1])


class _Judge:
    """Tells how alike two effects are under an excitation."""

    def __init__(self, model: Model, places: tuple[Place, Place], time, shape):
        self._time = time
        self._shape, num_u = shape[:2], shape[2]
        effects = tuple(self._nominal(model, place) for place in places)
        still = self._recording(np.zeros((len(time), num_u)))
        timestep = model.compile(engine="mujoco").host.model.opt.timestep
        self._grid = choose_grid([still], timestep)
        self._simulator = Simulator(model, effects, self._grid)
        host = self._simulator.host
        self._rest = host.qpos0.copy()
        self._sizes = [type(e).starts(host, e.target)[0] for e in effects]

    @staticmethod
    def _nominal(model: Model, place: Place) -> Effect:
        cls = model.catalogue[place.kind]
        return cls(target=place.target, **{p.name: p.nominal for p in cls.parameters()})

    def _recording(self, ctrl: np.ndarray) -> Recording:
        num = len(self._time)
        nothing = np.zeros((num, self._shape[0])), np.zeros((num, self._shape[1]))
        return Recording("plan", self._time, *nothing, ctrl, {}, True, ((0, num),), ())

    def __call__(self, ctrl: np.ndarray) -> float:
        """Return the cosine of the two effects, infinite if one does not show or it diverges."""
        simulator, recording = self._simulator, self._recording(ctrl)
        whole = cut([recording], self._grid, len(self._time) / RATE)
        rest = np.concatenate([self._rest, np.zeros(self._shape[1])])
        path = simulator.predict(simulator.base[None], rest[None, None], whole)[0, 0]
        if not np.isfinite(path).all():
            return np.inf
        qpos, qvel = np.split(path, [self._shape[0]], axis=1)
        moved = Recording("plan", self._time, qpos, qvel, ctrl, {}, True, recording.spans, ())
        segments = cut([moved], self._grid, HORIZON)
        everywhere = np.ones(len(segments.start), bool)
        problem = Problem(simulator, simulator, segments, everywhere, 1.0 / RATE)
        lin = linearise(problem, simulator.base, segments.start, (), ())
        changes = self._changes(problem, segments.start, lin.residual)
        first, second = StartSpace(lin.start).remove(changes).reshape(-1, 2).T
        sizes = np.linalg.norm(first), np.linalg.norm(second)
        if min(sizes) <= VISIBLE * max(sizes):
            return np.inf
        return float(abs(first @ second) / (sizes[0] * sizes[1]))

    def _changes(self, problem: Problem, start: np.ndarray, residual: np.ndarray) -> np.ndarray:
        """Return the change that each effect makes at the first size it is tried at, [S, N, 2]."""
        simulator = self._simulator
        thetas = np.tile(simulator.base, (len(self._sizes), 1))
        for j, slot in enumerate(simulator.slots):
            size = self._sizes[slot.effect]
            thetas[slot.effect, j] = size.get(slot.parameter.name, simulator.base[j])
        starts = np.tile(start, (len(thetas), 1, 1))
        moved = problem.whiten(simulator.predict(thetas, starts, problem.segments))
        return np.moveaxis(moved - residual, 0, -1)
