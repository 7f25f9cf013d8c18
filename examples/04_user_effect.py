"""Fit an effect of one's own to a recording; `garat diagnose --effects` takes the same file."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from garat_jax import Recording, dynamics, load_model
from garat_jax.diagnosis.add import choose_effect, size
from garat_jax.effects.catalogue import load_catalogue

HERE = Path(__file__).parent
PENDULUM = HERE.parent / "envs" / "assets" / "pendulum.xml"

model = load_model(PENDULUM, load_catalogue([HERE / "my_effects.py"]))
effect = choose_effect(model, "thermal_fade", "all", {})
truth = dataclasses.replace(model, effects=(effect.replace(fade=0.5),))

world = truth.compile("mujoco")
host = world.host.model
time = np.arange(1000) * 2 * host.opt.timestep
limit = 0.5 * host.actuator_ctrlrange[0, 1]
commands = limit * np.sign(np.sin(4 * time))[:, None]
begin = dynamics.initial_state(world, jnp.zeros(host.nq), jnp.zeros(host.nv))
_, path = jax.jit(
    lambda ctrl: jax.lax.scan(
        lambda s, u: (dynamics.step(world, s, u, 2), (s.qpos, s.qvel)), begin, ctrl
    )
)(commands.astype(np.float32))
qpos, qvel = (np.asarray(column, float) for column in path)
rng = np.random.default_rng(0)
qpos, qvel = (x + rng.normal(size=x.shape) * s for x, s in ((qpos, 1e-3), (qvel, 1e-2)))
recording = Recording("made.csv", time, qpos, qvel, commands, {}, True, ((0, len(time)),), ())

# The warmth begins anew 0.1 s before every segment that is fitted (at most 2 s long), so what is
# remembered for longer than that is not seen; this driver forgets within 0.03 s.
sized = size(model, effect, (), [recording])
print(sized)
