"""Run a program for many parameters and segments, in batches of a size that is compiled once."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import numpy as np

from garat_jax import devices
from garat_jax.diagnosis.past import Past
from garat_jax.diagnosis.segments import Segments

SIZES = (256, 1024)
"""Simulations in a batch. Whole segments in one call need no more than the first; where a call is a
substep, many simulations share its cost. Each size is compiled once."""
SMALL = 32
"""Simulations in a batch where no more are needed and segments are `LONG`, as a fit at a finer
timestep to a few of them. Of a batch of 256 the rows that are not used cost a fifth."""
LONG = 4000
"""Substeps of a segment, most of them calls, from which a program is compiled for `SMALL` and the
first of `SIZES` instead."""


class Program(NamedTuple):
    """A compiled program.

    Attributes:
        run: Takes a batch of (theta, start, ctrl, place), the `Past` if it looks back, else None,
            and a path if it looks along one.
        looks_back: Whether an effect remembers, or has a memory of the motion.
        num_substeps: Physics substeps of a control step, where each may be a call of C MuJoCo; 0
            where a whole segment is one.
    """

    run: jax.stages.Wrapped
    looks_back: bool
    num_substeps: int


class Batches(NamedTuple):
    """A program and what it is to be run for; rows and segments together are cut into batches.

    Attributes:
        program: The program.
        segments: Commands and sample times, of S segments.
        activations: Those of the motors, as `activation.Follower` has them.
        theta: Parameters, [P, num_parameters] or, each segment its own, [P, S, ..].
        start: Initial states, [P, S, nq + nv].
        path: What effects look along, [S, ..]; None for programs that look along none.
    """

    program: Program
    segments: Segments
    activations: np.ndarray
    theta: np.ndarray
    start: np.ndarray
    path: np.ndarray | None

    def run(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the signals and the paths, each [P, S, ..]."""
        found, paths = [], []
        for first in range(0, self._total, self._size):
            with jax.enable_x64(True):
                signals, true = self.program.run(*self._inputs(first))
                found.append(np.asarray(signals)[..., : self.segments.measured.shape[2]])
                paths.append(np.asarray(true))
        shape = self.start.shape[:2]
        signals, true = (
            np.concatenate(parts)[: self._total].reshape(*shape, *parts[0].shape[1:])
            for parts in (found, paths)
        )
        return signals, true

    def lower(self) -> jax.stages.Lowered:
        """Return the program as it is to be compiled; `run` finds it once that was done."""
        with jax.enable_x64(True):
            return self.program.run.lower(*self._inputs(0))

    @property
    def _total(self) -> int:
        return self.start.shape[0] * self.start.shape[1]

    @property
    def _size(self) -> int:
        num_substeps = self.program.num_substeps * self.segments.ctrl.shape[1]
        if num_substeps >= LONG:
            return SMALL if self._total <= SMALL else SIZES[0]
        return SIZES[num_substeps > 0 and self._total > 2 * SIZES[0]]

    def _inputs(self, first: int) -> tuple:
        """Return the program's inputs for the batch that begins with a simulation."""
        segments, total = self.segments, self._total
        chosen = np.minimum(np.arange(first, first + self._size), total - 1)
        row, segment = chosen // self.start.shape[1], chosen % self.start.shape[1]
        begin = self.start[row, segment]
        begin[total - first :] = np.nan  # padding: C MuJoCo leaves it out
        own = self.theta[row, segment] if self.theta.ndim > 2 else self.theta[row]
        before = (segments.recording[segment], segments.num_past[segment])
        past = Past(segments.past, segments.past_qvel, self.activations, *before)
        inputs = (own, begin, segments.ctrl[segment], segments.place[segment])
        inputs = (*inputs, past if self.program.looks_back else None)
        return inputs if self.path is None else (*inputs, self.path[segment])


def compile_together(every: Sequence[Batches]) -> None:
    """Compile the programs of several batches side by side; those that are, take no time."""
    lowered = [batches.lower() for batches in every]  # Python, in the caller's contexts of JAX
    with ThreadPoolExecutor(devices.num_cores()) as pool:
        for _ in pool.map(jax.stages.Lowered.compile, lowered):  # an error in one is raised here
            pass
