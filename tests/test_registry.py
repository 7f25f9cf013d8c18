"""Everything that has a name exists, is described, and can be made."""

import ast
import importlib
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import garat_jax
from garat_jax import cli, dynamics
from garat_jax.effects import CATALOGUE
from garat_jax.env import make_world
from garat_jax.envs import ENVS
from garat_jax.envs.pairs import PAIRS
from garat_jax.methods.make import make_method
from garat_jax.presets import METHODS
from tests.models import showing, spec

QUICK = ("inverted_pendulum",)
"""Environments that MJX compiles within seconds on a CPU."""
NAMES_AND_ENGINES = [
    pytest.param(
        name,
        engine,
        marks=pytest.mark.slow if engine == "mjx" and name not in QUICK else (),
        id=f"{name}-{engine}",
    )
    for name in ENVS
    for engine in ("mujoco", "mjx")
]


def first_step(world):
    """Return what an environment gives at its first step under full action."""

    def step(key):
        state = world.env.reset(world.params, key)
        high = jnp.where(jnp.isfinite(world.env.action_high), world.env.action_high, 1.0)
        return state, world.env.step(world.params, state, high, key)

    return jax.jit(step)(jax.random.key(0))


def observations(world, num_steps=25):
    """Return what an environment shows under random actions, [num_steps, obs_size]."""

    def step(state, key):
        action = jax.random.uniform(key, (world.env.action_size,), minval=-1, maxval=1)
        return world.env.step(world.params, state, action, key).state, state.obs

    def run(key):
        start = world.env.reset(world.params, key)
        return jax.lax.scan(step, start, jax.random.split(key, num_steps))[1]

    return np.asarray(jax.jit(run)(jax.random.key(0)))


def test_every_public_name_is_there():
    for name in garat_jax.__all__:
        assert getattr(garat_jax, name) is not None, name
        assert name in dir(garat_jax)


@pytest.mark.parametrize(("name", "engine"), NAMES_AND_ENGINES)
def test_every_environment_steps(name, engine):
    world = make_world(ENVS[name](), engine=engine)
    state, result = first_step(world)
    assert state.obs.shape == result.state.obs.shape == (world.env.obs_size,)
    assert np.isfinite(result.state.obs).all()
    assert np.isfinite(result.reward)
    assert not np.array_equal(result.state.obs, state.obs)
    assert result.terminated.dtype == result.truncated.dtype == bool
    assert result.state.steps == 1


@pytest.mark.parametrize("name", PAIRS)
def test_every_pair_has_two_worlds_that_differ(name):
    pair = PAIRS[name]
    assert pair.name == name
    assert pair.summary
    source, target = pair.worlds("mujoco")
    in_source, in_target = observations(source), observations(target)
    np.testing.assert_array_equal(in_source[0], in_target[0])
    assert np.abs(in_source - in_target).max() > 1e-4
    assert source.env.obs_size == target.env.obs_size


@pytest.mark.parametrize("name", CATALOGUE)
def test_every_effect_can_be_added_wherever_it_says(name):
    kind = CATALOGUE[name]
    model = spec(showing(name))
    targets = kind.targets(model.compile())
    assert targets
    for target in targets:
        world = dynamics.compile(model, effects=(kind(target),), engine="mujoco")
        assert world.effects[0].target == target
    for parameter in kind.parameters():
        assert parameter.low <= parameter.nominal <= parameter.high
        assert parameter.scale > 0
        assert parameter.source


@pytest.mark.parametrize("pair", PAIRS)
@pytest.mark.parametrize("name", METHODS)
def test_every_preset_fits_every_pair(name, pair):
    config = METHODS[name](PAIRS[pair], seeds=3, engine="mujoco")
    assert (config.method, config.seeds, config.pair, config.engine) == (
        name, 3, PAIRS[pair], "mujoco",
    )  # fmt: skip
    source = make_world(config.pair.task, config.pair.source, engine="mujoco")
    make_method(source.env, lambda params, obs, key: (obs[:1], key), config.grounding)
    assert config.agent.num_envs * config.agent.num_steps >= config.agent.value_minibatch
    assert config.num_target_transitions % config.agent.num_envs == 0


@pytest.mark.parametrize("registry", [ENVS, CATALOGUE, METHODS], ids=["env", "effect", "method"])
def test_every_entry_says_what_it_is(registry):
    for name, entry in registry.items():
        assert (inspect.getdoc(entry) or "").strip(), f"{name} has no docstring"


@pytest.mark.parametrize(
    ("command", "registries"), [("list", (ENVS, PAIRS, METHODS)), ("effects", (CATALOGUE,))]
)
def test_garat_prints_every_name(command, registries, capsys):
    assert cli.main([command]) == 0
    printed = capsys.readouterr().out
    for registry in registries:
        assert all(name in printed for name in registry)


@pytest.mark.parametrize("kind", CATALOGUE)
def test_garat_prints_what_an_effect_is(kind, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "400")
    assert cli.main(["effects", kind]) == 0
    printed, cls = capsys.readouterr().out, CATALOGUE[kind]
    assert cls.law and printed.startswith(f"{kind}: {cls.law}")
    assert cls.identified_by and f"Identified by: {cls.identified_by}." in printed
    for parameter in cls.parameters():
        assert parameter.unit and parameter.source
        (row,) = (line for line in printed.splitlines() if f"│ {parameter.name} " in line)
        assert f"{parameter.low:g} to {parameter.high:g}" in row
        assert parameter.unit in row and parameter.source in row


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_every_command_finds_what_it_imports_late(name):
    source = inspect.getsource(cli.COMMANDS[name])
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom):
            module = importlib.import_module(str(node.module))
            for alias in node.names:
                assert callable(getattr(module, alias.name)) or getattr(module, alias.name)
