"""What this machine offers, a short measurement, and what follows from both."""

import dataclasses
import itertools
import os
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from rich.console import Console

from garat_jax import compilation_cache, dynamics, provenance
from garat_jax.compiler_options import (
    DEEP_CHAIN,
    FUSION_EMITTERS,
    compiler_options,
    options_for,
)
from garat_jax.devices import num_cores, use
from garat_jax.dynamics import Dynamics, PhysicsState
from garat_jax.overrides import load_spec

PENDULUM = Path(__file__).parent / "envs" / "assets" / "pendulum.xml"
SECONDS = 5.0
"""Of all measurements together."""
BATCH, MANY = 64, 4096
"""Simulations side by side: some, and as many as an accelerator needs to pay."""
NUM_STEPS, NUM_SUBSTEPS = 50, 4
"""Control steps in one call of a program, and physics steps in each: as many as in most tasks. A
call of C MuJoCo, which is what it costs beside physics, is one a control step."""
ENGINES = ("mujoco", "mjx")
HOST_DEVICES = "xla_force_host_platform_device_count"
"""XLA's flag that makes several devices of one CPU."""


@dataclasses.dataclass(frozen=True)
class Rate:
    """Physics steps a second of the pendulum, of all simulations together."""

    engine: str
    batch: int
    steps_per_second: float


@dataclasses.dataclass(frozen=True)
class Examination:
    """What was found.

    Attributes:
        facts: What it is and what it was found to be.
        rates: The measurement: each engine, one simulation and a batch; on accelerators MJX
            with `MANY`, too.
        advice: What follows, one sentence each.
    """

    facts: list[tuple[str, str]]
    rates: list[Rate]
    advice: list[str]


def examine(device: str, seconds: float = SECONDS) -> Examination:
    """Look at the machine and measure both engines.

    Args:
        device: As for `devices.use`.
        seconds: Of all measurements together.

    Raises:
        UserError: There is no such device.
    """
    devices = use(device)
    platform = devices[0].platform
    more = [] if platform == "cpu" else [("mjx", MANY)]
    sizes = [*itertools.product(ENGINES, (1, BATCH)), *more]
    with Console(stderr=True).status("compiling and measuring"):
        worlds = {name: dynamics.compile(load_spec(PENDULUM), engine=name) for name in ENGINES}
        prepared = {}
        with ThreadPoolExecutor() as pool:
            for engine, batch in reversed(sizes):  # MJX compiles longest: let it begin first
                world = worlds[engine]
                lowered, start = prepare(world, batch)
                options = compiler_options(world)
                prepared[engine, batch] = pool.submit(lowered.compile, options), start
        rates = []
        for engine, batch in sizes:
            program, start = prepared[engine, batch]
            rate = measure(program.result(), start, batch, seconds / len(sizes))
            rates.append(Rate(engine, batch, rate))
    return Examination(facts(devices), rates, advise(rates, platform))


def facts(devices: list[Any]) -> list[tuple[str, str]]:
    """Return what the machine, the versions, the devices and the settings are."""
    machine, versions = provenance.machine(), provenance.versions()
    kinds = [device.device_kind for device in devices]
    names = ", ".join(f"{kinds.count(kind)} x {kind}" for kind in dict.fromkeys(kinds))
    platform = devices[0].platform
    auto = "C MuJoCo (mujoco)" if platform == "cpu" else "MJX (mjx)"
    folder = compilation_cache.folder()
    return [
        ("machine", f"{machine['system']}, {machine['cores']} cores, {machine['memory_gib']} GiB"),
        ("processor", str(machine["cpu"])),
        ("devices", f"{platform}: {names}"),
        ("engines", f"mujoco, mjx; auto takes {auto}"),
        ("versions", ", ".join(f"{name} {version}" for name, version in versions.items())),
        ("XLA_FLAGS", os.environ.get("XLA_FLAGS") or "not set"),
        ("XLA options around C MuJoCo", _listed(options_for("mujoco", 0))),
        ("XLA options for MJX", _listed(options_for("mjx", 0))),
        ("XLA options for MJX, deep chains", _listed(options_for("mjx", DEEP_CHAIN))),
        ("compiled programs", _held(folder) if folder else "not kept"),
    ]


