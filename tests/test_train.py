"""The host loop with tiny learners: resume, stop on NaN, stop when solved, compiler options."""

import dataclasses
import os
import shutil
import signal
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from garat_jax import checkpoint, compiler_options, train
from garat_jax.agents import ppo
from garat_jax.dynamics import Override
from garat_jax.effects import Backlash
from garat_jax.env import make_world
from garat_jax.envs.half_cheetah import HalfCheetah
from garat_jax.envs.inverted_pendulum import InvertedPendulum
from garat_jax.errors import DivergedError, UserError
from garat_jax.runs import RunDirectory
from garat_jax.train import Trainer, UntilSolved

SEEDS = [7, 8]


class Interrupting(RunDirectory):
    """A run that is interrupted once: before or after the metrics of a step are written."""

    interrupt_at = 3
    metrics_first = True

    def log(self, step, **metrics):
        if self.metrics_first or step != self.interrupt_at:
            super().log(step, **metrics)
        if step == self.interrupt_at:
            raise KeyboardInterrupt


class InterruptedEarly(Interrupting):
    metrics_first = False


def directory(path, cls=RunDirectory, resume=False):
    return cls.create(path, {"what": "test"}, "garat test", SEEDS, resume=resume)


def trainer(run: RunDirectory) -> Trainer:
    return Trainer(run, SEEDS, console=Console(quiet=True))


def learner():
    """Return a random walk's step and start, one walker a seed."""

    def step(state, params):
        position, key = state
        key, draw = jax.random.split(key)
        position = position * 0.9 + params * jax.random.normal(draw, position.shape)
        return (position, key), {"mean": position.mean()}

    keys = jax.vmap(jax.random.key)(jnp.asarray(SEEDS))
    return jax.vmap(step, (0, None)), (jnp.zeros((2, 3)), keys)


def lines(run: RunDirectory) -> list:
    return list(run.metrics())


def assert_same_state(one, other):
    jax.tree.map(
        np.testing.assert_array_equal, (one[0], *map(jax.random.key_data, one[1:])),
        (other[0], *map(jax.random.key_data, other[1:])),
    )  # fmt: skip


@pytest.mark.parametrize("kind", [Interrupting, InterruptedEarly])
def test_interrupted_and_resumed_is_uninterrupted_bit_for_bit(tmp_path, kind):
    step, start = learner()
    whole = directory(tmp_path / "whole")
    expected = trainer(whole).train("walk", step, start, 0.1, 6)

    with pytest.raises(KeyboardInterrupt):
        trainer(directory(tmp_path / "cut", kind)).train("walk", step, start, 0.1, 6)
    cut = directory(tmp_path / "cut", resume=True)
    assert checkpoint.latest_step(cut.path("checkpoints/walk")) == 2
    resumed = trainer(cut).train("walk", step, start, 0.1, 6)

    assert_same_state(resumed, expected)
    assert lines(cut) == lines(whole)
    assert [line["step"] for line in lines(whole)] == [1, 2, 3, 4, 5, 6]
    assert all(len(line["mean"]) == 2 for line in lines(whole))


class Pressed(RunDirectory):
    """A run in whose second iteration somebody presses Ctrl-C."""

    def log(self, step, **metrics):
        super().log(step, **metrics)
        if step == 2:
            os.kill(os.getpid(), signal.SIGINT)


def test_interrupted_as_it_is_finished_a_stage_is_over(tmp_path):
    walk, start = learner()

    def counted(state, params):
        (position, key), metrics = walk(state[:2], params)
        count = state[2] + 1
        return (position, key, count), metrics | {"finished": count == 2}

    begin = (*start, jnp.zeros(2, int))
    with pytest.raises(KeyboardInterrupt):
        trainer(directory(tmp_path / "run", Pressed)).train("walk", counted, begin, 0.1, 9)
    resumed = directory(tmp_path / "run", resume=True)
    trainer(resumed).train("walk", counted, begin, 0.1, 9)
    assert [line["step"] for line in lines(resumed)] == [1, 2]


def test_a_stage_that_is_over_is_not_run_again(tmp_path):
    step, start = learner()
    first = trainer(directory(tmp_path / "run")).train("walk", step, start, 0.1, 3)

    def never(state, params):
        raise AssertionError("the stage was over")

    again = directory(tmp_path / "run", resume=True)
    assert_same_state(trainer(again).train("walk", never, start, 0.1, 3), first)
    assert len(lines(again)) == 3


