"""The pairs differ in what the paper's table says, and in nothing else."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from garat_jax import dynamics, rollout
from garat_jax.envs.pairs import PAIRS
from garat_jax.methods.transition_error import transition_error
from garat_jax.overrides import load_spec
from garat_jax.presets import METHODS
from garat_jax.rollout import as_of
from garat_jax.runs import RunDirectory

# Desai et al. 2020, table of modified environments.
MASSES = [
    ("inverted_pendulum_heavy", ["pole"], 4.89, 100.0),
    ("hopper_heavy", ["torso"], 3.53, 6.0),
    ("half_cheetah_heavy", None, 14.0, 20.0),
    ("walker_heavy", ["torso"], 3.534, 10.0),
]


def compiled(name: str) -> list[mujoco.MjModel]:
    pair = PAIRS[name]
    spec = load_spec(pair.task.mjcf)
    worlds = (dynamics.compile(spec, o, engine="mujoco") for o in (pair.source, pair.target))
    return [world.host.model for world in worlds]


@pytest.mark.parametrize(("name", "bodies", "light", "heavy"), MASSES, ids=lambda x: str(x))
def test_masses_are_the_papers_and_inertia_scales_with_them(name, bodies, light, heavy):
    source, target = compiled(name)
    names = bodies or [source.body(i).name for i in range(1, source.nbody)]
    for model, expected in ((source, light), (target, heavy)):
        mass = sum(model.body(body).mass[0] for body in names)
        assert mass == pytest.approx(expected, rel=1e-6)
    for i in range(1, source.nbody):
        ratio = heavy / light if source.body(i).name in names else 1.0
        np.testing.assert_allclose(target.body_mass[i], ratio * source.body_mass[i], rtol=1e-6)
        np.testing.assert_allclose(
            target.body_inertia[i], ratio * source.body_inertia[i], rtol=1e-6
        )


def test_policies_get_the_iterations_that_most_seeds_needed_in_the_targets():
    path = Path(__file__).parent.parent / "benchmarks" / "results" / "learning.json"
    rows = {row["env"]: row for row in json.loads(path.read_text(encoding="utf-8"))["targets"]}
    for name, pair in PAIRS.items():
        agent = METHODS["garat"](pair).agent
        solved = np.asarray(rows[name]["returns"]) >= pair.task.solved_return
        first = int(np.argmax(np.maximum.accumulate(solved, axis=0).mean(axis=1) > 0.5))
        needed = rows[name]["steps"][first]
        assert solved.any(axis=0).mean() > 0.5, name
        assert pair.max_iterations * agent.num_envs * agent.num_steps >= needed, name


def test_a_cheetah_of_14_kg_is_the_tasks():
    source, _ = compiled("half_cheetah_heavy")
    model = load_spec(PAIRS["half_cheetah_heavy"].task.mjcf).compile()
    np.testing.assert_allclose(source.body_mass, model.body_mass, rtol=1e-6)
    np.testing.assert_allclose(source.body_inertia, model.body_inertia, rtol=1e-6)


def test_only_the_foots_sliding_friction_differs():
    source, target = compiled("hopper_high_friction")
    foot = source.geom("foot").id
    assert (source.geom_friction[foot, 0], target.geom_friction[foot, 0]) == (2.0, 2.2)
    target.geom_friction[foot, 0] = 2.0
    np.testing.assert_array_equal(source.geom_friction, target.geom_friction)
    np.testing.assert_array_equal(source.body_mass, target.body_mass)


@pytest.mark.parametrize("name", ["inverted_pendulum_heavy", "minitaur"])
def test_what_the_target_showed_can_be_replayed_in_the_source(name):
    """Minitaur's target has an effect that the source lacks, and so another memory."""
    source, target = PAIRS[name].worlds("mujoco")

    def uniform(params, obs, key):
        del params, obs
        return jax.random.uniform(key, (target.env.action_size,), minval=-1), jnp.zeros(())

    def errors(key):
        recorded = rollout.record(target.env, target.params, uniform, (), key, 3, 4)
        replayed = transition_error(target.env, target.params, recorded)
        shown = as_of(source, target, recorded)
        return replayed.mean, transition_error(source.env, source.params, shown).mean

    same, other = jax.jit(errors)(jax.random.key(0))
    assert same < 1e-6
    assert other > 1e-3


@pytest.mark.parametrize("name", PAIRS)
def test_a_run_writes_down_the_settings_of_every_pair(name, tmp_path):
    config = METHODS["garat"](PAIRS[name], seeds=1)
    run = RunDirectory.create(tmp_path / "run", {}, "", [0])
    run.record_settings(config)
    RunDirectory.create(tmp_path / "run", {}, "", [0], resume=True).record_settings(config)
