"""Measure what the constraint solver's settings cost in accuracy and give in speed, in every world.

`python benchmarks/fidelity.py`: the target of each pair goes from states in contact under random
commands, in both engines and float32, with each of the solver's settings. The reference is C
MuJoCo in float64 with the settings of Gymnasium's models, which are MuJoCo's defaults; beside the
errors stands how far the reference itself goes apart when the states are moved by 1e-7.

Settings are faithful if no simulation leaves the finite numbers, and if after 1, 5 and 50 control
steps the largest errors of positions and of velocities are within ten times the perturbation's
growth, which is what rounding does, or within 1.5 times those of the same engine with the
reference's settings, which no setting removes: its rounding, and what the engines do differently.
"""

import dataclasses
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import tyro
from numpy.typing import NDArray
from record import write_result

from garat_jax import dynamics
from garat_jax.compiler_options import compiler_options
from garat_jax.dynamics import Override
from garat_jax.env import World, make_world
from garat_jax.envs.pairs import PAIRS
from garat_jax.errors import choose
from garat_jax.transfer import Pair

HORIZONS = (1, 5, 50)
"""Control steps after which states are compared."""
PERTURBATION = 1e-7
"""About half of float32's spacing at 1."""
NUM_STATES = 32
NUM_PERTURBED = 4
"""Perturbations of every state; the largest growth counts."""
EPISODE = 100
"""Control steps of the random episodes that states come from, ended by falls."""
ENGINES = ("mjx", "mujoco")
EXPLODED = 1e10
"""Absolute value beyond which a state counts as not finite; MuJoCo's mjMAXVAL."""
MARGIN = 10.0
"""How many times the perturbation's growth an error may be: float32 rounds in every substep."""
FLOOR = 1.5
"""How many times the error under the strict settings an error may be: the scatter of maxima."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measure accuracy and speed of the constraint solver's settings."""

    pair: tuple[str, ...] = tuple(PAIRS)
    """Pairs whose targets are measured, a file of results each."""
    repetitions: int = 3
    """Timed runs of each program; the median counts."""


class Solver(NamedTuple):
    """Settings of MuJoCo's constraint solver."""

    solver: str
    iterations: int
    ls_iterations: int

    def overrides(self) -> tuple[Override, ...]:
        algorithm = getattr(mujoco.mjtSolver, f"mjSOL_{self.solver.upper()}")
        settings = self._asdict() | {"solver": algorithm}
        return tuple(Override("option", "", name, value) for name, value in settings.items())


STRICT = Solver("Newton", 100, 50)
"""MuJoCo's defaults, which Gymnasium's models leave as they are."""
SOLVERS = (
    STRICT,
    Solver("Newton", 4, 8),
    Solver("Newton", 4, 4),
    Solver("Newton", 1, 4),
    Solver("CG", 8, 8),
)


class Start(NamedTuple):
    """Where the simulations begin and what they are told.

    Attributes:
        qpos: [N, nq].
        qvel: [N, nv].
        ctrl: Commands, [steps, N, nu].
    """

    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray

    def perturbed(self, host: mujoco.MjModel, seed: int) -> "Start":
        """Move each position and velocity by at most the perturbation, along the joints."""
        random = np.random.default_rng(seed)
        qpos, shape = self.qpos.copy(), self.qvel.shape
        moves = random.uniform(-PERTURBATION, PERTURBATION, (2, *shape))
        for row, move in zip(qpos, moves[0], strict=True):
            mujoco.mj_integratePos(host, row, move, 1.0)
        return Start(qpos, self.qvel + moves[1], self.ctrl)


def world_of(pair: Pair, engine: str, solver: Solver) -> World:
    overrides = (*pair.target, *solver.overrides())
    return make_world(pair.task, overrides, pair.target_effects, engine)


