"""What a model still lacks with the effects that were found: the honest part of `unexplained`."""

import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np

from garat_jax.diagnosis.localise import Place, localise, missing_torque
from garat_jax.diagnosis.measurements import Recording, signals
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.replay import Replay, as_recordings
from garat_jax.diagnosis.starts import Fit


def leftover(
    problem: Problem, fitted: Fit, recordings: Sequence[Recording], host: mujoco.MjModel
) -> list[Place]:
    """Say what the torque that is still missing goes with, largest share first.

    It is the torque that the measured motion lacks less the one that the fit's own predictions lack
    by the same computation, on the same segments.

    Args:
        problem: The recordings, cut.
        fitted: The model with the effects that were found.
        recordings: What was measured, as it was cut.
        host: The compiled model without these effects.
    """
    listed = signals(host)[: problem.segments.measured.shape[2]]
    names, units = zip(*((s.name, s.unit) for s in listed), strict=True)
    predictions = problem.unwhiten(fitted.residual)
    played = Replay(problem.horizon, names, units, problem.segments, predictions)
    predicted = as_recordings(played, recordings, host)
    measured = [
        dataclasses.replace(recordings[i], spans=made.spans)
        for i, made in zip(np.unique(problem.segments.recording), predicted, strict=True)
    ]
    missing, explained = (missing_torque(host, some) for some in (measured, predicted))
    return localise(missing._replace(torque=missing.torque - explained.torque))
