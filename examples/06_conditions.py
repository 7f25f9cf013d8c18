"""A joint recorded cold and warm: what do both share, and what is each condition's own?"""

import tempfile
from pathlib import Path

from garat_jax import CATALOGUE, Recording, diagnose_conditions, load_model
from garat_jax.diagnosis.hidden import make_recordings

PENDULUM = Path(__file__).parents[1] / "envs" / "assets" / "pendulum.xml"
KINDS = ("viscous_damping", "coulomb_friction", "torque_offset")
SEEDS = {"cold": 5, "warm": 6}  # each draws another friction

model = load_model(PENDULUM, {kind: CATALOGUE[kind] for kind in KINDS})
recordings, truth = {}, {}
with tempfile.TemporaryDirectory() as folder:
    for condition, seed in SEEDS.items():
        made = make_recordings(
            PENDULUM, Path(folder, condition), seed, num_recordings=2, seconds=3.0, rate=125.0,
            kind="coulomb_friction",
        )  # fmt: skip
        files = (*made.fit, *made.holdout)
        recordings[condition] = [Recording.read(path, model) for path in files]
        truth[condition] = made.parameters["torque"]

diagnosis = diagnose_conditions(model, recordings["cold"], {"warm": recordings["warm"]})
print(diagnosis)
print(f"hidden was {truth}")