def begin(world: World, seed: int) -> Start:
    """Collect states in contact from random episodes; in a world without contacts, at limits.

    They are numbers that float32 can hold, so that the engines begin where the reference does.

    Episodes end where the task ends them; limits of the pendulum lie beyond its falls, so that
    episodes in worlds without contacts go on.
    """
    host = world.params.host.model
    has_contacts = bool(host.geom_contype.any() and host.geom_conaffinity.any())
    reset_key, action_key, ctrl_key = jax.random.split(jax.random.key(seed), 3)

    def run(key: jax.Array, actions: jax.Array):
        keys = jax.random.split(key, EPISODE + 1)

        def step(carry, inputs):
            (state, up), (action, key) = carry, inputs
            result = world.env.step(world.params, state, action, key)
            up = up & ~(result.terminated & has_contacts)
            return (result.state, up), (result.state.physics.qpos, result.state.physics.qvel, up)

        start = (world.env.reset(world.params, keys[0]), jnp.asarray(True))
        return jax.lax.scan(step, start, (actions, keys[1:]))

    shape = (NUM_STATES, EPISODE, world.env.action_size)
    actions = _uniform(action_key, shape, world)
    keys = jax.random.split(reset_key, NUM_STATES)
    _, found = jax.jit(jax.vmap(run))(keys, actions)
    qpos, qvel, up = (np.asarray(x).reshape(-1, *x.shape[2:]) for x in found)
    states = zip(qpos, qvel, strict=True)
    touching = np.flatnonzero(up & [_touches(host, has_contacts, *state) for state in states])
    if len(touching) < NUM_STATES:
        raise RuntimeError(f"only {len(touching)} of {len(up)} states are in contact")
    chosen = np.random.default_rng(seed).choice(touching, NUM_STATES, replace=False)
    ctrl = np.asarray(_uniform(ctrl_key, (max(HORIZONS), NUM_STATES, host.nu), world))
    exact = (x.astype(np.float32).astype(float) for x in (qpos[chosen], qvel[chosen], ctrl))
    return Start(*exact)


def _uniform(key: jax.Array, shape: tuple[int, ...], world: World) -> jax.Array:
    low, high = world.env.action_low, world.env.action_high
    return jax.random.uniform(key, shape, minval=low, maxval=high)


def _touches(host: mujoco.MjModel, has_contacts: bool, qpos: np.ndarray, qvel: np.ndarray) -> bool:
    data = mujoco.MjData(host)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(host, data)
    return bool(data.ncon if has_contacts else data.nefc)


Run = Callable[[Start], tuple[NDArray, NDArray]]
"""From a start to qpos and qvel after every control step, [steps, N, ..]."""


def compiled(worlds: list[World], start: Start) -> list[Run]:
    """Compile, side by side, a program for each world that goes from a start."""
    lowered = [_lowered(world, start) for world in worlds]
    with ThreadPoolExecutor() as pool:
        programs = list(pool.map(lambda program: program.compile(), lowered))

    def runner(program: jax.stages.Compiled) -> Run:
        return lambda start: jax.tree.map(np.asarray, program(*map(jnp.asarray, start)))

    return [runner(program) for program in programs]


def _lowered(world: World, start: Start) -> jax.stages.Lowered:

    def run(qpos, qvel, ctrl):
        def step(state, command):
            state = dynamics.step(world.params, state, command, world.env.task.num_substeps)
            return state, (state.qpos, state.qvel)

        state = dynamics.initial_state(world.params, qpos, qvel)
        return jax.lax.scan(step, state, ctrl)[1]

    batched = jax.vmap(run, in_axes=(0, 0, 1), out_axes=1)
    arguments = jax.tree.map(jnp.asarray, tuple(start))
    return jax.jit(batched, compiler_options=compiler_options(world.params)).lower(*arguments)


def reference(pair: Pair, seed: int) -> tuple[Start, tuple, list[tuple[NDArray, NDArray]]]:
    """Return a start, where it leads in float64, and how far perturbed starts go from there."""
    with jax.enable_x64(True):
        world = world_of(pair, "mujoco", STRICT)
        start = begin(world, seed)
        (run,) = compiled([world], start)
        truth = run(start)
        host = world.params.host.model
        perturbed = [run(start.perturbed(host, number)) for number in range(NUM_PERTURBED)]
    return start, truth, [gaps(paths, truth) for paths in perturbed]


