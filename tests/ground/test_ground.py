"""Grounding on measurements: what is learned from, and that it reaches the table of `compare`."""

import dataclasses
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from garat_jax import cli, presets
from garat_jax.diagnosis import compare, load_model
from garat_jax.diagnosis.compare import read_recordings
from garat_jax.diagnosis.hidden import make_recordings
from garat_jax.diagnosis.replay import replay
from garat_jax.effects import CATALOGUE
from garat_jax.errors import UserError
from garat_jax.ground import GroundConfig, ground, learn, load_grounded
from garat_jax.ground.learn import Best
from garat_jax.ground.run import load_policy
from garat_jax.ground.source import make_source, with_transformer
from garat_jax.ground.steps import choose_bounds, control_steps, draw
from garat_jax.methods.garat import GARATConfig
from garat_jax.methods.gat import GATConfig
from garat_jax.methods.make import make_method
from garat_jax.methods.recorded import as_transitions, clone, cloned
from garat_jax.runs import RunDirectory
from tests import models
from tests.probe_envs import Hang

SMALL = GroundConfig(
    "gat", GATConfig(num_envs=16, num_steps=25), num_updates=3, num_transitions=300, num_held_out=50
)


def test_the_source_begins_where_the_sensors_reported_it(read):
    model, recordings = read
    offset = CATALOGUE["encoder_offset"](target="joint/hinge", offset=0.3)
    bounds = choose_bounds(model, recordings)
    steps = control_steps(recordings, bounds.interval)
    noise = np.asarray([1e-3, 1e-2])
    env, world = make_source(
        dataclasses.replace(model, effects=(offset,)), steps.state, noise, bounds, 0.5
    )
    state = env.at(world, jnp.asarray(steps.state[7]))
    np.testing.assert_allclose(state.obs, steps.state[7], atol=1e-6)
    np.testing.assert_allclose(state.physics.qpos, steps.state[7, :1] - 0.3, atol=1e-6)
    keys = jax.random.split(jax.random.key(0), 2000)
    obs = np.asarray(jax.vmap(env.reset, (None, 0))(world, keys).obs)
    nearest = np.abs(obs[:, None] - steps.state).min(axis=1)
    assert (nearest < 5 * noise).all()
    assert env.episode_length == 31


def test_a_transform_acts_before_the_model_as_its_equal_effect(read, recorded):
    model, recordings = read
    torque = recorded[2]
    effect = CATALOGUE["torque_offset"](target="joint/hinge", torque=torque)
    shifted = dataclasses.replace(model, transform=lambda state, command: command + torque)
    by_effect = dataclasses.replace(model, effects=(effect,))
    horizons = {0.5: range(len(recordings))}
    (one,), (other,) = (replay(m, recordings, horizons) for m in (shifted, by_effect))
    np.testing.assert_allclose(one.predicted, other.predicted, atol=1e-5)
    found = compare(model, recordings, also=[shifted])
    assert found.also[0].error < 0.5 * found.error.before
    assert len(found.plot().data) == 2


def test_models_of_other_machines_are_not_compared(read, tmp_path):
    arm = tmp_path / "arm.xml"
    arm.write_text(models.ARM)
    with pytest.raises(UserError, match=r"its joints are shoulder, elbow, those of .* hinge"):
        compare(*read, also=[load_model(arm)])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = 1", "holds no policy; expected a function policy"),
        ("def policy(obs, key): return obs", r"expected an array of 1 command, shape \(1,\)"),
        ("def policy(obs, key): return obs[9:].nothing", "AttributeError"),
        ("def policy(obs", "line 1: SyntaxError"),
        ("x = 1\n\0", r"mine.py: SyntaxError: source code .* null bytes"),
        ("def policy(obs, key):\n    return [float(obs[0])]", "line 2: .* Concretization"),
        ("def policy(obs, key):\n    return obs[:1] if obs[0] > 0 else 0", "line 2: .* jnp.where"),
        (
            "def policy(obs, key): return obs[:1] / (obs[0] < 9)",
            r"mine.py: policy\(obs, key\) returns \[inf\] at 0.096 s of hand.csv, where obs is "
            r"\[9.0, 0.0\]",
        ),
    ],
)
def test_a_wrong_policy_is_refused(read, tmp_path, text, message):
    (tmp_path / "mine.py").write_text(text)
    model, (recording, *_) = read
    qpos = np.where(np.arange(len(recording.time))[:, None] == 12, 9.0, 0.0)
    moved = dataclasses.replace(recording, name="hand.csv", qpos=qpos, qvel=np.zeros_like(qpos))
    with pytest.raises(UserError, match=message):
        load_policy(tmp_path / "mine.py", model, [moved])