def test_a_run_directory_is_used_once(tmp_path):
    step, start = learner()
    whole, cut = directory(tmp_path / "whole"), directory(tmp_path / "cut", Interrupting)
    trainer(whole).train("walk", step, start, 0.1, 3)
    with pytest.raises(KeyboardInterrupt):
        trainer(cut).train("walk", step, start, 0.1, 6)
    for run in (whole, cut):
        before = lines(run)
        with pytest.raises(UserError, match=r"holds 'walk' already: .* resume=True"):
            trainer(run).train("walk", step, start, 0.1, 3)
        assert lines(run) == before


def test_a_stage_without_iterations_is_over_at_its_start(tmp_path):
    step, start = learner()
    for resume in (False, True):
        run = directory(tmp_path / "run", resume=resume)
        assert_same_state(trainer(run).train("walk", step, start, 0.1, 0), start)


def test_stages_keep_apart_what_they_leave(tmp_path):
    step, start = learner()
    loop = trainer(directory(tmp_path / "run"))
    state = loop.train("first", step, start, 0.1, 2)
    loop.train("second", step, state, 0.1, 1)
    assert [(x["stage"], x["step"]) for x in lines(loop.run)] == [
        ("first", 1), ("first", 2), ("second", 1),
    ]  # fmt: skip
    assert_same_state(checkpoint.restore(loop.run.path("checkpoints/first"), start), state)
    assert loop.seconds.compile > 0
    assert loop.seconds.run > 0


def diverging():
    """Return a step in which the second learner becomes NaN at its third iteration."""

    def step(state, params):
        del params
        count, weights = state["count"] + 1, state["weights"] + 0.5
        bad = (count == 3) & (state["seed"] == SEEDS[1])
        weights = jnp.where(bad, jnp.nan, weights)
        return state | {"count": count, "weights": weights}, {"loss": weights.sum()}

    start = {
        "seed": jnp.asarray(SEEDS),
        "count": jnp.zeros(2, jnp.int32),
        "weights": jnp.zeros((2, 3)),
        "key": jax.vmap(jax.random.key)(jnp.asarray(SEEDS)),
    }
    return jax.vmap(step, (0, None)), start


def test_nan_stops_the_run_and_says_where(tmp_path):
    step, start = diverging()
    run = directory(tmp_path / "run")
    with pytest.raises(DivergedError) as error:
        trainer(run).train("fall", step, start, None, 10)
    message = str(error.value)
    assert "seed 8" in message
    assert "iteration 3" in message
    assert "seed 7" not in message

    folder = run.path("checkpoints/fall")
    assert checkpoint.latest_step(folder) == 2
    np.testing.assert_array_equal(checkpoint.restore(folder, start)["weights"], np.full((2, 3), 1))
    with np.load(run.root / "diverged" / "fall-3.npz", allow_pickle=False) as offending:
        weights = offending["['weights']"]
    assert np.isnan(weights[1]).all()
    np.testing.assert_array_equal(weights[0], [1.5, 1.5, 1.5])
    assert str(run.root / "diverged" / "fall-3.npz") in message
    assert [line["step"] for line in lines(run)] == [1, 2]


def failing_worlds(shares):
    """Return a learner whose worlds fail in the given share of steps at each iteration."""

    def step(count, params):
        del params
        return count + 1, {"faulty_share": jnp.asarray(shares)[count]}

    return jax.vmap(step, (0, None)), jnp.zeros(2, jnp.int32)


def test_few_failures_of_physics_are_told_and_many_stop_the_run(tmp_path, capsys):
    step, start = failing_worlds([0.0, 0.005, 0.02])
    loop = Trainer(directory(tmp_path / "run"), SEEDS)
    with pytest.raises(DivergedError, match=r"seed 7, 8 saw physics .* 2 % .* iteration 3"):
        loop.train("worlds", step, start, None, 10)
    told = " ".join(capsys.readouterr().err.split())
    assert "warning: physics left the finite numbers in 0.5 % of the steps of iteration 2" in told
    assert checkpoint.latest_step(loop.run.path("checkpoints/worlds")) == 2


