"""Test whether the residual holds an effect that nothing else in the recordings imitates.

Initial states and parameters already free are projected out of everything. The test is a robust
Wald test of what is left beside a common delay, offsets of the sensors and the integrator's error,
with blocks of time as the independent units (Liang and Zeger 1986).
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from garat_jax.diagnosis.differences import clear_differences
from garat_jax.diagnosis.findings import DELAYS
from garat_jax.diagnosis.metric import timestep_error
from garat_jax.diagnosis.problem import Problem, StartSpace, block_labels, tall
from garat_jax.diagnosis.robust import orthonormal, wald_test, without
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.diagnosis.slots import columns_of
from garat_jax.diagnosis.starts import Fit

OFFSETS = (
    "torque_offset", "gravity_scale", "gravity_tilt", "payload_mass", "com_offset",
    "joint_stiffness", "encoder_offset",
)  # fmt: skip
"""Kinds whose static part an offset of a position sensor imitates: it is no nuisance to them."""


class Evidence:
    """What some segments say beyond their initial states and the parameters already free.

    Args:
        problem: What is fitted.
        fit: The current fit.
        chosen: Indices of the segments.

    Attributes:
        residual: [M].
    """

    def __init__(self, problem: Problem[Simulator], fit: Fit, chosen: np.ndarray):
        problem, start = problem.take(chosen), fit.start[chosen]
        self._problem, self._theta, self._start = problem, fit.theta, start
        near = fit.sensitivity[chosen]
        lin = clear_differences(problem, fit.theta, start, fit.free, near).linearisation
        self._space = StartSpace(lin.start)
        self._free = orthonormal(tall(self._space.remove(lin.parameters)))
        self._labels = block_labels(problem).ravel()
        self.residual = self.rest(lin.residual[None])[:, 0]
        here = dataclasses.replace(fit.take(chosen), residual=lin.residual)
        integrator = timestep_error(problem, here)
        nuisances = self.rest(np.stack([integrator, *_offsets(problem)]))
        self._integrator, self._offsets = nuisances[:, :1], nuisances[:, 1:]
        self._delay = self._common_delay(fit.free)
        self._nuisances: dict[tuple[bool, bool], np.ndarray] = {}

    def change(self, thetas: np.ndarray) -> np.ndarray:
        """Return what parameters [k, num_parameters] change in the predictions, [M, k]."""
        simulator, segments = self._problem.simulator, self._problem.segments
        moved = simulator.linear_change(thetas, self._theta, self._start, segments)
        return self.rest(self._problem.whiten_change(moved))

    def p_value(self, effect: int, matrix: np.ndarray, num_fitted: int | None = None) -> float:
        """Return the probability of such evidence without the effect.

        Args:
            effect: Index among the simulator's effects.
            matrix: What it changes, [M, k].
            num_fitted: As for `wald_test`.
        """
        kind = self._problem.simulator.effects[effect].kind
        nuisance = self._nuisance(kind not in DELAYS, kind not in OFFSETS)
        return wald_test(matrix, self.residual, nuisance, self._labels, num_fitted)

    def _nuisance(self, with_delay: bool, with_offsets: bool) -> np.ndarray:
        """Return what else may have made the residual, orthonormal, [M, n]; the same for many."""
        if (found := self._nuisances.get((with_delay, with_offsets))) is not None:
            return found
        nuisances = [self._integrator]
        nuisances += [self._delay] if with_delay else []
        nuisances += [self._offsets] if with_offsets else []
        nuisance = orthonormal(np.concatenate(nuisances, axis=1))
        self._nuisances[with_delay, with_offsets] = nuisance
        return nuisance

    def rest(self, columns: np.ndarray) -> np.ndarray:
        """Return changes [k, S, N] less what initial states and free parameters do, [M, k]."""
        rest = self._space.remove(np.moveaxis(columns, 0, -1))
        return without(tall(rest), self._free)

    def _common_delay(self, free: Sequence[int]) -> np.ndarray:
        """Return what a delay changes, [M, 1]; [M, 0] if none is a candidate or any is free."""
        simulator = self._problem.simulator
        delays = [i for i, effect in enumerate(simulator.effects) if effect.kind in DELAYS]
        delays.sort(key=lambda i: simulator.effects[i].target != "all")
        columns = [j for i in delays for j in columns_of(simulator.slots, i).values()]
        if not columns or {*columns} & {*free}:
            return np.zeros((len(self.residual), 0))
        moved = self._theta.copy()
        moved[columns[0]] += simulator.slots[columns[0]].parameter.scale
        return self.change(moved[None])


def _offsets(problem: Problem) -> np.ndarray:
    """Return a constant error of each position sensor, whitened, [nq, S, N]."""
    segments = problem.segments
    num_position = problem.simulator.host.nq
    unit = np.eye(segments.measured.shape[2])[:num_position]
    offset = problem.scale * unit[:, None, None, :]
    return offset.reshape(num_position, *segments.weight.shape[:1], -1)
