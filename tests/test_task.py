"""A user's task is checked when its world is made, and an action when it is taken."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from garat_jax import rollout
from garat_jax.env import Task, make_world
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


def test_a_task_whose_settings_cannot_be_written_down_is_refused(arm):
    methods = {name: vars(Hang)[name] for name in Task.__abstractmethods__}
    settings = {"mjcf": arm, "num_substeps": 1, "episode_length": 20, "solved_return": 1.0}
    plain = type("Plain", (Task,), methods | settings)
    with pytest.raises(UserError, match=r"Plain is a plain class, .* make it a dataclass"):
        make_world(plain(), engine="mujoco")


@pytest.mark.parametrize(
    ("method", "returned", "said"),
    [
        ("initial", (jnp.zeros(3), jnp.zeros(2)), r"qpos of Task\.initial has the shape \(3,\); "),
        ("initial", (jnp.zeros(2), jnp.zeros(())), r"qvel of Task\.initial has the shape \(\); "),
        ("initial", ([0.0, 0.0], [0.0, 0.0]), r"qpos of Task\.initial is a list; expected an arr"),
        ("observe", (jnp.zeros(2), jnp.zeros(2)), r"Task\.observe returns is a tuple; expected an"),
        (
            "reward",
            None,
            r"what Task\.reward returns is a NoneType; expected an array of shape \(\)",
        ),
        ("terminated", None, r"Task\.terminated returns is a NoneType; expected an array of sh"),
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
    plain = type("Plain", (Hang,), {"reward": lambda *_: 1, "terminated": lambda *_: False})
    world = make_world(plain(arm), engine="mujoco")

    def still(params, obs, key):
        return jnp.zeros(2), jnp.zeros(())

    returns, _ = rollout.evaluate(world.env, world.params, still, (), jax.random.key(0), 3)
    assert returns.tolist() == [20.0] * 3


@pytest.mark.parametrize("limits", ['ctrllimited="true" ctrlrange="-0.4 0.4"', ""])
def test_actions_may_be_whole_numbers_or_a_list(tmp_path, limits):
    (tmp_path / "arm.xml").write_text(re.sub("<(position|motor) ", rf"<\1 {limits} ", models.ARM))
    env = make_world(Hang(tmp_path / "arm.xml"), engine="mujoco").env
    most = 0.4 if limits else 1.0
    for action in (jnp.asarray([1, -1]), [1, -1], jnp.asarray([1, -1], jnp.bfloat16)):
        np.testing.assert_allclose(env.clip(action), [most, -most], rtol=1e-6)


def test_an_action_of_another_size_is_refused(arm):
    world = make_world(Hang(arm), engine="mujoco")
    state = world.env.reset(world.params, jax.random.key(0))
    with pytest.raises(UserError, match=r"the action has the shape \(3,\); expected \(2,\)"):
        world.env.step(world.params, state, jnp.zeros(3), jax.random.key(0))
