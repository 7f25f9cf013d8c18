"""What does a drone's model lack? It flies freely, with a load on a string, pushed at a site.

A free joint has its position and unit quaternion (w first) as `qpos.NAME.0` to `.6`, its velocity
in the world's frame and its angular velocity in the body's as `qvel.NAME.0` to `.5`, as in MuJoCo.
"""

import tempfile
from pathlib import Path

import mujoco
import numpy as np

from garat_jax import CATALOGUE, Recording, diagnose, load_model

DRONE = """
<mujoco model="drone">
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody><body name="frame" pos="0 0 1"><freejoint name="root"/>
    <geom name="hull" type="box" size="0.12 0.12 0.03" mass="0.8" contype="0" conaffinity="0"/>
    <site name="centre"/>
    <body name="load" pos="0 0 -0.05"><joint name="string" type="ball" damping="0.002"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.01" mass="0.15"
            contype="0" conaffinity="0"/></body></body></worldbody>
  <actuator>
    <motor name="thrust" site="centre" gear="0 0 1 0 0 0" ctrlrange="0 20"/>
    <motor name="roll" site="centre" gear="0 0 0 1 0 0" ctrlrange="-1 1"/>
    <motor name="pitch" site="centre" gear="0 0 0 0 1 0" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""
KINDS = ("air_drag", "motor_gain", "payload_mass", "gravity_tilt")
DRAG, LOSS = 0.12, 0.93  # N s²/m², and what the propellers give of the thrust: both unknown to it
WEIGHT = 0.95 * 9.81


def fly(seed: int, seconds: float = 4.0) -> dict[str, np.ndarray]:
    """Hover and tilt for some seconds in the true world, at a sixteenth of the model's timestep."""
    spec, rng = mujoco.MjSpec.from_string(DRONE), np.random.default_rng(seed)
    spec.option.timestep /= 16
    model = spec.compile()
    data, phase, rate = mujoco.MjData(model), rng.uniform(0, 6, 3), rng.uniform(1.5, 4, 3)
    rows = []
    for time in np.arange(0.0, seconds, 0.005):
        up, (lift, roll, pitch) = data.xmat[1].reshape(3, 3)[2], np.sin(rate * time + phase)
        ctrl = [
            WEIGHT * (1.05 + 0.2 * lift) - 1.5 * data.qvel[2],
            0.25 * (0.4 * roll - up[1]) - 0.06 * data.qvel[3],
            0.25 * (0.4 * pitch + up[0]) - 0.06 * data.qvel[4],
        ]
        noisy = [
            data.qpos + 3e-4 * rng.normal(size=model.nq),
            data.qvel + 3e-3 * rng.normal(size=model.nv),
        ]
        rows.append(np.concatenate([[time], *noisy, ctrl]))
        data.ctrl[:] = ctrl * np.array([LOSS, 1.0, 1.0])
        for _ in range(16):
            speed = data.qvel[:3]
            data.qfrc_applied[:3] = -DRAG * np.linalg.norm(speed) * speed
            mujoco.mj_step(model, data)
    names = ["time", *(f"qpos.root.{i}" for i in range(7)), *(f"qpos.string.{i}" for i in range(4))]
    names += [*(f"qvel.root.{i}" for i in range(6)), *(f"qvel.string.{i}" for i in range(3))]
    names += ["ctrl.thrust", "ctrl.roll", "ctrl.pitch"]
    return dict(zip(names, np.transpose(rows), strict=True))


with tempfile.TemporaryDirectory() as folder:
    path = Path(folder, "drone.xml")
    path.write_text(DRONE, encoding="utf-8")
    model = load_model(path, {kind: CATALOGUE[kind] for kind in KINDS})
    flights = []
    for seed in range(3):
        np.savez(Path(folder, f"flight_{seed}.npz"), **fly(seed))
        flights.append(Recording.read(Path(folder, f"flight_{seed}.npz"), model))
    diagnosis = diagnose(model, flights)

print(diagnosis)
print(f"hidden were a drag of {DRAG} N s²/m² and a thrust of {LOSS} times the commanded")
