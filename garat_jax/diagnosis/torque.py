"""Compare measured joint torques with the model's: a closed loop hides errors in position.

A controller that tracks well makes the position right whatever the model lacks; the torque that it
had to give for that is then wrong.
"""

import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np
from scipy import signal

from garat_jax.diagnosis.columns import torques
from garat_jax.diagnosis.filters import even_steps
from garat_jax.diagnosis.localise import MissingTorque, missing_torque, window_size
from garat_jax.diagnosis.measurements import Recording
from garat_jax.dynamics import Dynamics


@dataclasses.dataclass(frozen=True)
class TorqueError:
    """How a joint's measured torque and the model's differ.

    Attributes:
        joint: The joint; of a ball or free joint the dof too, as `NAME.0`.
        unit: N m or N.
        measured_rms: Root mean square of the measured torque.
        actuator_rmse: Against what the model's actuators give for the recorded commands.
        actuator_fit_percent: The same as 100 (1 - |τ - τ̂| / |τ - mean τ|); NaN where the measured
            torque never changes.
        motion_rmse: Against what the model needs for the recorded motion (inverse dynamics).
        motion_fit_percent: The same in per cent.
    """

    joint: str
    unit: str
    measured_rms: float
    actuator_rmse: float
    actuator_fit_percent: float
    motion_rmse: float
    motion_fit_percent: float

    @property
    def sentence(self) -> str:
        """What is wrong, in words."""
        return (
            f"{self.joint}: measured {self.measured_rms:.3g} {self.unit} rms; off by "
            f"{self.motion_rmse:.3g} {self.unit} from what the motion takes in the model, and by "
            f"{self.actuator_rmse:.3g} {self.unit} from what its actuators give"
        )


def compare_torques(
    model: mujoco.MjModel, recordings: Sequence[Recording], world: Dynamics | None = None
) -> tuple[TorqueError, ...]:
    """Compare every measured torque with the model's, smoothed alike; empty without any.

    Args:
        model: The compiled model, native fields as its effects leave them.
        recordings: What was measured.
        world: The same with its effects; see `missing_torque`.
    """
    spans = [
        dataclasses.replace(recording, spans=(span,))
        for recording in recordings
        if recording.torque
        for span in recording.spans
    ]
    missing = [(span, missing_torque(model, [span], world)) for span in spans]
    found = []
    for dof, (name, unit) in enumerate(torques(model)):
        joint = name.partition(".")[2]
        rows = [_of_span(span, m, joint, dof) for span, m in missing if joint in span.torque]
        if rows:
            measured, given, needed = (np.concatenate(c) for c in zip(*rows, strict=True))
            of_actuator, of_motion = _error(measured, given), _error(measured, needed)
            rms = float(np.sqrt(np.mean(measured**2)))
            found.append(TorqueError(joint, unit, rms, *of_actuator, *of_motion))
    return tuple(found)


def _of_span(recording: Recording, missing: MissingTorque, joint: str, dof: int):
    """Return measured, given and needed torque along a recording of one span, [M] each."""
    ((a, b),) = recording.spans
    time = even_steps(recording.time[a:b])
    measured = np.interp(time, recording.time[a:b], recording.torque[joint][a:b])
    smooth = np.asarray(signal.savgol_filter(measured, window_size(time), 2))
    measured = np.interp(missing.time, time, smooth)
    given = missing.command[:, dof]
    return measured, given, given + missing.torque[:, dof]


def _error(measured: np.ndarray, modelled: np.ndarray) -> tuple[float, float]:
    """Return the root mean square error and the fit in per cent; NaN where nothing changes."""
    rest = float(np.linalg.norm(measured - modelled))
    spread = float(np.linalg.norm(measured - measured.mean()))
    changes = spread > 1e-9 * float(np.linalg.norm(measured))
    return rest / len(measured) ** 0.5, 100 * (1 - rest / spread) if changes else float("nan")
