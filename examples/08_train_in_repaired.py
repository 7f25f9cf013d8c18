"""Does a repair help a policy? Train in the model as it is, and in the repaired one; try both."""

import dataclasses
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp

from garat_jax import CATALOGUE, Recording, improve, load_model, make_world
from garat_jax.agents import trpo
from garat_jax.diagnosis.hidden import make_recordings
from garat_jax.env import Task
from garat_jax.rollout import evaluate

PENDULUM = Path(__file__).parents[1] / "envs" / "assets" / "pendulum.xml"
KINDS = ("motor_gain", "viscous_damping", "coulomb_friction")
ITERATIONS, SEEDS = 40, 8


@dataclasses.dataclass(frozen=True)
class Level(Task):
    """Hold the pendulum level, which takes half of its motor's torque; the cost is the angle."""

    mjcf: Path = PENDULUM
    num_substeps: int = 10
    episode_length: int = 100
    solved_return: float = -5.0

    def initial(self, host, key):
        """Begin near the goal, at rest."""
        return jax.random.uniform(key, (host.nq,), minval=1.4, maxval=1.7), jnp.zeros(host.nv)

    def observe(self, state):
        """See the angle and its rate."""
        return jnp.concatenate([state.qpos, state.qvel])

    def reward(self, before, action, after):
        """Pay for being near the goal [rad]."""
        return -jnp.abs(after.qpos[0] - jnp.pi / 2)

    def terminated(self, after):
        """End where the state is not finite."""
        return ~jnp.isfinite(after.qpos[0])


def train(world):
    """Train policies of several seeds; return the agent and their parameters."""
    agent = trpo.make(world.env, trpo.TRPOConfig(num_envs=16, num_steps=50))

    def step(state, _):
        return agent.step(state, world.params)[0], None

    def learn(key):
        return jax.lax.scan(step, agent.init(key, world.params), length=ITERATIONS)[0].policy

    return agent, jax.jit(jax.vmap(learn))(jax.random.split(jax.random.key(0), SEEDS))


with tempfile.TemporaryDirectory() as folder:
    made = make_recordings(
        PENDULUM, Path(folder), 5, num_recordings=3, seconds=3.0, rate=125.0, kind="motor_gain"
    )
    model = load_model(PENDULUM, {kind: CATALOGUE[kind] for kind in KINDS})
    recordings = [Recording.read(path, model) for path in (*made.fit, *made.holdout)]
    improved = improve(model, recordings)
print(improved)

truth = CATALOGUE[made.kind](made.target, **made.parameters)
machine = make_world(Level(), effects=(truth,))
errors = {}
for name, tried in {"as it is": model, "repaired": improved.model}.items():
    agent, policies = train(tried.world(Level()))

    def on_machine(policy, agent=agent):
        """Return the returns of ten episodes."""
        return evaluate(machine.env, machine.params, agent.policy, policy, jax.random.key(1), 10)

    returns = jax.jit(jax.vmap(on_machine))(policies).returns
    errors[name] = -float(returns.mean()) / Level.episode_length
    print(f"trained in the model {name}: {errors[name]:.3f} rad off on the machine")
