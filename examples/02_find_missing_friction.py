"""Which friction does a model lack? Diagnose it; only three kinds are tried, to be quick."""

import tempfile
from pathlib import Path

from garat_jax import CATALOGUE, Recording, diagnose, load_model
from garat_jax.diagnosis.hidden import make_recordings

PENDULUM = Path(__file__).parents[1] / "envs" / "assets" / "pendulum.xml"
KINDS = ("viscous_damping", "coulomb_friction", "torque_offset")

with tempfile.TemporaryDirectory() as folder:
    made = make_recordings(
        PENDULUM, Path(folder), 5, num_recordings=3, seconds=3.0, rate=125.0,
        kind="coulomb_friction",
    )  # fmt: skip
    model = load_model(PENDULUM, {kind: CATALOGUE[kind] for kind in KINDS})
    recordings = [Recording.read(path, model) for path in (*made.fit, *made.holdout)]
    diagnosis = diagnose(model, recordings)

print(diagnosis)
print(f"hidden was {made.kind} at {made.target}: {made.parameters}")
figure = diagnosis.plot("ladder")  # or "ranking", or "where"
