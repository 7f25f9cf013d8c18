"""Pairs of a source and a target world: Desai et al. 2020, table of modified environments."""

import numpy as np

from garat_jax.agents.trpo import TRPOConfig
from garat_jax.dynamics import Override
from garat_jax.envs.ant import Ant
from garat_jax.envs.half_cheetah import HalfCheetah
from garat_jax.envs.hopper import Hopper
from garat_jax.envs.inverted_pendulum import InvertedPendulum
from garat_jax.envs.minitaur import Minitaur
from garat_jax.envs.minitaur_motors import SaturatedMotors
from garat_jax.envs.walker2d import Walker2d
from garat_jax.transfer import Pair


def cheetah_of_mass(total: float) -> tuple[Override, ...]:
    """Return overrides that scale every body of HalfCheetah, so that it weighs `total` kg."""
    masses = {  # kg, in a robot of 14 kg: Gymnasium's model as compiled
        "torso": 6.2502092,
        "back_thigh": 1.5435146,
        "back_shin": 1.5874477,
        "back_foot": 1.0953975,
        "front_thigh": 1.4380753,
        "front_shin": 1.2008368,
        "front_foot": 0.8845188,
    }
    scale = total / sum(masses.values())
    return tuple(Override("body", name, "mass", mass * scale) for name, mass in masses.items())


PAIRS: dict[str, Pair] = {
    "inverted_pendulum_heavy": Pair(
        name="inverted_pendulum_heavy",
        summary="InvertedPendulum whose pole weighs 100 kg instead of 4.89 kg",
        task=InvertedPendulum(),
        source=(Override("body", "pole", "mass", 4.89),),
        target=(Override("body", "pole", "mass", 100.0),),
    ),
    "hopper_heavy": Pair(
        name="hopper_heavy",
        summary="Hopper whose torso weighs 6 kg instead of 3.53 kg",
        task=Hopper(),
        source=(Override("body", "torso", "mass", 3.53),),
        target=(Override("body", "torso", "mass", 6.0),),
    ),
    "hopper_high_friction": Pair(
        name="hopper_high_friction",
        summary="Hopper whose foot has a coefficient of friction of 2.2 instead of 2",
        task=Hopper(),
        source=(Override("geom", "foot", "friction", 2.0),),
        target=(Override("geom", "foot", "friction", 2.2),),
    ),
    "half_cheetah_heavy": Pair(
        name="half_cheetah_heavy",
        summary="HalfCheetah that weighs 20 kg instead of 14 kg",
        task=HalfCheetah(),
        source=cheetah_of_mass(14.0),
        target=cheetah_of_mass(20.0),
    ),
    "walker_heavy": Pair(
        name="walker_heavy",
        summary="Walker2d whose torso weighs 10 kg instead of 3.534 kg",
        task=Walker2d(),
        source=(Override("body", "torso", "mass", 3.534),),
        target=(Override("body", "torso", "mass", 10.0),),
    ),
    "ant": Pair(
        name="ant",
        summary="Ant under a gravity of 9.81 m/s² instead of 4.91 m/s²",
        task=Ant(),
        source=(Override("option", "", "gravity", np.asarray([0.0, 0.0, -4.91])),),
        target=(Override("option", "", "gravity", np.asarray([0.0, 0.0, -9.81])),),
        agent=TRPOConfig().averaged(8),  # over the motors
        max_iterations=1200,  # as benchmarks/learning.py found
    ),
    "minitaur": Pair(
        name="minitaur",
        summary="Minitaur whose motors' torque saturates with the current instead of following it",
        task=Minitaur(),
        source=(),
        target=(),
        target_effects=(SaturatedMotors("all"),),
    ),
}