@pytest.fixture(scope="module")
def grounded(recorded, tmp_path_factory):
    """A run of `garat ground` with few updates; its actor is a policy in a file."""
    folder = tmp_path_factory.mktemp("grounded")
    policy = folder / "mine.py"
    policy.write_text(
        "import jax.numpy as jnp\ndef policy(obs, key): return jnp.sin(9 * obs[:1])\n"
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(presets.GROUNDING, "gat", SMALL)
        assert cli.main(command(recorded, folder / "gat")) == 0
    return folder / "gat"


def command(recorded, out) -> list[str]:
    names = [str(file) for file in recorded[1]]
    acting = ["--policy", str(out.parent / "mine.py")]
    return ["ground", str(recorded[0]), *names, *acting, "--out", str(out)]


def test_a_run_does_not_go_on_with_other_recordings(recorded, grounded, monkeypatch, capsys):
    monkeypatch.setitem(presets.GROUNDING, "gat", SMALL)
    file = recorded[1][0]
    text = file.read_text()
    try:
        file.write_text(text.rstrip().rpartition("\n")[0] + "\n")
        assert cli.main([*command(recorded, grounded), "--resume"]) == 2
    finally:
        file.write_text(text)
    said = capsys.readouterr().err
    assert f"{grounded} was started with settings.contents.{file} = " in said


def test_a_run_holds_what_scripts_read(grounded):
    summary = json.loads((grounded / "summary.json").read_text())
    assert (summary["data"], summary["holdout"]) == (
        ["recording_0.csv", "recording_1.csv"],
        ["recording_2.csv"],
    )
    assert (summary["policy"], summary["warnings"]) == ("given", [])
    found = json.loads((grounded / "compare.json").read_text())
    assert found["also"][0]["error"] == summary["error"]["grounded"]
    assert len((grounded / "metrics.jsonl").read_text().splitlines()) == SMALL.num_updates
    page = (grounded / "report.html").read_text()
    assert "With the action transformer the held-out error" in page
    assert "One control step at a time" in page


def test_the_update_that_strays_least_is_taken(grounded):
    summary = json.loads((grounded / "summary.json").read_text())
    chosen = summary["chosen"]
    lines = [json.loads(line) for line in (grounded / "metrics.jsonl").read_text().splitlines()]
    errors = [chosen["path_error_of_model"], *(line["path_error"][0] for line in lines)]
    assert chosen["update"] == np.argmin(errors) > 0
    assert chosen["path_error"] == pytest.approx(min(errors))
    assert summary["transition_error"]["grounded"] == lines[chosen["update"] - 1]["error"][0]


def test_the_best_of_the_updates_stays():
    best = Best(0, {"w": jnp.zeros(2)}, jnp.asarray(5.0), jnp.asarray(0), jnp.asarray(0))
    for number, error in enumerate([6.0, 2.0, 3.0], start=1):
        best = best.after(number, {"w": jnp.full(2, 1.0 * number)}, jnp.asarray(error))
    assert (best.state, best.error, best.update, best.updates) == (3, 2.0, 2, 3)
    np.testing.assert_array_equal(best.transformer["w"], [2.0, 2.0])


def test_a_transformer_that_is_worse_than_none_is_not_taken(read, tmp_path):
    untrained = dataclasses.replace(
        SMALL, num_updates=1, learner=dataclasses.replace(SMALL.learner, learning_rate=0.0)
    )
    run = RunDirectory.create(tmp_path, {}, "test", [0])
    done = ground(*read, untrained, run)
    assert done.model.transform is None
    assert done.summary["chosen"]["update"] == 0
    assert "which stays as it is" in done.sentence
    assert done.comparison.also[0].error == done.comparison.error.before


def test_paths_of_an_only_recording_are_as_dense_as_what_is_learned_from(
    read, tmp_path, monkeypatch
):
    model, (recording, *_) = read
    count = 3000  # of which 2000 are learned from
    rows = np.arange(count) % len(recording.time)
    columns = {name: getattr(recording, name)[rows] for name in ("qpos", "qvel", "ctrl")}
    time = 0.008 * np.arange(count)
    only = dataclasses.replace(recording, time=time, spans=((0, count),), **columns)

    def stop(recordings, interval, length, every):
        raise RuntimeError(f"{recordings[0].spans} every {every}")

    monkeypatch.setattr(learn, "control_paths", stop)
    with pytest.raises(RuntimeError, match=r"\(\(0, 2000\),\) every 2"):
        ground(model, [only], SMALL, RunDirectory.create(tmp_path, {}, "test", [0]))


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (
            {"error": {"grounded": 0.2, "model": 0.1}},
            "rises from 10 % to 20 %; the model is better",
        ),
        ({"chosen": {"update": 0}}, "no action transformer was better than none"),
        ({}, ""),
    ],
)
def test_reading_a_run_says_when_the_model_is_better_without(grounded, tmp_path, changed, said):
    root = shutil.copytree(grounded, tmp_path / "run")
    summary = json.loads((root / "summary.json").read_text())
    summary["error"] = {"grounded": 0.1, "model": 0.2}
    (root / "summary.json").write_text(json.dumps(summary | changed))
    lines = []
    model = load_grounded(root, {"gat": SMALL}, say=lines.append)
    assert (model.transform is None) == ("chosen" in changed)
    assert len(lines) == bool(said)
    assert said in "".join(lines)


