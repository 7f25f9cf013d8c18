"""What is fitted to what, and how the residuals change with parameters and initial states.

Residuals are prediction minus measurement, in units of each signal's noise, and count as far as a
sample is trusted. Sensitivities to the parameters and to the initial states come from the same
batched simulation.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Generic, NamedTuple, Protocol, Self, TypeVar

import mujoco
import numpy as np

from garat_jax.diagnosis.segments import Segments
from garat_jax.diagnosis.slots import Slot
from garat_jax.effects import Effect, Suggestion

FEWEST_SEGMENTS = 3
"""Fitted segments, and blocks of time held out, below which nothing is certain."""
BLOCK = 0.25
"""Seconds of the shortest block within which errors may be correlated, in robust variances."""
START_STEP = 1e-4
"""Finite difference of an initial state, relative to its spread."""
LARGE = 1e8
"""Whitened residual that stands for a simulation that diverged."""
COLLINEAR = 1e-7
"""Singular value, relative to the largest, below which initial states make no direction anew."""


class Predictor(Protocol):
    """What a fit needs of a simulator; see `simulate.Simulator`."""

    @property
    def effects(self) -> Sequence[Effect]:
        """The effects that the parameters belong to."""
        ...

    @property
    def slots(self) -> Sequence[Slot]:
        """The parameters, in the order of `theta`."""
        ...

    @property
    def base(self) -> np.ndarray:
        """Values to begin with, [num_parameters]."""
        ...

    @property
    def host(self) -> mujoco.MjModel:
        """The compiled model."""
        ...

    def refined(self, factor: int) -> Self:
        """Return the same with `factor` physics substeps in place of each."""
        ...

    def predict(self, theta: np.ndarray, start: np.ndarray, segments: Segments) -> np.ndarray:
        """Predict every segment's signals, [P, S, L, num_signals].

        Args:
            theta: Parameters, [P, num_parameters] or, each segment its own, [P, S, ..].
            start: Initial states, [P, S, nq + nv].
            segments: Commands and sample times.
        """
        ...


AnySimulator = TypeVar("AnySimulator", bound=Predictor)


@dataclasses.dataclass(frozen=True)
class Problem(Generic[AnySimulator]):
    """What is fitted to what.

    Attributes:
        simulator: The model with all candidates.
        segments: All segments, those held out among them.
        fitted: Which segments the parameters may see, [S] bool.
        interval: Seconds between samples.
        suggested: Sizes at which to try candidates besides those that are always tried, by index.
    """

    simulator: AnySimulator
    segments: Segments
    fitted: np.ndarray
    interval: float
    suggested: Mapping[int, Suggestion] = dataclasses.field(default_factory=dict)

    @property
    def horizon(self) -> float:
        """Seconds of a segment."""
        return self.segments.seconds

    @property
    def num_fitted(self) -> int:
        """Return how many segments are fitted, without short rests of recordings."""
        return int(np.sum(self.fitted & self.segments.is_whole))

    @property
    def num_signals(self) -> int:
        """Return how many signals were measured or estimated at each sample."""
        return self.segments.measured.shape[2]

    def starts(self, effect: int) -> tuple[Mapping[str, float], ...]:
        """Return the sizes at which to try an effect, by parameter: listed ones, then suggested."""
        law = self.simulator.effects[effect]
        listed, suggestion = law.starts(self.simulator.host, law.target), self.suggested.get(effect)
        return listed if suggestion is None else (*listed, *suggestion.starts)

    def num_listed(self, effect: int) -> int:
        """Return how many sizes at which to try an effect its law lists itself."""
        law = self.simulator.effects[effect]
        return len(law.starts(self.simulator.host, law.target))

    def num_tried(self, effect: int) -> int:
        """Return how many sizes of an effect were looked at, for the correction of its p-value."""
        law, suggestion = self.simulator.effects[effect], self.suggested.get(effect)
        more = suggestion.num_tried if suggestion is not None else 0
        num_listed = self.num_listed(effect)
        has_one = num_listed == 1 and law.independent  # that of each of its parameters
        return more + (len(law.parameters()) if has_one else num_listed)

    def take(self, chosen: np.ndarray) -> "Problem[AnySimulator]":
        """Return the problem of some of the segments."""
        segments = self.segments.take(chosen)
        return dataclasses.replace(self, segments=segments, fitted=self.fitted[chosen])

    def within_bounds(self, columns, values: np.ndarray) -> np.ndarray:
        """Return values of some parameters, [..., k], clipped to their bounds."""
        slots = [self.simulator.slots[j].parameter for j in columns]
        return np.clip(values, [p.low for p in slots], [p.high for p in slots])

    def whiten(self, predicted: np.ndarray) -> np.ndarray:
        """Return whitened residuals [..., S, N] of predictions [..., S, L, num_signals]."""
        s = self.segments
        residual = (predicted - s.measured) * self.scale
        residual = np.where(np.isfinite(residual), residual, LARGE)
        return np.clip(residual, -LARGE, LARGE).reshape(*residual.shape[:-2], -1)

    def unwhiten(self, residual: np.ndarray) -> np.ndarray:
        """Return the predictions [S, L, num_signals] that made whitened residuals [S, N].

        Samples that do not count come out as measured.
        """
        s, scale = self.segments, self.scale
        deviation = residual.reshape(s.measured.shape) / np.where(scale > 0, scale, 1.0)
        return s.measured + deviation

    def whiten_change(self, change: np.ndarray) -> np.ndarray:
        """Return changes of predictions [..., S, L, num_signals], whitened, [..., S, N]."""
        change = change * self.scale
        change = np.where(np.isfinite(change), change, 0.0)
        whitened = np.clip(change, -LARGE, LARGE)
        return whitened.reshape(*change.shape[:-2], math.prod(change.shape[-2:]))

    def residual_by(
        self, simulator: AnySimulator, theta: np.ndarray, start: np.ndarray
    ) -> np.ndarray:
        """Return the whitened residuals [S, N] of a simulator at one point."""
        return self.whiten(simulator.predict(theta[None], start[None], self.segments))[0]

    @property
    def scale(self) -> np.ndarray:
        """Return what a deviation counts, [S, L, num_signals]."""
        s = self.segments
        return s.counts * s.trust / s.noise

    @property
    def expected(self) -> np.ndarray:
        """Return the cost of each segment that noise alone makes, [S]."""
        return np.sum((self.scale * self.segments.noise) ** 2, axis=(1, 2))

    def integrator_error(
        self, theta: np.ndarray, start: np.ndarray, residual: np.ndarray
    ) -> np.ndarray:
        """Return the change of the residuals [S, N] on halving the physics timestep.

        A first-order integrator's error is twice this change.
        """
        return self.residual_by(self.simulator.refined(2), theta, start) - residual

    def blocks(self) -> np.ndarray:
        """Return each whitened residual's block of time within its segment, [S, N]."""
        num_samples, num_signals = self.segments.measured.shape[1:]
        count = max(1, num_samples // max(1, round(BLOCK / self.interval)))
        place = self.segments.place * (self.segments.weight > 0)  # none of padding alone
        block = np.floor(place * count / (np.floor(place.max()) + 1.0)).astype(int)
        return np.repeat(np.minimum(block, count - 1), num_signals, axis=1)


AnyProblem = TypeVar("AnyProblem", bound=Problem)


class Linearisation(NamedTuple):
    """Residuals and sensitivities at one point.

    Attributes:
        residual: [S, N].
        parameters: Derivatives by the free parameters, [S, N, num_free].
        start: Derivatives by the initial state's components, in units of the segments'
            `start_unit`, [S, N, nq + nv].
    """

    residual: np.ndarray
    parameters: np.ndarray
    start: np.ndarray


def linearise(
    problem: Problem,
    theta,
    start,
    columns,
    steps,
    sensitivity: np.ndarray | None = None,
    residual: np.ndarray | None = None,
) -> Linearisation:
    """Simulate the point and one perturbation a column and a component of the initial state.

    Args:
        problem: What is fitted.
        theta: All parameters, [num_parameters] or, each segment its own, [S, num_parameters].
        start: Initial states, [S, nq + nv].
        columns: Indices of the parameters to perturb.
        steps: Their perturbations.
        sensitivity: Derivatives by the initial states from nearby, [S, N, nq + nv]; they are most
            of the simulations and change little.
        residual: At the point itself, if that is known, [S, N].
    """
    unit = problem.segments.start_unit
    num_start = len(unit) if sensitivity is None else 0
    first = 1 if residual is None else 0
    thetas = np.tile(theta, (first + len(columns) + num_start, *np.ones(np.ndim(theta), int)))
    for i, (j, step) in enumerate(zip(columns, steps, strict=True)):
        thetas[first + i, ..., j] += step
    starts = np.tile(start, (len(thetas), 1, 1))
    for i in range(num_start):
        starts[first + len(columns) + i, :, i] += START_STEP * unit[i]
    residuals = problem.whiten(problem.simulator.predict(thetas, starts, problem.segments))
    here = residuals[0] if residual is None else residual
    changes = np.moveaxis(residuals[first:] - here, 0, -1)
    parameters = changes[..., : len(columns)] / np.asarray(steps, float)
    by_start = changes[..., len(columns) :] / START_STEP if sensitivity is None else sensitivity
    return Linearisation(here, parameters, by_start)


class StartSpace:
    """The residuals that initial states can make, orthonormal within each segment.

    (By eigenvectors of the Gram matrix, twice, for the sake of rounding; Stathopoulos and Wu 2002.
    For many tall matrices that is a tenth of the time of singular value decompositions.)

    Attributes:
        basis: [S, N, nq + nv]; zero where a direction is not excited.
    """

    def __init__(self, sensitivity: np.ndarray):
        scale = np.linalg.norm(sensitivity, axis=1, keepdims=True)
        self.basis = sensitivity / np.maximum(scale, 1e-300)
        for _ in range(2):
            square, ways = np.linalg.eigh(np.swapaxes(self.basis, 1, 2) @ self.basis)
            is_excited = square > COLLINEAR**2 * square.max(axis=1, keepdims=True)
            factor = np.where(is_excited, 1.0 / np.sqrt(np.maximum(square, 1e-300)), 0.0)
            self.basis = self.basis @ (ways * factor[:, None, :])

    def remove(self, columns: np.ndarray) -> np.ndarray:
        """Project columns [S, N, k] onto what no initial state can make."""
        return columns - self.basis @ (np.swapaxes(self.basis, 1, 2) @ columns)


def block_labels(problem: Problem) -> np.ndarray:
    """Return a number for each block of each segment, per whitened residual, [S, N]."""
    blocks = problem.blocks()
    return np.arange(len(problem.fitted))[:, None] * (blocks.max() + 1) + blocks


def block_stretches(problem: Problem) -> np.ndarray:
    """Return the stretch of segments in which the block with each label lies, [labels]."""
    return np.repeat(problem.segments.stretch, problem.blocks().max() + 1)


def tall(columns: np.ndarray) -> np.ndarray:
    """Turn columns [S, N, k] into [S * N, k]."""
    return columns.reshape(columns.shape[0] * columns.shape[1], columns.shape[2])
