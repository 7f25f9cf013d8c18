"""A stage goes on from what its folder holds, whatever was lost or came too late to be written."""

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from garat_jax import checkpoint, train
from garat_jax.runs import RunDirectory
from garat_jax.train import Trainer, UntilSolved


def directory(path, cls=RunDirectory, resume=False):
    return cls.create(path, {"what": "test"}, "garat test", [0, 1], resume=resume)


def walked(run: RunDirectory) -> jax.Array:
    """Return where a walk ends whose walkers have arrived after three and five iterations."""

    def step(position, params):
        return position + params, {"height": position + params}

    def evaluate(position, params, key, wanted):
        del params, key
        return jnp.where(wanted, position, 0.0), 0.0

    step = jax.vmap(train.until_solved(step, evaluate, 5.0), (0, None))
    keys = jax.random.split(jax.random.key(0), 2)
    start = jax.vmap(UntilSolved.start)(jnp.asarray([0.0, 2.0]), keys)
    end = Trainer(run, [0, 1], console=Console(quiet=True)).train("walk", step, start, 1.0, 9)
    return jnp.stack([*jax.random.key_data(end.key).T, end.state, end.score])


@pytest.fixture
def whole(tmp_path, monkeypatch):
    """A walk's end, and the folders that SIGKILL would leave after each thing that is written."""
    monkeypatch.setattr(train, "CHECKPOINT_SECONDS", 0.0)
    folder, killed = tmp_path / "run", []

    def copied(write):
        def written(*arguments):
            write(*arguments)
            killed.append(shutil.copytree(folder, tmp_path / f"killed-{len(killed)}"))

        return written

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "save", copied(checkpoint.save))
        patch.setattr(RunDirectory, "write_json", copied(RunDirectory.write_json))
        end = walked(directory(folder))
    return folder, end, killed


def assert_gets_there(folder, whole):
    """Check that a run that goes on in a folder ends where one does that nothing stopped."""
    np.testing.assert_array_equal(walked(directory(folder, resume=True)), whole[1])
    assert (folder / "metrics.jsonl").read_text() == (whole[0] / "metrics.jsonl").read_text()
    assert checkpoint.latest_step(folder / "checkpoints" / "walk") == 5


def test_killed_after_anything_that_is_written_a_stage_ends_where_it_would_have(whole):
    assert len(whole[2]) > 5
    for folder in whole[2]:
        assert_gets_there(folder, whole)


@pytest.mark.parametrize("lost", ["5", "[45]", "*"])
def test_a_stage_that_is_over_and_has_lost_its_end_gets_there_again(whole, tmp_path, lost):
    folder = shutil.copytree(whole[0], tmp_path / "damaged")
    steps = list((folder / "checkpoints" / "walk").glob(lost))
    assert steps
    for step in steps:
        shutil.rmtree(step)
    assert_gets_there(folder, whole)
