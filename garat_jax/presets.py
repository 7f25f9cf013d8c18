"""Tuned settings, each number with its source."""

from collections.abc import Callable

from garat_jax.agents.ppo import PPOConfig
from garat_jax.methods.garat import GARATConfig
from garat_jax.methods.gat import GATConfig
from garat_jax.transfer import GroundConfig, Pair, TransferConfig


def garat(pair: Pair, seeds: int = 5, engine: str = "auto") -> TransferConfig:
    """GARAT with the settings that docs/grounding.md measures best."""
    return TransferConfig(pair, "garat", seeds=seeds, engine=engine, agent=pair.agent)


def garat_paper(pair: Pair, seeds: int = 5, engine: str = "auto") -> TransferConfig:
    """GARAT with the paper's numbers and some choices of ours; kept to show what that gives.

    From the paper: the agent's TRPO, the transformer's PPO, discount and trace, the discriminator's
    learning rate, one step of it an update, no offset of the reward. Not in the paper: the
    transformer's initial standard deviation, 1 as in the usual libraries. Ours: the L2 coefficient,
    the order of the two updates, an output that is a change of the action, the discriminator's
    inputs, training in the grounded source with the transformer's mean action.
    """
    settings = GARATConfig(
        transformer=PPOConfig(),  # Desai et al. 2020, appendix
        learning_rate=3e-4,
        num_minibatches=1,
        centre_reward=False,
    )
    return TransferConfig(pair, "garat_paper", seeds=seeds, engine=engine, grounding=settings)


def gat(pair: Pair, seeds: int = 5, engine: str = "auto") -> TransferConfig:
    """GAT, the paper's baseline: a forward model of the target, an inverse one of the source."""
    return TransferConfig(
        pair,
        "gat",
        seeds=seeds,
        engine=engine,
        agent=pair.agent,
        grounding=GATConfig(),
        num_updates=20,
    )


METHODS: dict[str, Callable[..., TransferConfig]] = {
    "garat": garat,
    "garat_paper": garat_paper,
    "gat": gat,
}

GROUNDING: dict[str, GroundConfig] = {
    # Four times the paper's updates: the one that strays least from the recordings is kept.
    "garat": GroundConfig("garat", GARATConfig(), num_updates=200),
    "gat": GroundConfig("gat", GATConfig(), num_updates=20),
}
"""What `garat ground` learns from recordings with."""
