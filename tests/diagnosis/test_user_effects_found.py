"""A user's own effect is found among the catalogue's, shown, and trained with."""

import dataclasses
import json
from pathlib import Path

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest

from garat_jax import cli
from garat_jax.agents import trpo
from garat_jax.diagnosis import load_model
from garat_jax.effects.catalogue import load_catalogue
from garat_jax.env import Task
from tests import models
from tests.diagnosis import pendulum

STIFFNESS = 0.3
MINE = '''
"""A spring that stiffens."""
import jax
from flax import struct
from garat_jax.effects import Effect, parameter


@struct.dataclass
class Hardening(Effect):
    """A spring whose torque grows with the cube of the angle."""

    kind = "hardening_spring"
    elements = ("joint",)
    law = "tau = -k q^3"
    identified_by = "swings of several sizes"
    acts = reads_state = True

    stiffness: jax.Array = parameter(
        0.0, unit="N m/rad^3", low=0.0, high=10.0, scale=0.05, source="my bench"
    )

    def apply(self, model, state, ctrl, memory):
        joint = model.host.joint(self.name)
        torque = -self.stiffness * state.qpos[joint.qposadr[0]] ** 3
        force = jax.numpy.zeros_like(state.qvel).at[joint.dofadr[0]].set(torque)
        return ctrl, force, memory
'''


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A model, an effect of one's own, and recordings of a pendulum that has it."""
    folder = tmp_path_factory.mktemp("mine")
    (folder / "my_effects.py").write_text(MINE)
    (folder / "pendulum.xml").write_text(models.PENDULUM)
    for seed in range(3):
        made = pendulum.record(lambda spec: None, seed, ripple=lambda q: -STIFFNESS * q**3)
        np.savetxt(
            folder / f"{seed}.csv",
            np.column_stack([made.time, made.qpos, made.qvel, made.ctrl]),
            delimiter=",",
            header="time,qpos.hinge,qvel.hinge,ctrl.motor",
            comments="",
        )
    return folder


def test_it_is_found_among_all_others_and_shown(folder, capsys):
    data = [str(folder / f"{seed}.csv") for seed in range(3)]
    options = ["--effects", str(folder / "my_effects.py"), "--out", str(folder / "run")]
    assert cli.main(["diagnose", str(folder / "pendulum.xml"), *data, *options]) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith("Missing: hardening_spring at joint/hinge")
    assert "fitting" in printed.err  # what is being done
    found = json.loads((folder / "run" / "diagnosis.json").read_text(), parse_constant=pytest.fail)
    (added,) = found["selected"]
    assert added["effect"] == "hardening_spring"
    assert added["parameters"]["stiffness"]["estimate"] == pytest.approx(STIFFNESS, rel=0.02)
    assert len(found["candidates"]) > 20 and found["candidates"][0] == added
    page = (folder / "run" / "report.html").read_text()
    assert "The model lacks hardening spring at joint/hinge" in page
    assert "N m/rad^3" in page


@dataclasses.dataclass(frozen=True)
class Swing(Task):
    """Stay up; the reward is the height."""

    mjcf: Path
    num_substeps: int = 2
    episode_length: int = 20
    solved_return: float = 0.0

    def initial(self, host, key):
        """Begin far from the rest."""
        return jnp.full(host.nq, 1.5), jnp.zeros(host.nv)

    def observe(self, state):
        """See angle and rate."""
        return jnp.concatenate([state.qpos, state.qvel])

    def reward(self, before, action, after):
        """Pay for the height."""
        return -jnp.cos(after.qpos[0])

    def terminated(self, after):
        """Never."""
        return jnp.zeros((), bool)


def test_policies_train_where_it_acts(folder):
    card = folder / "card.toml"
    effect = 'kind = "hardening_spring"\ntarget = "joint/hinge"\nparameters = { stiffness = 0.3 }\n'
    card.write_text(f'format = "garat-model/1"\nmjcf = "pendulum.xml"\n[[effect]]\n{effect}')
    task, catalogue = Swing(folder / "pendulum.xml"), load_catalogue([folder / "my_effects.py"])
    speeds = {}
    for path in (card, folder / "pendulum.xml"):
        world = load_model(path, catalogue).world(task)
        state = world.env.reset(world.params, jax.random.key(0))
        after = world.env.step(world.params, state, jnp.zeros(1), jax.random.key(1))
        speeds[path.suffix] = float(after.state.physics.qvel[0])
    inertia = 9.81 * 0.6 * 0.25 * np.sin(1.5) / -speeds[".xml"] * 0.004
    torque = (speeds[".toml"] - speeds[".xml"]) / 0.004 * inertia
    assert torque == pytest.approx(-STIFFNESS * 1.5**3, rel=0.01)
    world = load_model(card, catalogue).world(task)
    agent = trpo.make(world.env, trpo.TRPOConfig(num_envs=4, num_steps=20))
    begun = agent.init(jax.random.key(0), world.params)
    state, *_ = agent.step(begun, world.params)
    before, after = (jax.flatten_util.ravel_pytree(s.policy)[0] for s in (begun, state))
    assert np.isfinite(after).all() and not np.array_equal(before, after)
