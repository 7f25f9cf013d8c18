"""What a report shows: predictions before and after the repair, and the missing torque."""

import dataclasses
from collections.abc import Sequence

import mujoco

from garat_jax.diagnosis.diagnose import thin
from garat_jax.diagnosis.findings import Candidate
from garat_jax.diagnosis.localise import MissingTorque, missing_torque
from garat_jax.diagnosis.measurements import Recording, longest_span
from garat_jax.diagnosis.model_card import Model
from garat_jax.diagnosis.replay import Replay, as_recordings, lasting_horizons, replay
from garat_jax.dynamics import native_model
from garat_jax.effects import Effect


@dataclasses.dataclass(frozen=True)
class View:
    """A model's predictions of the recordings, before and after it was repaired.

    Attributes:
        recordings: What was measured, those held out last.
        shown: Numbers of those that the report shows the predictions of.
        before: Predictions of the model as it is, by horizon, of the recordings shown.
        after: Predictions of the repaired model; empty without a repair.
        missing: The torque that the model lacks, from the measurements.
        explained: The same from the repaired model's predictions.
        host: The compiled model.
    """

    recordings: tuple[Recording, ...]
    shown: Sequence[int]
    before: tuple[Replay, ...]
    after: tuple[Replay, ...]
    missing: MissingTorque
    explained: MissingTorque | None
    host: mujoco.MjModel

    @property
    def middle(self) -> int:
        """Which horizon traces are drawn of: the longest up to half a second."""
        usable = [i for i, played in enumerate(self.before) if played.horizon <= 0.5]
        return usable[-1] if usable else 0


def as_effects(model: Model, selected: Sequence[Candidate]) -> tuple[Effect, ...]:
    """Return the effects that a diagnosis found, with the estimated parameters."""
    return tuple(
        model.catalogue[c.effect](
            target=c.target, **{n: e.estimate for n, e in c.parameters.items()}
        )
        for c in selected
    )


def repaired(model: Model, selected: Sequence[Candidate]) -> Model:
    """Return a model with the effects that a diagnosis found, some in the place of its own."""
    return model.with_effects(as_effects(model, selected))


def look(
    model: Model,
    recordings: Sequence[Recording],
    shown: Sequence[int],
    selected: Sequence[Candidate] = (),
) -> View:
    """Simulate what the report shows.

    Args:
        model: The model as it was given.
        recordings: What was measured, those held out last.
        shown: Numbers of the recordings that the report shows the predictions of.
        selected: The effects that a diagnosis found.
    """
    recordings = thin(recordings)
    world = model.compile(engine="mujoco")
    host = native_model(world)
    horizons = lasting_horizons(recordings) or [longest_span(recordings)]
    before = replay(model, recordings, dict.fromkeys(horizons, shown))
    after, explained = (), None
    if selected:
        wanted = dict.fromkeys(horizons, shown) | {horizons[-1]: range(len(recordings))}
        *after, whole = replay(repaired(model, selected), recordings, wanted)
        after = (*after, whole.only(shown))
        explained = missing_torque(host, as_recordings(whole, recordings, host), world)
    missing = missing_torque(host, recordings, world)
    return View(recordings, shown, before, after, missing, explained, host)