def _listed(options: dict[str, Any]) -> str:
    return ", ".join(f"{name}={str(value).lower()}" for name, value in options.items()) or "none"


def _held(folder: Path) -> str:
    sizes = [path.stat().st_size for path in folder.glob("*-cache")]
    return f"{len(sizes)} in {folder}, {sum(sizes) / 2**20:.0f} MiB"


def prepare(world: Dynamics, batch: int) -> tuple[jax.stages.Lowered, PhysicsState]:
    """Return a program, not compiled yet, that swings a batch of pendulums, and its start."""

    def begin(angle: jax.Array) -> PhysicsState:
        return dynamics.initial_state(world, angle[None], jnp.zeros(1))

    def run(state: PhysicsState) -> PhysicsState:
        def control_step(state: PhysicsState) -> PhysicsState:
            return dynamics.step(world, state, jnp.zeros(1), NUM_SUBSTEPS)

        def step(state: PhysicsState, _):
            return jax.vmap(control_step)(state), None

        return jax.lax.scan(step, state, length=NUM_STEPS)[0]

    start = jax.vmap(begin)(jnp.linspace(0.1, 1.0, batch))
    return jax.jit(run).lower(start), start


def measure(program: jax.stages.Compiled, state: PhysicsState, batch: int, seconds: float) -> float:
    """Return the physics steps a second of a compiled program and its batch."""
    state, rounds = jax.block_until_ready(program(state)), 0
    started = time.perf_counter()
    while time.perf_counter() - started < seconds:
        state, rounds = jax.block_until_ready(program(state)), rounds + 1
    return rounds * NUM_STEPS * NUM_SUBSTEPS * batch / (time.perf_counter() - started)


def advise(rates: list[Rate], platform: str) -> list[str]:
    """Return what follows from the rates and from what is set."""
    rate = {(r.engine, r.batch): r.steps_per_second for r in rates}
    auto = "mujoco" if platform == "cpu" else "mjx"
    best = max(ENGINES, key=lambda engine: rate[engine, BATCH])
    other = next(engine for engine in ENGINES if engine != best)
    factor = rate[best, BATCH] / rate[other, BATCH]
    advice = []
    if best == auto:
        advice.append(f"Leave --engine at auto: {best} is {factor:.1f} times as fast here.")
    else:
        why = ", as it compiles far faster and gains where bodies touch" if best == "mjx" else ""
        advice.append(
            f"On this pendulum {best} is {factor:.1f} times as fast as {auto}, which auto takes"
            f"{why}; time yours with --engine {best} as well."
        )
    gain = rate[best, BATCH] / rate[best, 1]
    advice.append(
        f"{BATCH} simulations at once do {gain:.0f} times the steps of one: "
        "run seeds together (--seeds) and give a fit several recordings."
    )
    if (auto, MANY) in rate:
        gain = rate[auto, MANY] / rate[auto, BATCH]
        advice.append(
            f"{MANY} at once do {gain:.1f} times the steps of {BATCH}: the device pays "
            "with many environments; with few, time --device cpu as well."
        )
    cores = num_cores()
    if platform == "cpu" and cores > 1 and HOST_DEVICES not in os.environ.get("XLA_FLAGS", ""):
        advice.append(
            "C MuJoCo steps on all cores by itself; for --engine mjx try "
            f"XLA_FLAGS=--{HOST_DEVICES}={cores}, over which garat transfer splits its work."
        )
    if platform == "cpu" and shutil.which("nvidia-smi"):
        advice.append("JAX does not use the NVIDIA GPU: pip install 'garat_jax[cuda]'.")
    if compilation_cache.folder() is None:
        advice.append(
            "Compiled programs are not kept, so every start compiles: unset "
            f"{compilation_cache.SWITCH}, or name a folder in {compilation_cache.FOLDER}."
        )
    if FUSION_EMITTERS in os.environ.get("XLA_FLAGS", ""):
        advice.append(
            f"XLA_FLAGS sets {FUSION_EMITTERS} for every model; without it, it is off for deep "
            "chains alone, where it makes MJX slow."
        )
    return advice