def test_a_run_of_another_version_is_refused(grounded, tmp_path):
    root = shutil.copytree(grounded, tmp_path / "run")
    summary = json.loads((root / "summary.json").read_text())
    (root / "summary.json").write_text(json.dumps(summary | {"format": "garat-ground/1"}))
    with pytest.raises(UserError, match="written by another version"):
        load_grounded(root, {"gat": SMALL})


def test_a_run_made_with_other_settings_is_refused(grounded, tmp_path):
    other = dataclasses.replace(SMALL, learner=dataclasses.replace(SMALL.learner, num_epochs=7))
    with pytest.raises(UserError, match=r"was made with num_epochs = 10, here it is 7: ground the"):
        load_grounded(grounded, {"gat": other})
    root = shutil.copytree(grounded, tmp_path / "run")
    summary = json.loads((root / "summary.json").read_text())
    del summary["learner"]  # as in older runs
    (root / "summary.json").write_text(json.dumps(summary))
    load_grounded(root, {"gat": other})


def test_a_run_is_read_back(grounded):
    model = load_grounded(grounded, {"gat": SMALL})
    assert model.transform is not None
    control = json.loads((grounded / "summary.json").read_text())["control"]
    state, command = jnp.asarray([0.3, -1.0]), jnp.asarray([0.2])
    sent = model.transform(state, command)
    assert sent.shape == (1,)
    assert control["low"][0] <= sent[0] <= control["high"][0]
    assert sent[0] != command[0]


def hang(mjcf) -> Hang:
    """Return a task whose control steps last as long as those of the grounding, 0.016 s."""
    return dataclasses.replace(Hang(mjcf), num_substeps=8)


def test_a_task_in_a_grounded_model_sends_what_the_transformer_makes(recorded, grounded):
    model, task = load_grounded(grounded, {"gat": SMALL}), hang(recorded[0])
    assert model.transform is not None
    world, plain = model.world(task), dataclasses.replace(model, transform=None).world(task)
    state = world.env.reset(world.params, jax.random.key(0))
    action = jnp.asarray([0.2])
    sent = world.env.clip(model.transform(state.obs, action))
    assert abs(sent[0] - action[0]) > 1e-3
    grounded_step, step = (
        w.env.step(w.params, state, a, jax.random.key(0))
        for w, a in ((world, action), (plain, sent))
    )
    np.testing.assert_allclose(grounded_step.state.obs, step.state.obs, rtol=1e-6)
    np.testing.assert_allclose(grounded_step.reward, action[0])


def test_a_model_that_was_compared_can_be_trained_in(recorded, grounded):
    model, bare = load_grounded(grounded, {"gat": SMALL}), load_model(recorded[0])
    compare(bare, read_recordings(bare, recorded[1][-1:]), also=[model])  # in double precision
    world = model.world(hang(recorded[0]))
    state = world.env.reset(world.params, jax.random.key(0))
    step = jax.jit(world.env.step)(world.params, state, jnp.ones(1), jax.random.key(0))
    assert step.state.obs.dtype == jnp.float32


