"""The method that a config belongs to."""

from garat_jax.env import Env
from garat_jax.methods.garat import GARAT, GARATConfig
from garat_jax.methods.gat import GAT, GATConfig
from garat_jax.types import Policy


def make_method(env: Env, agent: Policy, config: GARATConfig | GATConfig) -> GARAT | GAT:
    """Build the method that a config belongs to, for a source and a fixed agent's policy."""
    if isinstance(config, GATConfig):
        return GAT(env, agent, config)
    return GARAT(env, agent, config)
