"""Contact effects, of which each may move any of its parameters first, take part in a diagnosis."""

import mujoco
import numpy as np

from garat_jax.diagnosis.diagnose import diagnose
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.model_card import Model
from garat_jax.effects import CATALOGUE

PUCK = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <geom name="table" type="plane" size="5 5 0.1" friction="0.5"/>
    <body name="puck" pos="0 0 0.05">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <geom name="puck" type="box" size="0.1 0.1 0.05" mass="1" friction="0.5"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="x" ctrlrange="-10 10" ctrllimited="true"/></actuator>
</mujoco>
"""
TIME = np.arange(1000) * 0.004


def record(friction: float, seed: int, noise: float = 1.0) -> Recording:
    rng = np.random.default_rng(seed)
    spec = mujoco.MjSpec.from_string(PUCK)
    for geom in spec.geoms:
        geom.friction[0] = friction
    spec.option.timestep /= 16
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 8000)
    ctrl = np.repeat(rng.uniform(-10, 10, 20), 50)
    states = []
    for command in ctrl:
        states.append([*data.qpos, *data.qvel])
        data.ctrl[0] = command
        mujoco.mj_step(model, data, 32)
    states = np.asarray(states) + noise * rng.normal(size=(1000, 4)) * [1e-4, 1e-4, 2e-3, 2e-3]
    return Recording(
        name=f"made {seed}",
        time=TIME,
        qpos=states[:, :2],
        qvel=states[:, 2:],
        ctrl=ctrl[:, None],
        torque={},
        velocity_measured=True,
        spans=((0, len(TIME)),),
        warnings=(),
    )


def test_a_slippery_table_is_named_and_every_contact_effect_is_judged():
    kinds = ("contact_friction", "contact_compliance", "viscous_damping", "motor_gain")
    few = {kind: CATALOGUE[kind] for kind in kinds}
    model = Model("puck", __file__, __file__, mujoco.MjSpec.from_string(PUCK), catalogue=few)
    found = diagnose(model, [record(0.3, seed) for seed in range(3)])
    first, twin = found.candidates[:2]
    assert found.selected[0].effect == first.effect == twin.effect == "contact_friction"
    # Puck and table touch nothing but each other: one contact with two names.
    assert first.indistinguishable_from == (twin.named,)
    assert twin.indistinguishable_from == (first.named,)
    assert first.parameters == twin.parameters
    one, other = (c for c in found.candidates if c.effect == "contact_compliance")
    assert {one.target, other.target} == {"geom/puck", "geom/table"}
    assert one.indistinguishable_from == (other.named,)
    assert other.indistinguishable_from == (one.named,)
