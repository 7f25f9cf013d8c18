"""Programs compiled together are the ones that run, and a second look at the same finds them."""

import dataclasses

import jax
import numpy as np
import pytest

from garat_jax.diagnosis.batches import Batches, Program, compile_together
from garat_jax.diagnosis.diagnose import diagnose_keeping
from garat_jax.diagnosis.repeat import repeatability
from garat_jax.diagnosis.segments import Segments, choose_grid, cut
from garat_jax.effects import CATALOGUE
from tests.diagnosis.pendulum import MODEL, add_damping, record

ROWS = 3


@pytest.fixture
def num_compiled(caplog):
    """How many programs of whole batches were compiled so far, by any thread."""
    was = jax.config.jax_log_compiles
    jax.config.update("jax_log_compiles", True)  # the context manager holds for one thread
    yield lambda: sum(
        "Compiling jit" in record.getMessage()
        and any(size in record.getMessage() for size in ("[32,", "[256,"))
        for record in caplog.records
    )
    jax.config.update("jax_log_compiles", was)


def make(segments: Segments, factor: float) -> Batches:
    """Return a program that takes its starts, and all that it is given, times a factor."""

    def one(theta, start, ctrl, place, past):
        del ctrl, past
        return factor * theta[0] * start[None] + 0.0 * place[:, None], start[None]

    run = jax.jit(jax.vmap(one, (0, 0, 0, 0, None)))
    theta = np.arange(1.0, 1.0 + ROWS)[:, None]
    start = np.broadcast_to(segments.start, (ROWS, *segments.start.shape))
    return Batches(Program(run, False, 0), segments, np.empty(0), theta, start, None)


def test_programs_compiled_together_are_not_compiled_again(num_compiled):
    recording = record(add_damping, 0)
    grid = choose_grid([recording], 0.002)
    segments = cut([recording], grid, 0.2)
    every = [make(segments, factor) for factor in (1.0, 2.0, 3.0)]
    compile_together(every)
    compiled = [num_compiled()]
    found = [batches.run() for batches in every]
    compiled.append(num_compiled())
    make(segments, 4.0).run()
    compiled.append(num_compiled())
    assert compiled == [3, 3, 4]
    for factor, (signals, true) in zip((1.0, 2.0, 3.0), found, strict=True):
        assert signals.shape[:2] == true.shape[:2] == (ROWS, len(segments.start))
        for row in range(ROWS):
            np.testing.assert_allclose(signals[row, :, 0], factor * (row + 1) * segments.start)
        np.testing.assert_array_equal(true[0, :, 0], segments.start)


@pytest.mark.parametrize(
    ("rows", "num_substeps", "size"),
    [(1, 100, 32), (2, 100, 256), (1, 99, 256), (30, 99, 1024), (30, 100, 256), (30, 0, 256)],
)
def test_a_batch_is_as_large_as_pays(rows, num_substeps, size):
    """32 segments of 40 control steps: of 100 substeps they are long, of 99 not."""
    segments = cut([record(add_damping, 0)], choose_grid([record(add_damping, 0)], 0.002), 0.2)
    every, number = np.arange(32) % len(segments.start), 40
    segments = dataclasses.replace(segments, ctrl=segments.ctrl[:, :number]).take(every)
    batches, sizes = make(segments, 2.0), []

    def run(*inputs):
        sizes.append(len(inputs[0]))
        return batches.program.run(*inputs)

    start = np.broadcast_to(segments.start, (rows, *segments.start.shape))
    program = Program(run, False, num_substeps)
    signals, _ = batches._replace(program=program, theta=np.ones((rows, 1)), start=start).run()
    assert {*sizes} == {size}
    np.testing.assert_allclose(signals[-1, :, 0], 2.0 * segments.start)


def test_an_error_in_one_of_them_is_raised():
    recording = record(add_damping, 0)
    segments = cut([recording], choose_grid([recording], 0.002), 0.2)

    def broken(theta, start, ctrl, place, past):
        raise ZeroDivisionError

    run = jax.jit(jax.vmap(broken, (0, 0, 0, 0, None)))
    every = [make(segments, 1.0)._replace(program=Program(run, False, 0)), make(segments, 2.0)]
    with pytest.raises(ZeroDivisionError):
        compile_together(every)
    compile_together([])


def test_what_each_recording_shows_is_found_with_the_programs_of_the_diagnosis(num_compiled):
    kinds = ("viscous_damping", "torque_offset")
    model = dataclasses.replace(MODEL, catalogue={kind: CATALOGUE[kind] for kind in kinds})
    recordings = [record(add_damping, seed) for seed in range(3)]
    found, simulator = diagnose_keeping(model, recordings, (), lambda message: None)
    assert [c.effect for c in found.selected] == ["viscous_damping"]
    compiled = [num_compiled()]
    seen = repeatability(model, found, recordings, simulator=simulator).repeatability
    compiled.append(num_compiled())
    anew = repeatability(model, found, recordings).repeatability
    compiled.append(num_compiled())
    kept, all_anew = np.diff(compiled)
    assert kept <= 1
    assert all_anew >= 5
    assert [s.estimate for s in anew[0].recordings] == [s.estimate for s in seen[0].recordings]