def gaps(paths: tuple, truth: tuple) -> tuple[NDArray, NDArray]:
    """Return the largest differences of qpos and of qvel of each state, [horizons, N] each."""
    at = np.asarray(HORIZONS) - 1
    with np.errstate(invalid="ignore"):
        differences = [np.abs(path - true)[at] for path, true in zip(paths, truth, strict=True)]
    return tuple(difference.max(axis=-1) for difference in differences)


def by_horizon(errors: NDArray, of: Callable = np.max) -> dict[str, float]:
    """Summarise errors [horizons, N] of the states that are finite."""
    finite = np.where(errors < EXPLODED, errors, np.nan)
    kept = [row[np.isfinite(row)] for row in finite]
    return {str(h): float(of(row)) for h, row in zip(HORIZONS, kept, strict=True) if row.size}


def measure(name: str, engine: str, repetitions: int, seed: int) -> list[dict[str, Any]]:
    """Return one row for each of the solver's settings."""
    start, truth, growth = reference(PAIRS[name], seed)
    growth = [np.max(parts, axis=0) for parts in zip(*growth, strict=True)]
    start = Start(*(x.astype(np.float32) for x in start))
    programs = compiled([world_of(PAIRS[name], engine, solver) for solver in SOLVERS], start)
    rows = []
    for solver, program in zip(SOLVERS, programs, strict=True):
        paths = program(start)
        errors = gaps(paths, truth)
        lost = ~(np.abs(np.concatenate(paths, axis=-1)) < EXPLODED).all(axis=(0, 2))
        row: dict[str, Any] = {"pair": name, "engine": engine, **solver._asdict()}
        for label, error, grown in zip(("qpos", "qvel"), errors, growth, strict=True):
            row[f"{label}_error"] = by_horizon(error)
            row[f"{label}_error_median"] = by_horizon(error, np.median)
            row[f"{label}_growth"] = by_horizon(grown)
        rows.append(row | {"not_finite": int(lost.sum())})
    times = [[seconds_of(program, start) for program in programs] for _ in range(repetitions)]
    for row, median in zip(rows, np.median(times, axis=0), strict=True):
        row["steps_per_second"] = float(start.ctrl.shape[0] * NUM_STATES / median)
        row["faithful"] = is_faithful(row, rows[0])
        print(told(row), flush=True)
    return rows


def seconds_of(program: Run, start: Start) -> float:
    started = time.perf_counter()
    program(start)
    return time.perf_counter() - started


def is_faithful(row: dict[str, Any], strict: dict[str, Any]) -> bool:
    """Judge settings beside those of the reference in the same engine; see above."""
    return row["not_finite"] == 0 and all(
        row[f"{label}_error"][horizon]
        <= max(MARGIN * row[f"{label}_growth"][horizon], FLOOR * strict[f"{label}_error"][horizon])
        for label in ("qpos", "qvel")
        for horizon in map(str, HORIZONS)
    )


def told(row: dict[str, Any]) -> str:
    errors = "  ".join(
        f"{row['qpos_error'].get(h, np.nan):.0e} {row['qvel_error'].get(h, np.nan):.0e}"
        f" ({row['qpos_growth'][h]:.0e} {row['qvel_growth'][h]:.0e})"
        for h in map(str, HORIZONS)
    )
    return (
        f"{row['pair']:24}{row['engine']:7} {row['solver']:6} {row['iterations']:3}/"
        f"{row['ls_iterations']:<2}  {errors}  {row['not_finite']:2} not finite "
        f"{row['steps_per_second']:9,.0f} steps/s {'faithful' if row['faithful'] else ''}"
    )


def main() -> None:
    arguments = tyro.cli(Arguments)
    for pair in arguments.pair:
        choose("pair", pair, PAIRS)
    busy, seed = os.getloadavg()[0], 0
    for pair in arguments.pair:
        rows = [
            row | {"load_average_before": busy}
            for engine in ENGINES
            for row in measure(pair, engine, arguments.repetitions, seed)
        ]
        command = (
            f"python benchmarks/fidelity.py --pair {pair} --repetitions {arguments.repetitions}"
        )
        print(write_result(f"fidelity_{pair}", rows, seeds=[seed], command=command))


if __name__ == "__main__":
    main()
