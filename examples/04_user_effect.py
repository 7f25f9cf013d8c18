"""Fit an effect of one's own to a recording; `garat diagnose --effects` takes the same file."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from garat_jax import Recording, add, dynamics, load_catalogue, load_model

HERE = Path(__file__).parent
PENDULUM = HERE.parent / "envs" / "assets" / "pendulum.xml"

model = load_model(PENDULUM, load_catalogue([HERE / "my_effects.py"]))
truth = add(model, "thermal_fade", "all", {"fade": 0.5}).model

world = truth.compile("mujoco")
host = world.host.model
time = np.arange(6000) * 2 * host.opt.timestep
limit = 0.5 * host.actuator_ctrlrange[0, 1]
commands = limit * np.sign(np.sin(4 * time) + 0.5 * np.sin(1.7 * time))[:, None]
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

# The warmth is followed from where the recording begins, through the 24 s in which it builds up.
added = add(model, "thermal_fade", "all", recordings=[recording])
print(added)
