"""Measure what XLA's CPU fusion emitters do to MJX, on a deep and on a shallow chain.

`python benchmarks/xla_flags.py`: every model is compiled with the emitters on (XLA's default) and
off, and the two programs run in turns. C MuJoCo on the same model stands beside them.
"""

import dataclasses
import os
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import tyro
from record import write_result

from garat_jax import dynamics
from garat_jax.compiler_options import FUSION_EMITTERS, chain_depth
from garat_jax.dynamics import Dynamics
from garat_jax.envs.inverted_pendulum import InvertedPendulum
from garat_jax.errors import UserError
from garat_jax.overrides import load_spec

ARM = """
<mujoco model="arm of six joints">
  <option timestep="0.002" iterations="4" ls_iterations="8"/>
  <default><joint damping="1" armature="0.1"/><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body><joint name="j1" axis="0 0 1"/><geom type="capsule" size=".06" fromto="0 0 0 0 0 .2"/>
      <body pos="0 0 .2"><joint name="j2" axis="0 1 0"/>
        <geom type="capsule" size=".05" fromto="0 0 0 .4 0 0"/>
        <body pos=".4 0 0"><joint name="j3" axis="0 1 0"/>
          <geom type="capsule" size=".04" fromto="0 0 0 .4 0 0"/>
          <body pos=".4 0 0"><joint name="j4" axis="0 1 0"/>
            <geom type="capsule" size=".03" fromto="0 0 0 0 .1 0"/>
            <body pos="0 .1 0"><joint name="j5" axis="0 0 1"/>
              <geom type="capsule" size=".03" fromto="0 0 0 0 0 -.1"/>
              <body pos="0 0 -.1"><joint name="j6" axis="0 1 0"/>
                <geom type="capsule" size=".03" fromto="0 0 0 0 .1 0"/>
              </body></body></body></body></body></body>
  </worldbody>
  <actuator>
    <motor joint="j1"/><motor joint="j2"/><motor joint="j3"/>
    <motor joint="j4"/><motor joint="j5"/><motor joint="j6"/>
  </actuator>
</mujoco>
"""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measure what XLA's CPU fusion emitters do to MJX."""

    repetitions: int = 5
    """Timed runs of each program; the median counts."""
    batch: int = 64
    """Simulations side by side."""


class Program(NamedTuple):
    """A compiled program and what to report of it."""

    row: dict[str, Any]
    call: Callable[[], Any]
    steps: int


def make_program(
    model: str, world: Dynamics, batch: int, length: int, options: dict[str, bool]
) -> Program:
    """Compile a scan of random commands over a batch of simulations, with time to compile."""
    host = world.host.model
    qpos = jnp.tile(jnp.asarray(host.qpos0, jnp.float32), (batch, 1))
    state = jax.vmap(dynamics.initial_state, (None, 0, 0))(world, qpos, jnp.zeros((batch, host.nv)))
    ctrl = jax.random.uniform(jax.random.key(0), (length, batch, host.nu), minval=-1.0)

    def run(state, ctrl):
        def step(state, ctrl):
            return jax.vmap(dynamics.step, (None, 0, 0))(world, state, ctrl), None

        return jax.lax.scan(step, state, ctrl)[0].qpos

    started, busy = time.perf_counter(), time.process_time()
    compiled = jax.jit(run, compiler_options=options).lower(state, ctrl).compile()
    seconds, busy = time.perf_counter() - started, time.process_time() - busy
    jax.block_until_ready(compiled(state, ctrl))
    row = {
        "model": model,
        "engine": world.engine,
        "degrees_of_freedom_in_a_row": chain_depth(world),
        "fusion_emitters": options.get(FUSION_EMITTERS),
        "batch": batch,
        "compile_seconds": seconds,
        "compile_processor_seconds": busy,
    }
    return Program(row, lambda: jax.block_until_ready(compiled(state, ctrl)), batch * length)


def seconds_of(call: Callable[[], Any]) -> float:
    started = time.perf_counter()
    call()
    return time.perf_counter() - started


def measure(programs: list[Program], repetitions: int) -> list[dict[str, Any]]:
    """Run the programs in turns and return their rows with the median rate."""
    times = [[seconds_of(p.call) for p in programs] for _ in range(repetitions)]
    medians = np.median(times, axis=0)
    return [
        program.row | {"steps_per_second": program.steps / median}
        for program, median in zip(programs, medians, strict=True)
    ]


def programs_of(name: str, spec: mujoco.MjSpec, batch: int, slow: int) -> list[Program]:
    """Return the three programs of a model; `slow` steps for the emitters, which may be slow."""
    mjx = dynamics.compile(spec, engine="mjx")
    native = dynamics.compile(spec, engine="mujoco")
    return [
        make_program(name, mjx, batch, slow, {FUSION_EMITTERS: True}),
        make_program(name, mjx, batch, 500, {FUSION_EMITTERS: False}),
        make_program(name, native, batch, 500, {}),
    ]


def main() -> None:
    arguments = tyro.cli(Arguments)
    if FUSION_EMITTERS in os.environ.get("XLA_FLAGS", "") or jax.default_backend() != "cpu":
        raise UserError(f"needs a CPU backend, and an XLA_FLAGS without {FUSION_EMITTERS}")
    pendulum = load_spec(InvertedPendulum.mjcf)
    programs = [
        *programs_of("arm", mujoco.MjSpec.from_string(ARM), arguments.batch, slow=5),
        *programs_of("inverted_pendulum", pendulum, arguments.batch, slow=500),
    ]
    busy = os.getloadavg()[0]
    rows = [row | {"load_average_before": busy} for row in measure(programs, arguments.repetitions)]
    for row in rows:
        print(
            f"{row['model']:18} {row['engine']:7} emitters {row['fusion_emitters']!s:6}"
            f"{row['steps_per_second']:12,.0f} steps/s, compiled in "
            f"{row['compile_processor_seconds']:.1f} processor seconds"
        )
    command = (
        f"python benchmarks/xla_flags.py --repetitions {arguments.repetitions} "
        f"--batch {arguments.batch}"
    )
    print(write_result("xla_flags", rows, seeds=[0], command=command))


if __name__ == "__main__":
    main()
