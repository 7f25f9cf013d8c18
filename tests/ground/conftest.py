"""Recordings of a machine whose motor is off, that tests of grounding share."""

import pytest

from garat_jax.diagnosis import load_model
from garat_jax.diagnosis.compare import read_recordings
from garat_jax.diagnosis.hidden import make_recordings
from tests import models


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A model, and recordings of a machine whose motor is off by a constant torque."""
    folder = tmp_path_factory.mktemp("recorded")
    path = folder / "pendulum.xml"
    path.write_text(models.PENDULUM)
    made = make_recordings(
        path, folder / "data", 3, num_recordings=3, seconds=1.0, rate=125.0, kind="torque_offset"
    )
    return path, [*made.fit, *made.holdout], made.parameters["torque"]


@pytest.fixture(scope="module")
def read(recorded):
    model = load_model(recorded[0])
    return model, read_recordings(model, recorded[1])
