"""Work split over devices gives what one device gives; processes with four CPU devices each."""

import os
import socket
import subprocess
import sys

import pytest

from garat_jax import split

PROGRAM = """
import os, sys
import jax, jax.numpy as jnp, numpy as np
from garat_jax import devices, rollout, split
from garat_jax.agents import ppo
from garat_jax.env import make_world
from garat_jax.envs.inverted_pendulum import InvertedPendulum
from garat_jax.runs import RunDirectory
from garat_jax.train import Trainer

if "JAX_PROCESS_ID" in os.environ:
    devices.join_processes(None, None, None)
folder, engine, num_seeds = sys.argv[1], sys.argv[2], int(sys.argv[3])
world = make_world(InvertedPendulum(), engine=engine)
agent = ppo.make(world.env, ppo.PPOConfig(num_envs=8, num_steps=20, hidden=(8,)))
keys = jax.vmap(jax.random.key)(jnp.arange(num_seeds))

def evaluate(policy, key, wanted):
    return rollout.evaluate(world.env, world.params, agent.policy, policy, key, 6, wanted).returns

def train(name, mesh):
    run = RunDirectory.create(f"{folder}/{name}", {}, "test", range(num_seeds))
    trainer = Trainer(run, range(num_seeds), mesh=mesh)
    init = split.over_seeds(lambda key: agent.init(key, world.params), (0,), mesh)
    start = trainer.call(init, keys)
    step = split.over_seeds(lambda s, p: agent.step(s, p)[:2], (0, None), mesh)
    state = trainer.train("stage", step, start, world.params, 3)
    evaluated = split.over_seeds(evaluate, (0, 0, 0), mesh)
    wanted = jnp.arange(num_seeds) % 2 == 0
    returns = [trainer.call(evaluated, state.policy, keys, w) for w in (wanted, ~wanted)]
    return state._replace(key=jax.random.key_data(state.key)), returns

mesh = split.make_mesh(num_seeds, 8)
print(dict(mesh.shape))
pairs = zip(*map(jax.tree.leaves, (train("whole", None), train("split", mesh))), strict=True)
pairs = [(np.asarray(a, float), np.asarray(b, float)) for a, b in pairs if a.size]
gaps = [(np.abs(a - b) / np.maximum(1.0, np.abs(a))).max() for a, b in pairs]
print(max(gaps))
"""


def start(tmp_path, engine: str, num_seeds: int, **environment: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", PROGRAM, str(tmp_path), engine, str(num_seeds)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, **environment},
    )


def finish(process: subprocess.Popen[str]) -> list[str]:
    told, complaint = process.communicate(timeout=300)
    assert process.returncode == 0, complaint
    return [line for line in told.splitlines() if not line.startswith("[Gloo]")]


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("localhost", 0))
        return one.getsockname()[1]


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["mujoco", "mjx"])
@pytest.mark.parametrize(
    ("num_seeds", "shape"), [(2, "{'seeds': 2, 'envs': 2}"), (1, "{'seeds': 1, 'envs': 4}")]
)
def test_four_devices_give_what_one_gives(tmp_path, engine, num_seeds, shape):
    flag = "--xla_force_host_platform_device_count=4"
    found, difference = finish(start(tmp_path, engine, num_seeds, XLA_FLAGS=flag))
    assert found == shape
    assert float(difference) < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("num_seeds", [1, 2])
def test_two_processes_give_what_one_gives(tmp_path, num_seeds):
    address = f"localhost:{free_port()}"
    processes = [
        start(
            tmp_path / str(number),
            "mujoco",
            num_seeds,
            JAX_COORDINATOR_ADDRESS=address,
            JAX_NUM_PROCESSES="2",
            JAX_PROCESS_ID=str(number),
        )
        for number in range(2)
    ]
    for process in processes:
        found, difference = finish(process)
        assert found == str({"seeds": num_seeds, "envs": 2 // num_seeds})
        assert float(difference) < 1e-4


def test_one_device_needs_no_mesh():
    assert split.make_mesh(5, 50) is None or len(split.jax.devices()) > 1


@pytest.mark.parametrize(
    ("num_devices", "seeds", "envs", "shape"),
    [(4, 4, 50, (4, 1)), (4, 2, 50, (2, 2)), (4, 5, 50, (1, 2)), (8, 5, 50, (5, 1)), (2, 3, 7, ())],
)
def test_as_many_devices_as_divide_the_work(num_devices, seeds, envs, shape, monkeypatch):
    device = split.jax.devices()[0]
    monkeypatch.setattr(split.jax, "devices", lambda: [device] * num_devices)
    monkeypatch.setattr(split, "Mesh", lambda devices, axes: devices)
    mesh = split.make_mesh(seeds, envs)
    assert (() if mesh is None else mesh.shape) == shape
