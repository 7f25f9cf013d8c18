import jax
import jax.numpy as jnp
import pytest

from garat_jax import dynamics
from garat_jax.agents import ppo, trpo
from garat_jax.effects import AirDrag, PayloadMass
from tests.models import PENDULUM, spec
from tests.probe_envs import Walk, WalkParams

SMALL = {"num_envs": 2, "num_steps": 4, "hidden": (4,)}


def test_physics_and_its_derivatives_use_all_bits_where_a_device_would_drop_some():
    effects = (
        PayloadMass(target="body/pole", mass=0.1),
        AirDrag(target="body/pole", coefficient=0.1),
    )
    world = dynamics.compile(spec(PENDULUM), (), effects, "mjx")
    host = world.host.model

    def reached(effects, ctrl):
        at = world.replace(effects=effects)
        state = dynamics.initial_state(at, jnp.asarray(host.qpos0), jnp.zeros(host.nv))
        return dynamics.step(at, state, ctrl).qvel.sum()

    for function in (reached, jax.jacfwd(reached)):
        program = jax.jit(function).lower(world.effects, jnp.zeros(host.nu)).as_text()
        products = [line for line in program.splitlines() if "stablehlo.dot_general" in line]
        assert products
        assert all("precision = [HIGHEST, HIGHEST]" in line for line in products)


@pytest.mark.parametrize(
    "make",
    [
        lambda env: ppo.make(env, ppo.PPOConfig(**SMALL, num_minibatches=2)),
        lambda env: trpo.make(env, trpo.TRPOConfig(**SMALL, value_minibatch=4)),
    ],
)
def test_agents_train_where_jax_counts_in_double_precision(make):
    with jax.enable_x64(True):
        agent, params = make(Walk()), WalkParams(0.1)
        state = agent.init(jax.random.key(0), params)
        state, metrics, _ = jax.jit(agent.step)(state, params)
    assert all(jnp.isfinite(value).all() for value in jax.tree.leaves((state.policy, metrics)))
