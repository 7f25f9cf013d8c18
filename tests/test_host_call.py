"""Python functions in compiled programs: called by name, kept by the compilation cache."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import monitoring

from garat_jax import dynamics, host_call
from tests.models import PENDULUM, spec


def add(inputs):
    return inputs[0] + inputs[1]


def call(name, function, size, *inputs):
    return host_call.call(name, function, size, inputs)


def test_a_batch_is_one_call_and_what_is_not_batched_has_axes_of_length_1():
    seen = []

    def function(inputs):
        seen.append([x.shape for x in inputs])
        return add(inputs)

    row, table = jnp.arange(3, dtype=jnp.uint32), jnp.ones((5, 3), jnp.uint32)
    found = jax.jit(jax.vmap(lambda x: call("batch", function, 3, x, row)))(table)
    np.testing.assert_array_equal(found, np.arange(3) + np.ones((5, 3)))
    assert seen == [[(5, 3), (1, 3)]]


def test_arrays_without_elements_pass():
    nothing = jnp.zeros(0, jnp.uint32)
    found = jax.jit(lambda x: call("nothing", add, 0, x, x))(nothing)
    assert found.shape == (0,)


def test_an_error_in_the_function_is_an_error_of_the_program():
    def fail(inputs):
        raise ValueError("no such pear")

    program = jax.jit(lambda x: call("fail", fail, 1, x))
    with pytest.raises(jax.errors.JaxRuntimeError, match="no such pear"):
        jax.block_until_ready(program(jnp.ones(1, jnp.uint32)))


@pytest.mark.parametrize("platform", ["cpu", "gpu"])
def test_both_ways_give_the_same(platform, monkeypatch):
    if platform != "cpu":
        monkeypatch.setattr(jax, "default_backend", lambda: platform)
    x = jnp.arange(4, dtype=jnp.uint32)
    program = jax.jit(lambda x: call(f"on {platform}", add, 4, x, x))
    assert ("callback" in program.lower(x).as_text()) == (platform != "cpu")
    np.testing.assert_array_equal(program(x), 2 * np.arange(4))


LEFT_UNDER_WAY = """
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import Mesh, PartitionSpec as P
from garat_jax import host_call

def run(x):
    def step(x, _):
        return jax.vmap(lambda row: host_call.call("add", sum, 3, [row, row]))(x), None
    return jax.lax.scan(step, x, length=2000)[0]

mesh = Mesh(np.asarray(jax.devices()), ("devices",))
split = P("devices")
program = jax.shard_map(run, mesh=mesh, in_specs=split, out_specs=split, check_vma=False)
result = jax.jit(program)(jnp.ones((8, 3), jnp.uint32))
print(len(jax.devices()), result.is_ready())
"""


def test_a_process_may_end_while_its_programs_are_under_way():
    flag = "--xla_force_host_platform_device_count=4"
    process = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", LEFT_UNDER_WAY],
        capture_output=True,
        text=True,
        env={**os.environ, "XLA_FLAGS": flag},
        timeout=120,
    )
    assert process.returncode == 0, process.stderr
    assert process.stdout.split() == ["4", "False"]


def step_program():
    """Return a fresh program that steps C MuJoCo, as a new process would make it."""
    world = dynamics.compile(spec(PENDULUM), engine="mujoco")
    start = dynamics.initial_state(world, jnp.zeros(1), jnp.zeros(1))
    return jax.jit(lambda ctrl: dynamics.step(world, start, ctrl, 4).qvel).lower(jnp.ones(1))


def test_programs_that_step_c_mujoco_come_from_the_cache(tmp_path):
    events = []
    monitoring.register_event_listener(lambda event, **_: events.append(event.split("/")[-1]))
    changed = {
        "jax_compilation_cache_dir": str(tmp_path),
        "jax_persistent_cache_min_compile_time_secs": 0.0,
    }
    before = {name: getattr(jax.config, name) for name in changed}
    lowered, ctrl = [step_program(), step_program()], jnp.ones(1)
    jax.experimental.compilation_cache.compilation_cache.reset_cache()
    try:
        jax.tree.map(jax.config.update, list(changed), list(changed.values()))
        events.clear()  # of what was compiled on the way
        expected = lowered[0].compile()(ctrl)
        assert "cache_hits" not in events
        found = lowered[1].compile()(ctrl)
    finally:
        jax.tree.map(jax.config.update, list(before), list(before.values()))
        jax.experimental.compilation_cache.compilation_cache.reset_cache()
        monitoring.clear_event_listeners()
    assert "cache_hits" in events
    np.testing.assert_array_equal(found, expected)
    assert expected[0] > 0