def test_failures_outside_of_a_stage_are_told_and_many_stop_the_run(tmp_path, capsys):
    loop = Trainer(directory(tmp_path / "run"), SEEDS)
    loop.check_faults("evaluation", np.zeros(2))
    assert capsys.readouterr().err == ""
    loop.check_faults("evaluation", np.asarray([0.0, 0.004]))
    told = " ".join(capsys.readouterr().err.split())
    assert "evaluation: warning: physics left the finite numbers in 0.4 % of the steps" in told
    with pytest.raises(DivergedError, match=r"evaluation: seed 8 saw physics leave .* in 2 %"):
        loop.check_faults("evaluation", np.asarray([0.0, 0.02]))


ENGINES = pytest.mark.parametrize("engine", ["mujoco", pytest.param("mjx", marks=pytest.mark.slow)])


def pendulums(engine: str, gear: float):
    """Return `learners` on pendulums whose motor is so strong."""
    strong = Override("actuator", "slide", "gear", gear)
    return learners(make_world(InvertedPendulum(), (strong,), engine=engine))


def learners(world):
    """Return a step and a start of PPO in a world, and its params."""
    agent = ppo.make(world.env, ppo.PPOConfig(num_envs=4, num_steps=8, hidden=(8,)))
    keys = jax.vmap(jax.random.key)(jnp.asarray(SEEDS))
    start = jax.vmap(lambda key: agent.init(key, world.params))(keys)
    step = jax.vmap(lambda state, params: agent.step(state, params)[:2], (0, None))
    return step, start, world.params


@ENGINES
def test_a_world_that_fails_once_ends_its_episode_and_training_goes_on(
    tmp_path, capsys, engine, monkeypatch
):
    monkeypatch.setattr(train, "LARGEST_FAULTY_SHARE", 0.1)
    step, start, params = pendulums(engine, 100.0)
    lost = start.env.physics.qvel.at[0, 2, 1].set(jnp.nan)  # one of the first seed's four
    start = start._replace(env=start.env._replace(physics=start.env.physics._replace(qvel=lost)))
    run = directory(tmp_path / "run")
    state = Trainer(run, SEEDS).train("once", step, start, params, 2)
    assert [line["faulty_share"] for line in run.metrics()] == [[1 / 32, 0.0], [0.0, 0.0]]
    assert "left the finite numbers in 3.1 % of the steps of iteration 1" in " ".join(
        capsys.readouterr().err.split()
    )
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((state.env.obs, state.policy)))


def test_episodes_that_begin_with_a_motor_apart_from_its_joint_are_no_failure(tmp_path):
    task = dataclasses.replace(HalfCheetah(), episode_length=4)  # a batch ends with a reset
    world = make_world(task, effects=(Backlash("joint/back_hip", gap=0.01),), engine="mujoco")
    step, start, params = learners(world)
    run = directory(tmp_path / "run")
    Trainer(run, SEEDS).train("play", step, start, params, 2)
    assert [line["faulty_share"] for line in run.metrics()] == [[0.0, 0.0]] * 2


@ENGINES
def test_the_step_in_which_physics_failed_is_left_as_it_was(tmp_path, engine):
    step, start, params = pendulums(engine, 1e13)
    run = directory(tmp_path / "run")
    with pytest.raises(DivergedError):
        trainer(run).train("burst", step, start, params, 5)
    with np.load(run.root / "diverged" / "burst-1.npz", allow_pickle=False) as kept:
        assert (kept[".fault.num_steps"] > 0).all()
        before, after = kept[".fault.before.physics.qpos"], kept[".fault.after.physics.qvel"]
        action = kept[".fault.action"]
    assert before.shape == (2, 2)
    assert np.abs(before).max() < 1
    assert not (np.abs(after) < 1e10).all(axis=1).any()
    assert np.abs(action).min() > 0


def test_the_time_of_a_resumed_run_counts_the_processes_before(tmp_path):
    step, start = learner()
    first = trainer(directory(tmp_path / "run"))
    first.train("walk", step, start, 0.1, 3)
    second = trainer(directory(tmp_path / "run", resume=True))
    assert second.seconds == first.seconds
    second.train("more", step, start, 0.1, 3)
    assert second.seconds.run > first.seconds.run
    assert second.seconds.compile > first.seconds.compile


