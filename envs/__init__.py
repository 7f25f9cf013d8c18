"""Content: the tasks that there are. Algorithms are in the library, which never imports this."""

from garat_jax.env import Task
from garat_jax.envs.ant import Ant
from garat_jax.envs.half_cheetah import HalfCheetah
from garat_jax.envs.hopper import Hopper
from garat_jax.envs.inverted_pendulum import InvertedPendulum
from garat_jax.envs.minitaur import Minitaur
from garat_jax.envs.walker2d import Walker2d

ENVS: dict[str, type[Task]] = {
    "inverted_pendulum": InvertedPendulum,
    "hopper": Hopper,
    "half_cheetah": HalfCheetah,
    "walker2d": Walker2d,
    "ant": Ant,
    "minitaur": Minitaur,
}
