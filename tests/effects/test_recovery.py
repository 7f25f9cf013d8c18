"""Parameters are recovered from data that plain C MuJoCo made at a 32nd of the timestep.

The truth uses neither the catalogue nor the engine: native fields, forces and late rows.
"""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy import optimize

from garat_jax.diagnosis.diagnose import make_candidates
from garat_jax.diagnosis.fit import fit
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.model_card import Model
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.segments import choose_grid, cut
from garat_jax.diagnosis.simulate import Simulator
from tests.models import PENDULUM, SLIDER, spec

REFINEMENT = 32
RATE = 250.0
ACROSS = PENDULUM.replace('axis="0 1 0"', 'axis="1 0 0"')
"""The pendulum about the other axis, across which it is tilted and displaced."""


def nothing(*_) -> None:
    """Leave it as it is."""


@dataclasses.dataclass(frozen=True)
class Case:
    """One hidden effect: its true parameters, and how plain MuJoCo has it."""

    mjcf: str
    kind: str
    truth: Mapping[str, float]
    change: Callable[[mujoco.MjModel], None] = nothing
    force: Callable[[mujoco.MjModel, mujoco.MjData], None] = nothing
    report: Callable[[np.ndarray], np.ndarray] = lambda states: states
    late: float = 0.0
    target: str = ""
    """Empty where the model has one place only."""
    rel: float = 0.02
    refinement: int = REFINEMENT
    """How many times finer than the MJCF's the timestep of the recording is."""
    seconds: float = 4.0
    """Length of a recording; what follows an impact hangs on it by a hair."""


def shift_com(model: mujoco.MjModel) -> None:
    model.body_sameframe[:] = 0
    model.body_ipos[1] += [0.04, 0.0, -0.02]
    mujoco.mj_setConst(model, mujoco.MjData(model))


def tilt(model: mujoco.MjModel) -> None:
    model.opt.gravity[:] = [-9.81 * np.sin(0.1), 0.0, -9.81 * np.cos(0.1)]


def turn(model: mujoco.MjModel) -> None:
    model.opt.gravity[:] = [0.0, 9.81 * np.sin(0.1), -9.81 * np.cos(0.1)]


def shift_sideways(model: mujoco.MjModel) -> None:
    model.body_sameframe[:] = 0
    model.body_ipos[1] += [0.0, 0.04, -0.02]
    mujoco.mj_setConst(model, mujoco.MjData(model))


def heavy_rotor(model: mujoco.MjModel) -> None:
    model.dof_armature += 0.02
    mujoco.mj_setConst(model, mujoco.MjData(model))


