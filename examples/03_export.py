"""Add an effect to a model, write it as a card and as plain MJCF, and simulate that."""

import shutil
import tempfile
from pathlib import Path

import mujoco

from garat_jax import CATALOGUE, load_model
from garat_jax.diagnosis.export import export_mjcf
from garat_jax.diagnosis.model_card import save_card

PENDULUM = Path(__file__).parents[1] / "envs" / "assets" / "pendulum.xml"

with tempfile.TemporaryDirectory() as folder:
    copy = Path(shutil.copy(PENDULUM, folder))
    model = load_model(copy)
    joint = CATALOGUE["coulomb_friction"].targets(model.compile("mujoco").host.model)[0]
    friction = CATALOGUE["coulomb_friction"](joint, torque=0.06)
    delay = CATALOGUE["actuator_delay"]("all", delay=0.01)
    card = save_card(copy.with_suffix(".toml"), model, [friction, delay])
    exported = export_mjcf(load_model(card), copy.with_name("repaired.xml"))
    for line in exported.unsaid:
        print(f"not in MJCF: {line}")
    repaired = mujoco.MjModel.from_xml_path(str(exported.path))

print(f"{joint} now has a friction of {repaired.dof_frictionloss[0]:g} N m")
