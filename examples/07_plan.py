"""Viscous or dry friction? Plan the commands under which they look least alike."""

import tempfile
from pathlib import Path

from garat_jax import load_model, plan, write_plan

PENDULUM = Path(__file__).parents[1] / "envs" / "assets" / "pendulum.xml"

model = load_model(PENDULUM)
planned = plan(model, "viscous_damping", "coulomb_friction", seconds=3.0)
with tempfile.TemporaryDirectory() as folder:
    rows = write_plan(planned, Path(folder, "plan.csv")).read_text().splitlines()

print(planned)
print(f"{len(rows) - 1} commands at 100 Hz, {rows[0]}")
figure = planned.plot()  # in a notebook: the commands