def drag(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jacBodyCom(model, data, jacobian, None, 1)
    velocity = jacobian @ data.qvel
    data.qfrc_applied[:] = -0.4 * np.linalg.norm(velocity) * jacobian.T @ velocity


def slippery(model: mujoco.MjModel) -> None:
    model.geom_friction[:, 0] = 0.35


def springy(model: mujoco.MjModel) -> None:
    model.geom_solref[:] = [0.04, 0.3]


def add_offset(states: np.ndarray) -> np.ndarray:
    return states + np.asarray([0.2, 0.0])


CASES = {
    f"{case.kind} {' '.join(case.truth)}": case
    for case in (
        Case(PENDULUM, "com_offset", {"x": 0.04, "z": -0.02}, shift_com),
        Case(ACROSS, "com_offset", {"y": 0.04, "z": -0.02}, shift_sideways),
        Case(PENDULUM, "air_drag", {"coefficient": 0.4}, force=drag),
        Case(PENDULUM, "gravity_tilt", {"pitch": 0.1}, tilt),
        Case(ACROSS, "gravity_tilt", {"roll": 0.1}, turn),
        Case(PENDULUM, "rotor_inertia", {"inertia": 0.02}, heavy_rotor),
        Case(
            PENDULUM, "encoder_scale", {"scale": 1.1}, report=lambda states: 1.1 * states,
        ),
        Case(
            PENDULUM, "encoder_offset", {"offset": 0.2}, report=add_offset,
        ),
        Case(PENDULUM, "sensor_delay", {"delay": 0.015}, late=0.015, rel=0.05),
        Case(SLIDER, "contact_friction", {"sliding": 0.35}, slippery, target="geom/ball"),
        Case(
            SLIDER, "contact_compliance", {"time_constant": 0.04, "damping_ratio": 0.3}, springy,
            target="geom/ball", refinement=16, seconds=1.4, rel=0.05,
        ),
    )
}  # fmt: skip


def record(case: Case, seed: int) -> Recording:
    """Step plain MuJoCo, note its state at every fine step, and read it as late as the sensors."""
    rng = np.random.default_rng(seed)
    model = spec(case.mjcf).compile()
    model.opt.timestep /= case.refinement
    case.change(model)
    data = mujoco.MjData(model)
    time = np.arange(round(case.seconds * RATE)) / RATE
    ctrl = 0.8 * np.sin(9 * time + seed) * np.sign(np.sin(2 * time))
    if case.mjcf is SLIDER:  # drop it, and push harder than friction holds
        data.qpos[0], ctrl = 0.36, 4.0 * np.sign(np.sin(8 * time + seed))
    else:
        data.qpos[0] = 0.8
    per_sample = round(1.0 / RATE / model.opt.timestep)
    path = np.zeros((len(time) * per_sample, model.nq + model.nv))
    for k in range(len(path)):
        path[k] = np.concatenate([data.qpos, data.qvel])
        data.ctrl[:] = ctrl[k // per_sample]
        case.force(model, data)
        mujoco.mj_step(model, data)
    rows = np.arange(len(time)) * per_sample - round(case.late / model.opt.timestep)
    states = case.report(path[np.maximum(rows, 0)])
    states = states + rng.normal(size=states.shape) * np.repeat([1e-4, 1e-3], model.nv)
    kept = slice(10, None)  # what precedes the recording moved, too
    return Recording(
        name=f"made {seed}",
        time=time[kept] - time[10],
        qpos=states[kept, : model.nq],
        qvel=states[kept, model.nq :],
        ctrl=ctrl[kept, None],
        torque={},
        velocity_measured=True,
        spans=((0, len(time) - 10),),
        warnings=(),
    )


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_the_parameters_are_recovered(case):
    source = spec(case.mjcf)
    if case.kind == "contact_compliance":  # in an impact 2 ms err by 5 % of it, 0.5 ms by 2 %
        source.option.timestep /= 4
    model = Model("model", Path(__file__), Path(__file__), source)
    host = model.compile(engine="mujoco").host.model
    chosen = [
        effect
        for effect in make_candidates(model)
        if effect.kind == case.kind and effect.target == (case.target or effect.target)
    ]
    assert len(chosen) == 1
    recordings = [record(case, seed) for seed in range(2)]
    grid = choose_grid(recordings, host.opt.timestep)
    segments = cut(recordings, grid, 0.5)
    simulator = Simulator(model, chosen, grid)
    everything = np.ones(len(segments.start), bool)
    problem = Problem(simulator, segments, everything, grid.interval)
    names = [slot.parameter.name for slot in simulator.slots]
    free = [names.index(name) for name in case.truth]
    if case.mjcf is SLIDER:
        estimates = search(problem, free, chosen[0].starts(host, case.target))
    else:
        estimates = fit(problem, simulator.base, segments.start, free).theta[free]
    named = dict(zip(case.truth, map(float, estimates), strict=True))
    assert named == pytest.approx(dict(case.truth), rel=case.rel)


def search(problem: Problem, free: list[int], starts) -> np.ndarray:
    """Fit without derivatives from the measured initial states: contacts are not smooth."""

    def cost(values: np.ndarray) -> float:
        theta = problem.simulator.base.copy()
        theta[free] = values
        predicted = problem.simulator.predict(theta[None], segments.start[None], segments)[0]
        return float(np.mean(((predicted - segments.measured) / segments.spread) ** 2))

    segments, names = problem.segments, [s.parameter.name for s in problem.simulator.slots]
    sizes = np.tile(problem.simulator.base, (len(starts), 1))
    for row, start in zip(sizes, starts, strict=True):
        for name, value in start.items():
            row[names.index(name)] = value
    first = min(sizes[:, free], key=cost)
    return optimize.minimize(cost, first, method="Nelder-Mead", options={"fatol": 1e-9}).x