@pytest.mark.parametrize("learner", [SMALL.learner, GARATConfig(), GARATConfig(output="absolute")])
def test_a_transformer_is_used_in_either_precision(read, learner):
    model, recordings = read
    bounds = choose_bounds(model, recordings)
    steps = draw(control_steps(recordings, bounds.interval), 20, np.random.default_rng(0))
    env, world = make_source(model, steps.state, np.zeros(2), bounds, episode=0.1)
    method = make_method(env, cloned(env), learner)
    learned = method.init(
        jax.random.key(0), world, clone(env, steps), as_transitions(env, steps)
    ).transformer.policy
    transform = with_transformer(method, env, learned)
    with jax.enable_x64(True):
        double = jax.jit(transform)(jnp.full(2, 0.1), jnp.full(1, 0.2))
    single = jax.jit(transform)(jnp.full(2, 0.1), jnp.full(1, 0.2))
    assert (double.dtype, single.dtype) == (jnp.float64, jnp.float32)
    np.testing.assert_allclose(single, double, rtol=1e-5)


def test_a_task_with_other_control_steps_is_refused(recorded, grounded):
    model, task = load_grounded(grounded, {"gat": SMALL}), hang(recorded[0])
    slower = dataclasses.replace(task, num_substeps=5 * task.num_substeps)
    with pytest.raises(UserError, match=r"learned on control steps of .* the task's last"):
        model.world(slower)


def test_a_task_for_another_machine_is_refused(grounded, tmp_path):
    (tmp_path / "arm.xml").write_text(models.ARM)
    model = load_grounded(grounded, {"gat": SMALL})
    with pytest.raises(UserError, match=r"its joints are hinge, those of .* shoulder, elbow"):
        model.world(Hang(tmp_path / "arm.xml"))


@pytest.mark.slow
def test_grounding_reaches_the_table_of_compare(recorded, grounded, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(presets.GROUNDING, "gat", SMALL)
    model, files, torque = recorded
    card = model.parent / "repaired.toml"
    card.write_text(
        f'format = "garat-model/1"\nmjcf = "{model.name}"\n[[effect]]\nkind = "torque_offset"\n'
        f'target = "joint/hinge"\nparameters = {{ torque = {torque} }}\n'
    )
    out = tmp_path / "compare"
    others = ["--also", str(card), "--grounded", str(grounded), "--out", str(out)]
    assert cli.main(["compare", str(model), str(files[-1]), *others]) == 0
    content = json.loads((out / "compare.json").read_text())
    repaired, other = content["also"]
    assert (repaired["model"], other["model"]) == (str(card), str(grounded))
    assert repaired["error"] < 0.5 * content["error"]["before"]
    summary = json.loads((grounded / "summary.json").read_text())
    assert other["error"] == pytest.approx(summary["error"]["grounded"], rel=1e-6)
    assert "Models side by side" in (out / "report.html").read_text()
    assert f"{grounded}\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["compare", "{model}", "{data}", "--grounded", "nowhere"], "nowhere holds no run"),
        (["compare", "{model}", "{data}", "--also", "no.toml"], "--also: there is no file no.toml"),
        (["ground", "{model}", "{data}", "--method", "gad"], "did you mean gat"),
        (["ground", "{model}", "{data}", "--policy", "no.py"], "--policy: there is no file no.py"),
    ],
)
def test_a_users_mistake_is_one_line(recorded, tmp_path, monkeypatch, capsys, arguments, parts):
    monkeypatch.chdir(tmp_path)
    filled = [a.format(model=recorded[0], data=recorded[1][0]) for a in arguments]
    assert cli.main(filled) == 2
    assert parts in capsys.readouterr().err
    assert not (tmp_path / "runs").exists() or not list((tmp_path / "runs").iterdir())


def test_a_run_of_another_kind_is_no_grounded_model(recorded, tmp_path, capsys):
    RunDirectory.create(tmp_path / "run", {}, "garat transfer", [0])
    command = ["compare", str(recorded[0]), str(recorded[1][0]), "--grounded"]
    assert cli.main([*command, str(tmp_path / "run")]) == 2
    assert "holds no action transformer; expected a run of garat ground" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("method", presets.GROUNDING)
def test_hidden_friction_is_learned_in_part(method, tmp_path):
    path = tmp_path / "pendulum.xml"
    path.write_text(models.PENDULUM)
    made = make_recordings(path, tmp_path / "data", 0, kind="coulomb_friction")
    model = load_model(path)
    fit, holdout = (read_recordings(model, files) for files in (made.fit, made.holdout))
    run = RunDirectory.create(tmp_path / "run", {}, "test", [0])
    done = ground(model, fit, presets.GROUNDING[method], run, holdout=holdout)
    assert done.comparison.also[0].error < 0.9 * done.comparison.error.before
