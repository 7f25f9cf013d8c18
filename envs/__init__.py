"""Content: the tasks that there are. Algorithms are in the library, which never imports this."""

from garat_jax.env import Task
from garat_jax.envs.inverted_pendulum import InvertedPendulum

ENVS: dict[str, type[Task]] = {
    "inverted_pendulum": InvertedPendulum,
}
