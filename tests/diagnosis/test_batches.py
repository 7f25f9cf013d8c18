"""Programs compiled together are the ones that run, and a second look at the same finds them."""

import dataclasses

import jax
import numpy as np

from garat_jax.diagnosis.batches import Batches, Program, compile_together
from garat_jax.diagnosis.diagnose import diagnose
from garat_jax.diagnosis.repeat import repeatability
from garat_jax.diagnosis.segments import Segments, choose_grid, cut
from garat_jax.effects import CATALOGUE
from tests.diagnosis.pendulum import MODEL, add_damping, record

ROWS = 3


def num_compiled(caplog) -> int:
    return sum("Compiling jit" in record.getMessage() for record in caplog.records)


def make(segments: Segments, factor: float) -> Batches:
    """Return a program that takes its starts, and all that it is given, times a factor."""

    def one(theta, start, ctrl, place, past):
        del ctrl, past
        return factor * theta[0] * start[None] + 0.0 * place[:, None], start[None]

    run = jax.jit(jax.vmap(one, (0, 0, 0, 0, None)))
    theta = np.arange(1.0, 1.0 + ROWS)[:, None]
    start = np.broadcast_to(segments.start, (ROWS, *segments.start.shape))
    return Batches(Program(run, False, False), segments, np.empty(0), theta, start, None)


def test_programs_compiled_together_are_not_compiled_again(caplog):
    recording = record(add_damping, 0)
    grid = choose_grid([recording], 0.002)
    segments = cut([recording], grid, 0.2)
    every = [make(segments, factor) for factor in (1.0, 2.0, 3.0)]
    compile_together(every)
    with jax.log_compiles():
        found = [batches.run() for batches in every]
        ahead = num_compiled(caplog)
        make(segments, 4.0).run()
    assert (ahead, num_compiled(caplog)) == (0, 1)
    for factor, (signals, true) in zip((1.0, 2.0, 3.0), found, strict=True):
        assert signals.shape[:2] == true.shape[:2] == (ROWS, len(segments.start))
        for row in range(ROWS):
            np.testing.assert_allclose(signals[row, :, 0], factor * (row + 1) * segments.start)
        np.testing.assert_array_equal(true[0, :, 0], segments.start)


def test_what_each_recording_shows_is_found_with_the_programs_of_the_diagnosis(caplog):
    kinds = ("viscous_damping", "torque_offset")
    model = dataclasses.replace(MODEL, catalogue={kind: CATALOGUE[kind] for kind in kinds})
    recordings = [record(add_damping, seed) for seed in range(3)]
    found = diagnose(model, recordings)
    assert [c.effect for c in found.selected] == ["viscous_damping"]
    with jax.log_compiles():
        seen = repeatability(model, found, recordings).repeatability
        again = num_compiled(caplog)
        anew = repeatability(dataclasses.replace(model), found, recordings).repeatability
    assert again < 3
    assert num_compiled(caplog) > again + 3
    assert [s.estimate for s in anew[0].recordings] == [s.estimate for s in seen[0].recordings]
