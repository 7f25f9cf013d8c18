"""A user's task is checked when its world is made, and an action when it is taken."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

from garat_jax.env import make_world
from garat_jax.errors import UserError
from tests import models
from tests.probe_envs import Hang


@pytest.fixture
def arm(tmp_path):
    (tmp_path / "arm.xml").write_text(models.ARM)
    return tmp_path / "arm.xml"


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"num_substeps": 0}, r"Hang\.num_substeps is 0; expected a whole number from 1"),
        ({"num_substeps": 1.5}, r"Hang\.num_substeps is 1\.5; expected a whole number from 1"),
        ({"episode_length": 0}, r"Hang\.episode_length is 0; expected a whole number from 1"),
    ],
)
def test_lengths_are_whole_numbers_from_1(arm, settings, said):
    with pytest.raises(UserError, match=said):
        make_world(dataclasses.replace(Hang(arm), **settings), engine="mujoco")


@pytest.mark.parametrize(
    ("method", "returned", "said"),
    [
        ("initial", (jnp.zeros(3), jnp.zeros(2)), r"qpos of Task\.initial has the shape \(3,\); "),
        ("initial", (jnp.zeros(2), jnp.zeros(())), r"qvel of Task\.initial has the shape \(\); "),
        ("initial", jnp.zeros(4), r"Task\.initial returns ShapeDtypeStruct; expected \(qpos, qv"),
        ("observe", jnp.zeros(()), r"Task\.observe returns has the shape \(\); expected \(obs_siz"),
        ("reward", jnp.zeros(2), r"Task\.reward returns has the shape \(2,\); expected \(\)"),
        ("terminated", jnp.zeros(2, bool), r"Task\.terminated returns has the shape \(2,\); exp"),
    ],
)
def test_what_a_task_returns_is_checked(arm, method, returned, said):
    wrong = type("Task", (Hang,), {method: lambda self, *_: returned})
    with pytest.raises(UserError, match=said):
        make_world(wrong(arm), engine="mujoco")


def test_numbers_will_do_for_rewards_and_ends(arm):
    plain = type("Plain", (Hang,), {"reward": lambda *_: 1.0, "terminated": lambda *_: False})
    assert make_world(plain(arm), engine="mujoco").env.obs_size == 4


def test_an_action_of_another_size_is_refused(arm):
    world = make_world(Hang(arm), engine="mujoco")
    state = world.env.reset(world.params, jax.random.key(0))
    with pytest.raises(UserError, match=r"the action has the shape \(3,\); expected \(2,\)"):
        world.env.step(world.params, state, jnp.zeros(3), jax.random.key(0))
