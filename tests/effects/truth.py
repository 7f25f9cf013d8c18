"""What effects do, written a second time: loops around C MuJoCo at a fine timestep.

A law here changes the spec, the command, or the force on the first joint; none of it calls the
laws under test.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from scipy import optimize

from garat_jax import dynamics
from garat_jax.effects import Effect
from tests.models import spec

RIG = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody><body name="pole" pos="0 0 1">
    <joint name="hinge" axis="0 1 0" damping="0.01" armature="0.01"/>
    <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.6"
          contype="0" conaffinity="0"/>
  </body></worldbody>
  <actuator><motor name="motor" joint="hinge" gear="2" ctrlrange="-3 3"/></actuator>
</mujoco>
"""
SERVO = RIG.replace(
    '<motor name="motor" joint="hinge" gear="2" ctrlrange="-3 3"/>',
    '<position name="motor" joint="hinge" kp="20" kv="1" ctrlrange="-3 3"/>',
)
FINER = 32
SAMPLES = 250
SUBSTEPS = 2


class Truth(NamedTuple):
    """How an effect enters the loop.

    Attributes:
        change: Changes the spec.
        force: Torque [N m] on the joint at (angle, speed, command).
        friction: Size [N m] of the joint's friction loss at a speed.
        command: Command at (time, commands so far as a function of time).
    """

    change: Callable[[mujoco.MjSpec], None] = lambda spec: None
    force: Callable[[float, float, float], float] = lambda q, v, u: 0.0
    friction: Callable[[float], float] = lambda v: 0.0
    command: Callable[[float, Callable[[float], float]], float] = lambda t, u: u(t)


def excitation(t, size: float = 1.0):
    """Return the command at a time [s]: a multi-sine with steps, held for 4 ms by the callers."""
    steps = np.sign(np.sin(2.1 * t)) * 0.4
    return size * (0.5 * np.sin(5.0 * t) + 0.4 * np.sin(11.0 * t + 1.0) + steps)


def commands(size: float = 1.0) -> np.ndarray:
    """Return the commands, [SAMPLES]."""
    return excitation(np.arange(SAMPLES) * SUBSTEPS * 0.002, size)


def record(mjcf: str, truth: Truth, ctrl: np.ndarray, start=(0.4, 0.0)) -> np.ndarray:
    """Step C MuJoCo at a fine timestep and return angle and speed after each sample, [T, 2]."""
    changed = spec(mjcf)
    truth.change(changed)
    interval = SUBSTEPS * changed.option.timestep
    changed.option.timestep /= FINER
    model = changed.compile()
    frictionloss = model.dof_frictionloss[0]
    data = mujoco.MjData(model)
    data.qpos[0], data.qvel[0] = start
    states = []

    def held(t: float) -> float:
        return float(ctrl[max(0, min(int(t / interval + 1e-9), len(ctrl) - 1))])

    for _ in range(len(ctrl)):
        for _ in range(SUBSTEPS * FINER):
            u = truth.command(data.time, held)
            data.ctrl[0] = u
            data.qfrc_applied[0] = truth.force(data.qpos[0], data.qvel[0], u)
            model.dof_frictionloss[0] = frictionloss + truth.friction(data.qvel[0])
            mujoco.mj_step(model, data)
        states.append([data.qpos.sum(), data.qvel.sum()])
    return np.asarray(states)


def predict(
    mjcf: str, effects: tuple[Effect, ...], ctrl: np.ndarray, start=(0.4, 0.0), engine="mujoco"
) -> np.ndarray:
    """Step our dynamics at the model's own timestep and return the same, [T, 2]."""
    world = dynamics.compile(spec(mjcf), effects=effects, engine=engine)
    return np.asarray(_rollout(world, jnp.asarray(ctrl), jnp.asarray(start)))


@jax.jit
def _rollout(world, ctrl, start):
    state = dynamics.initial_state(world, start[:1], start[1:])

    def advance(state, command):
        state = dynamics.step(world, state, command[None], SUBSTEPS)
        return state, jnp.stack([state.qpos[0], state.qvel[0]])

    return jax.lax.scan(advance, state, ctrl)[1]


def recover(
    mjcf: str, effect: Effect, start: dict[str, float], runs: list[tuple[np.ndarray, np.ndarray]]
) -> dict[str, float]:
    """Fit an effect's parameters to runs of (command, angle and speed) by least squares."""
    world = dynamics.compile(spec(mjcf), effects=(effect,), engine="mujoco")
    names = list(start)
    first = np.asarray([start[name] for name in names])
    listed = {p.name: p for p in effect.parameters()}
    unit = np.maximum(np.abs(first), [listed[name].scale for name in names])

    def residual(x):
        values = dict(zip(names, jnp.asarray(x * unit), strict=True))
        changed = world.replace(effects=(world.effects[0].replace(**values),))
        errors = [
            np.asarray(_rollout(changed, jnp.asarray(ctrl), jnp.asarray([0.4, 0.0]))) - measured
            for ctrl, measured in runs
        ]
        return (np.concatenate(errors) / [0.1, 1.0]).ravel()

    bounds = np.asarray([(listed[n].low, listed[n].high) for n in names]).T / unit
    found = optimize.least_squares(residual, first / unit, bounds=bounds, diff_step=1e-3)
    return dict(zip(names, found.x * unit, strict=True))
