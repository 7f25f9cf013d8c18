"""Plan an excitation, within the limits of actuators and joints, that tells two effects apart.

What an effect changes in the signals, without what a free initial state can make, is a direction.
Where two directions are parallel, no fit can tell the effects apart. A law whose parameters act by
themselves has a direction for each, and the space of all counts. Random multi-sines, step
trains and chirps are tried, and the best one is varied; the angle decides, and that both
effects show. One under which a joint of the model leaves its range is made smaller until none does.
"""

import dataclasses
import html
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import plotly.graph_objects as go

from garat_jax.diagnosis.convert import write_csv
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.model_card import Model, check_model
from garat_jax.diagnosis.problem import Problem, StartSpace
from garat_jax.diagnosis.segments import choose_grid, cut
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.diagnosis.starts import as_measured
from garat_jax.dynamics import native_model
from garat_jax.effects import Effect, are_exclusive
from garat_jax.effects.catalogue import choose_kind
from garat_jax.effects.elements import element_names
from garat_jax.errors import UserError, unknown_name
from garat_jax.report import styled

RATE = 100.0
"""Commands a second."""
SHORTEST, LONGEST = 2.0, 600.0
"""Seconds that an excitation may last."""
HORIZON = 1.0
"""Seconds of a segment, whose initial state is free."""
TRIALS = 12
"""Random excitations that are tried."""
VARIATIONS = 12
"""Variations of the best one."""
HALVINGS = 8
"""How often an excitation under which a joint leaves its range is halved before it is given up."""
BEYOND = 1e-3
"""How far a joint may be beyond its range, more than at rest, relative to the range."""
APART = 0.05
"""Size of a direction, relative to the first, above which parameters of a law span it."""
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
        places: The two effects.
        actuators: The actuators' names, [nu].
    """

    time: np.ndarray
    ctrl: np.ndarray
    family: str
    before: float
    after: float
    places: tuple[Place, Place]
    actuators: tuple[str, ...]

    def __str__(self) -> str:
        first, second = self.places
        return (
            f"{first} and {second}: cosine {self.before:.3f} under a plain sine, "
            f"{self.after:.3f} under {self.family} (1: no recording can tell them apart)"
        )

    def _repr_html_(self) -> str:
        """Return what a notebook shows."""
        return f"<pre>{html.escape(str(self))}</pre>"

    def plot(self) -> go.Figure:
        """Draw the commands."""
        figure = go.Figure()
        for name, ctrl in zip(self.actuators, self.ctrl.T, strict=True):
            figure.add_scatter(x=self.time, y=ctrl, name=name, line={"shape": "hv"})
        figure = styled(figure, height=320).update_xaxes(title_text="time [s]")
        return figure.update_yaxes(title_text="command")


def parse_place(text: str, model: Model) -> Place:
    """Read KIND or KIND@TARGET; the target may be left out where there is only one.

    Places are those of the model without its own effects, of which some add bodies.

    Raises:
        UserError: There is no such kind or target, or the target has to be named.
    """
    kind, _, target = text.partition("@")
    cls = choose_kind(kind, model.catalogue)
    bare = dataclasses.replace(model, effects=())
    targets = cls.targets(native_model(bare.compile(engine="mujoco")))
    if not targets:
        raise UserError(f"{kind} can act nowhere in {model.path}: it needs {cls.needs}")
    if not target and len(targets) != 1:
        raise UserError(f"{kind} can act at {', '.join(targets)}; write {kind}@TARGET")
    if target and target not in targets:
        raise unknown_name(f"target of {kind}", target, targets)
    place = Place(kind, target or targets[0])
    for present in model.effects:
        is_same = (present.kind, present.target) == place  # then another size is looked for
        if not is_same and are_exclusive(present, cls(target=place.target)):
            raise UserError(
                f"{model.path} has {present.kind} at {present.target}, which excludes {text}; plan "
                "with the model without it"
            )
    return place


def plan(
    model: Model,
    first: Place | str,
    second: Place | str,
    seconds: float = 8.0,
    seed: int = 0,
    say: Callable[[str], None] = lambda message: None,
) -> Planned:
    """Find an excitation that tells two effects apart.

    Args:
        model: The model.
        first: One effect, or its name as `parse_place` reads it.
        second: The other.
        seconds: Length of the excitation, 2 to 600.
        seed: Draws the excitations; 0 or more.
        say: Told what is being done.

    Raises:
        UserError: The model has no actuators or one without limits, an effect is unknown, they are
            the same, or one shows in nothing, or the length or the seed is out of range.
    """
    check_model(model)
    if not SHORTEST <= seconds <= LONGEST:
        raise UserError(f"seconds {seconds:g}: expected {SHORTEST:g} to {LONGEST:g}")
    if seed < 0:
        raise UserError(f"seed {seed}: expected 0 or more")
    first, second = (parse_place(p, model) if isinstance(p, str) else p for p in (first, second))
    places = (first, second)
    host = native_model(model.compile(engine="mujoco"))
    limits = _limits(model, host)
    if first == second:
        raise UserError(f"{first} and {second} are the same; name two effects")
    time = np.arange(round(seconds * RATE)) / RATE
    judge = _Judge(model, places, time, limits)
    rng = np.random.default_rng(seed)
    sine = np.sin(2 * np.pi * 0.5 * time)[:, None] * np.ones(host.nu)
    before, plain = judge(sine, 0.3, 0.0)
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
        cosine, ctrl = judge(shape, amplitude, bias)
        if cosine < best[0]:
            best = (cosine, ctrl, family, (shape, family, amplitude, bias))
    if not np.isfinite(best[0]):
        raise UserError(
            f"no excitation was found under which both {first} and {second} show "
            f"and all joints stay within their ranges{judge.why}"
        )
    names = tuple(element_names(host, "actuator"))
    return Planned(time, best[1], best[2], min(before, 1.0), best[0], places, names)


def write_plan(planned: Planned, path: str | Path) -> Path:
    """Write an excitation as CSV: time and a column `ctrl.ACTUATOR` each."""
    columns = {f"ctrl.{name}": planned.ctrl[:, i] for i, name in enumerate(planned.actuators)}
    return write_csv(Path(path), {"time": planned.time, **columns})


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


def _limits(model: Model, host: mujoco.MjModel) -> np.ndarray:
    """Return the least and the largest command of each actuator, [nu, 2]."""
    if host.nu == 0:
        raise UserError(f"{model.path} has no actuators, so nothing can be commanded")
    free = np.flatnonzero(~host.actuator_ctrllimited.astype(bool))
    if free.size:
        names = element_names(host, "actuator")
        raise UserError(
            f"{model.path}: no ctrlrange at {', '.join(names[i] or f'actuator {i}' for i in free)}"
            ", so nothing says how large a command may be; give one in the MJCF or by an override"
        )
    return host.actuator_ctrlrange


def _scaled(shape: np.ndarray, limits: np.ndarray, amplitude: float, bias: float) -> np.ndarray:
    """Put a shape within -1 to 1 into the limits, [T, nu]."""
    middle, half = limits.mean(axis=1), 0.5 * (limits[:, 1] - limits[:, 0])
    return np.clip(middle + half * (bias + amplitude * shape), limits[:, 0], limits[:, 1])


class _Judge:
    """Tells how alike two effects are under an excitation."""

    def __init__(self, model: Model, places: tuple[Place, Place], time, limits: np.ndarray):
        self._time, self._limits = time, limits
        self._host = host = model.compile(engine="mujoco").host.model
        effects = []
        for kind, target in places:
            cls = model.catalogue[kind]
            effects.append(cls(target=target, **cls.at(host, target)))
        rest = np.concatenate([host.qpos0, np.zeros(host.nv)])
        self._resting = np.tile(rest, (len(time), 1))
        still = self._recording(self._resting, np.zeros((len(time), host.nu)))
        self._grid = choose_grid([still], host.opt.timestep)  # activations are known from rest on
        self._simulator = Simulator(model, effects, self._grid)
        is_nested = any(e.kind in type(other).refines for e in effects for other in effects)
        listed = [_sizes(effect, host)[: 1 if is_nested else None] for effect in effects]
        self._sizes = [(number, size) for number, sizes in enumerate(listed) for size in sizes]
        self._places, self._hidden, self._outside = places, set(), set()

    @property
    def why(self) -> str:
        """What kept excitations from being of use, as a clause; empty if nothing did."""
        reasons = []
        if self._outside:
            left = "leaves its range" if len(self._outside) == 1 else "leave theirs"
            reasons.append(
                f"{', '.join(sorted(self._outside))} {left} even under small commands "
                "(does it fall, or is ctrlrange in another unit than the actuator takes?)"
            )
        if self._hidden:
            reasons.append(f"{' and '.join(sorted(map(str, self._hidden)))} did not show")
        return f": {', and '.join(reasons)}" if reasons else ""

    def _recording(self, path: np.ndarray, ctrl: np.ndarray) -> Recording:
        qpos, qvel = np.split(path, [self._host.nq], axis=1)
        return Recording("plan", self._time, qpos, qvel, ctrl, {}, True, ((0, len(path)),), ())

    def __call__(self, shape: np.ndarray, amplitude: float, bias: float):
        """Return the cosine of the two effects, and the commands that were judged, [T, nu].

        It is infinite if one effect does not show, or a joint leaves its range however small the
        commands are.
        """
        beyond: set[str] = set()
        for part in 0.5 ** np.arange(HALVINGS):
            ctrl = _scaled(shape, self._limits, part * amplitude, part * bias)
            path = self._path(ctrl)
            beyond = self._beyond(path)
            if not beyond:
                return self._cosine(path, ctrl), ctrl
        self._outside |= beyond
        return np.inf, _scaled(shape, self._limits, 0.0, 0.0)

    def _path(self, ctrl: np.ndarray) -> np.ndarray:
        """Return the states that commands lead to from rest, [T, nq + nv]."""
        still = self._recording(self._resting, ctrl)
        whole = cut([still], self._grid, len(ctrl) / RATE)
        base, start = self._simulator.base[None], self._resting[:1]
        return self._simulator.predict(base, start[None], whole)[0, 0]

    def _beyond(self, path: np.ndarray) -> set[str]:
        """Name the joints that leave their range by more than at rest; all if a motion diverges."""
        host, names = self._host, np.asarray(element_names(self._host, "joint"))
        if not np.isfinite(path).all():
            return {*names.tolist()}
        joints = np.flatnonzero(host.jnt_limited)  # never of free ones
        low, high = host.jnt_range[joints].T
        position = path[:, host.jnt_qposadr[joints]]
        is_ball = host.jnt_type[joints] == mujoco.mjtJoint.mjJNT_BALL  # w of a quaternion
        turned = 2.0 * np.arccos(np.minimum(np.abs(position), 1.0))
        position = np.where(is_ball, turned, position)
        beyond = np.maximum(low - position, position - high) / (high - low)
        allowed = BEYOND + np.maximum(beyond[0], 0.0)
        return {*names[joints[np.any(beyond > allowed, axis=0)]].tolist()}

    def _cosine(self, path: np.ndarray, ctrl: np.ndarray) -> float:
        """Return the cosine of the two effects, infinite if one does not show.

        Of parameters that act by themselves any combination may be meant: of all, the pair that is
        most alike counts (the cosine of the smallest angle between the two spaces). A law that
        refines the other one contains it, and is held against it by its first parameter.
        """
        simulator = self._simulator
        segments = cut([self._recording(path, ctrl)], self._grid, HORIZON)
        everywhere = np.ones(len(segments.start), bool)
        problem = Problem(simulator, segments, everywhere, 1.0 / RATE)
        start, lin = as_measured(problem, simulator.base)
        changes = self._changes(problem, start, lin.residual)
        changed = StartSpace(lin.start).remove(changes).reshape(-1, len(self._sizes))
        owner = np.asarray([number for number, _ in self._sizes])
        norms = np.linalg.norm(changed, axis=0)
        most = [norms[owner == number].max() for number in range(2)]
        if min(most) <= VISIBLE * max(most):
            self._hidden.add(self._places[int(np.argmin(most))])
            return np.inf
        shows = norms > VISIBLE * max(most)
        first, second = (_space(changed[:, shows & (owner == i)]) for i in range(2))
        return float(np.linalg.norm(first.T @ second, 2))

    def _changes(self, problem: Problem, start: np.ndarray, residual: np.ndarray) -> np.ndarray:
        """Return the change that each effect makes at each size it is tried at, [S, N, K]."""
        simulator = self._simulator
        thetas = np.tile(simulator.base, (len(self._sizes), 1))
        for theta, (number, size) in zip(thetas, self._sizes, strict=True):
            for j, slot in enumerate(simulator.slots):
                if slot.effect == number:
                    theta[j] = size.get(slot.parameter.name, simulator.base[j])
        starts = np.tile(start, (len(thetas), 1, 1))
        moved = problem.whiten(simulator.predict(thetas, starts, problem.segments))
        return np.moveaxis(moved - residual, 0, -1)


def _space(columns: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis [M, rank] of what columns [M, k] that are not zero span."""
    basis, sizes, _ = np.linalg.svd(columns / np.linalg.norm(columns, axis=0), full_matrices=False)
    return basis[:, sizes > APART * sizes[0]]


def _sizes(effect: Effect, host: mujoco.MjModel) -> list[Mapping[str, float]]:
    """Return the size at which an effect is tried, or one of each parameter that acts by itself."""
    first, *more = type(effect).starts(host, effect.target)
    if more or not effect.independent:
        return [first]
    return [{p.name: float(getattr(effect, p.name)) + p.scale} for p in effect.parameters()]
