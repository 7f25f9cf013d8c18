"""How far is a model off, and where? Compare it with a recording of a rig that has dry friction."""

import tempfile
from pathlib import Path

from garat_jax import Recording, compare, load_model
from garat_jax.diagnosis.hidden import make_recordings

PENDULUM = Path(__file__).parents[1] / "envs" / "assets" / "pendulum.xml"

with tempfile.TemporaryDirectory() as folder:
    made = make_recordings(
        PENDULUM, Path(folder), 0, num_recordings=2, seconds=3.0, rate=125.0,
        kind="coulomb_friction",
    )  # fmt: skip
    model = load_model(PENDULUM)
    recordings = [Recording.read(path, model) for path in (*made.fit, *made.holdout)]
    comparison = compare(model, recordings)

print(comparison)
for quality in comparison.recordings:
    print(f"{quality.name}: {quality.rate:.0f} Hz, lag of the commands {quality.command_lag}")
figure = comparison.plot()  # in a notebook: the error against the horizon
