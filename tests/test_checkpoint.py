import os
import shutil
import signal
import subprocess
import sys
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import struct

from garat_jax.checkpoint import latest_step, restore, save
from garat_jax.errors import UserError


class Network(NamedTuple):
    kernel: Any
    bias: Any


@struct.dataclass
class State:
    params: Network
    optimizer: Any
    key: Any
    extra: Any
    name: str = struct.field(pytree_node=False, default="agent")


def make_state(seed: int) -> State:
    key = jax.random.key(seed)
    params = Network(jax.random.normal(key, (3, 4)), jax.random.uniform(key, (4,), jnp.bfloat16))
    extra = {
        "keys": jax.random.split(key, 5),
        "other_keys": jax.random.key(seed, impl="rbg"),
        "empty": jnp.zeros((0, 3)),
        "none": None,
        "nothing": (),
        "flags": jnp.array([True, False]),
        "count": jnp.int32(7 + seed),
        "special": jnp.array([jnp.nan, -0.0, jnp.inf, 1e-45]),
        "double": np.array([0.1 + seed], np.float64),
        "python": [seed, 0.1, True],
    }
    return State(params, optax.adam(1e-3).init(params), key, extra)


def assert_identical(left: Any, right: Any) -> None:
    assert jax.tree.structure(left) == jax.tree.structure(right)
    for path, (a, b) in zip(
        jax.tree_util.tree_leaves_with_path(left),
        zip(jax.tree.leaves(left), jax.tree.leaves(right), strict=True),
        strict=True,
    ):
        assert type(a) is type(b), path[0]
        if isinstance(a, jax.Array) and jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            assert a.dtype == b.dtype, path[0]
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        a, b = np.asarray(a), np.asarray(b)
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes()), path[0]


def test_round_trip_is_exact_to_the_bit(tmp_path):
    save(tmp_path / "checkpoints", 5, make_state(0))
    assert_identical(restore(tmp_path / "checkpoints", make_state(1)), make_state(0))


def test_a_restored_key_draws_what_the_saved_one_draws(tmp_path):
    save(tmp_path, 0, {"key": jax.random.key(3)})
    key = restore(tmp_path, {"key": jax.random.key(0)})["key"]
    np.testing.assert_array_equal(
        jax.random.normal(key, (8,)), jax.random.normal(jax.random.key(3), (8,))
    )


def test_the_newest_checkpoints_stay(tmp_path):
    assert latest_step(tmp_path / "absent") is None
    for step in (1, 20, 300):
        save(tmp_path, step, {"x": jnp.float32(step)}, keep=2)
    assert latest_step(tmp_path) == 300
    assert restore(tmp_path, {"x": jnp.float32(0)}, step=20)["x"] == 20
    with pytest.raises(ValueError, match=r"step 1 .*holds: 20, 300"):
        restore(tmp_path, {"x": jnp.float32(0)}, step=1)


def test_an_older_step_is_refused(tmp_path):
    save(tmp_path, 3, {"x": jnp.zeros(2)})
    with pytest.raises(ValueError, match="not after step 3"):
        save(tmp_path, 3, {"x": jnp.ones(2)})
    assert restore(tmp_path, {"x": jnp.ones(2)})["x"].sum() == 0


def test_nothing_to_restore(tmp_path):
    with pytest.raises(ValueError, match="no checkpoint"):
        restore(tmp_path / "absent", {"x": jnp.zeros(2)})
    assert not (tmp_path / "absent").exists()


@pytest.mark.parametrize(
    "other",
    [
        {"x": jnp.zeros(3)},
        {"x": jnp.zeros(2, jnp.int32)},
        {"y": jnp.zeros(2)},
        {"x": jnp.zeros(2), "y": jnp.zeros(2)},
    ],
)
def test_another_structure_is_refused(tmp_path, other):
    save(tmp_path, 0, {"x": jnp.zeros(2)})
    with pytest.raises(ValueError, match="does not fit"):
        restore(tmp_path, other)


@pytest.mark.parametrize("name", ["_METADATA", "manifest.ocdbt", "d", "default"])
def test_a_damaged_checkpoint_is_told_in_one_line(tmp_path, name):
    save(tmp_path, 0, {"x": jnp.arange(2000.0)})
    (found,) = (path for path in tmp_path.rglob(name) if path.parent.name in ("default", "0"))
    if found.is_dir():
        shutil.rmtree(found)
    else:
        found.write_bytes(found.read_bytes()[:10])
    with pytest.raises(UserError, match=r"the checkpoint in .* is damaged") as caught:
        restore(tmp_path, {"x": jnp.zeros(2000)})
    assert "\n" not in str(caught.value)


def test_paths_that_collide_are_refused(tmp_path):
    with pytest.raises(ValueError, match="same path"):
        save(tmp_path, 0, {"a.b": jnp.zeros(1), "a": {"b": jnp.ones(1)}})


_SAVE_FOREVER = """
import sys
import numpy as np
from garat_jax.checkpoint import save
for step in range(10_000):
    save(sys.argv[1], step, {"x": np.full(200_000, step, np.float32)}, keep=2)
    print(step, flush=True)
"""


def test_a_killed_process_leaves_a_checkpoint_intact(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-c", _SAVE_FOREVER, str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    for line in process.stdout:
        if int(line) == 3:
            break
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    step = latest_step(tmp_path)
    assert step is not None and step >= 3
    restored = restore(tmp_path, {"x": np.zeros(200_000, np.float32)})
    np.testing.assert_array_equal(restored["x"], np.full(200_000, step, np.float32))
    save(tmp_path, step + 1, restored)
    assert latest_step(tmp_path) == step + 1


def test_saving_is_silent(tmp_path, capfd):
    save(tmp_path, 0, make_state(0))
    restore(tmp_path, make_state(0))
    assert capfd.readouterr() == ("", "")