class Copied(RunDirectory):
    """A run of which a copy is made in the middle of a stage: what SIGKILL would leave."""

    def log(self, step, **metrics):
        super().log(step, **metrics)
        if step == 3:
            shutil.copytree(self.root, self.root.parent / "killed")


def test_the_time_of_a_stage_that_was_killed_counts_up_to_its_checkpoint(tmp_path, monkeypatch):
    monkeypatch.setattr(train, "CHECKPOINT_SECONDS", 0.0)
    step, start = learner()
    began = time.monotonic()
    whole = trainer(directory(tmp_path / "whole", Copied))
    whole.train("walk", step, start, 0.1, 5)
    took = time.monotonic() - began
    killed = trainer(directory(tmp_path / "killed", resume=True)).seconds
    assert killed.compile == whole.seconds.compile > 0
    assert 0 < killed.run < whole.seconds.run < took - whole.seconds.compile  # and none twice


def test_a_metric_that_is_not_finite_stops_the_run_too(tmp_path):
    def step(state, params):
        return state + 1, {"loss": jnp.log(2.5 - state)}

    with pytest.raises(DivergedError, match=r"seed 7, 8 .* iteration 4"):
        trainer(directory(tmp_path / "run")).train("log", step, jnp.zeros(2), None, 10)


def climber(solved_return: float):
    """Return a learner whose score is its height, which goes up by 1 a step."""

    def step(height, params):
        return height + params, {"height": height + params}, "transitions"

    def evaluate(height, params, key, wanted):
        del params, key
        return jnp.where(wanted, height, 0.0), 0.0

    return jax.vmap(train.until_solved(step, evaluate, solved_return), (0, None))


def climbers(*heights: float) -> UntilSolved:
    count = len(heights)
    keys = jax.random.split(jax.random.key(0), count)
    return jax.vmap(UntilSolved.start)(jnp.asarray(heights), keys)


def test_a_seed_that_has_solved_its_task_stays_as_it_is(tmp_path):
    loop = trainer(directory(tmp_path / "run"))
    state = loop.train("climb", climber(3.0), climbers(0.0, 1.5), 1.0, 10)
    np.testing.assert_array_equal(state.state, [3.0, 3.5])  # not 4.5
    assert [line["finished"] for line in lines(loop.run)] == [
        [False, False], [False, True], [True, True],
    ]  # fmt: skip
    np.testing.assert_array_equal(state.score, [3.0, 3.5])


def test_without_a_solution_the_iterations_run_out(tmp_path):
    loop = trainer(directory(tmp_path / "run"))
    state = loop.train("climb", climber(99.0), climbers(0.0, 1.0), 1.0, 4)
    np.testing.assert_array_equal(state.state, [4.0, 5.0])
    assert not state.solved.any()


def test_options_reach_the_compiler(tmp_path):
    loop = trainer(directory(tmp_path / "run"))
    options = {compiler_options.OPTIMISATION_LEVEL: 1}
    assert loop.call(lambda x: x + 1, jnp.ones(3), options=options).sum() == 6
    with pytest.raises(jax.errors.JaxRuntimeError, match="no_such_option"):
        loop.call(lambda x: x + 1, jnp.ones(3), options={"no_such_option": True})


def test_a_step_that_is_thrown_away_stops_nothing():
    def step(height, params):
        fails = {"walk_faulty_share": jnp.asarray(0.5), "kl": jnp.asarray(jnp.nan)}
        return height + params, fails | {"reward": height}

    def evaluate(height, params, key, wanted):
        del params, key
        return jnp.where(wanted, height, 0.0), 0.0

    stepped = jax.vmap(train.until_solved(step, evaluate, 3.0), (0, None))
    carry = climbers(0.0, 9.0)._replace(solved=jnp.asarray([False, True]))
    carry, metrics = stepped(carry, 1.0)
    np.testing.assert_array_equal(carry.state, [1.0, 9.0])
    np.testing.assert_array_equal(metrics["walk_faulty_share"], [0.5, 0.0])
    np.testing.assert_array_equal(metrics["kl"], [np.nan, 0.0])
    np.testing.assert_array_equal(metrics["reward"], [0.0, 9.0])
