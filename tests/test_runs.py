import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest

from garat_jax.errors import UserError
from garat_jax.plain import to_plain
from garat_jax.provenance import git_state, provenance
from garat_jax.runs import RunDirectory, check_replaceable


@dataclasses.dataclass(frozen=True)
class Inner:
    rate: float = 3e-4


@dataclasses.dataclass(frozen=True)
class Config:
    layers: tuple[int, ...] = (64, 64)
    inner: Inner = Inner()
    asset: Path = Path("a/b.xml")


def create(path: Path, config=None, seeds=(0, 1), **options) -> RunDirectory:
    return RunDirectory.create(path, config or Config(), ["garat", "x"], seeds, **options)


def test_config_names_everything_that_decides_the_results(tmp_path):
    run = create(tmp_path / "deep" / "run")
    config = run.read_json("config.json")
    assert config["format"] == "garat-run/1"
    assert config["command"] == "garat x"
    assert config["config"] == {
        "layers": [64, 64],
        "inner": {"rate": 3e-4},
        "asset": str(Path("a/b.xml")),
    }
    assert config["seeds"] == [0, 1]
    for name in ("python", "jax", "mujoco", "mujoco-mjx", "brax", "orbax-checkpoint", "garat_jax"):
        assert config["versions"][name], name
    assert config["machine"]["cores"] >= 1
    assert config["machine"]["memory_gib"] > 0


def test_a_folder_that_is_not_empty_is_refused_in_one_line(tmp_path):
    create(tmp_path)
    with pytest.raises(UserError, match=r"--force.*--resume") as refusal:
        create(tmp_path)
    assert "\n" not in str(refusal.value)


def test_force_replaces_a_run(tmp_path):
    create(tmp_path).log(1, loss=1.0)
    run = create(tmp_path, seeds=[7], force=True)
    assert list(run.metrics()) == []
    assert run.read_json("config.json")["seeds"] == [7]


@pytest.mark.parametrize("content", ["{}", "no json", '{"format": "something-else/1"}', "[]"])
def test_force_leaves_a_folder_alone_that_is_no_run(tmp_path, content):
    (tmp_path / "config.json").write_text(content)
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(UserError, match="holds no run"):
        create(tmp_path, force=True)
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


def test_force_leaves_a_run_alone_to_which_a_user_has_added_a_file(tmp_path):
    run = create(tmp_path)
    run.log(1, loss=1.0)
    run.path("plots/loss.png").write_text("")
    (tmp_path / "thesis.tex").write_text("years of work")
    message = r"holds thesis\.tex, which the run in it did not write"
    with pytest.raises(UserError, match=message):
        create(tmp_path, force=True)
    with pytest.raises(UserError, match=message):
        check_replaceable(tmp_path)
    assert (tmp_path / "thesis.tex").read_text() == "years of work"
    assert len(list(run.metrics())) == 1


def test_force_leaves_alone_what_a_user_has_added_to_a_run_within_a_run(tmp_path):
    inner = create(create(tmp_path).path("part"))
    create(tmp_path, seeds=[7], force=True)
    inner = create(RunDirectory(tmp_path).path("part"))
    (inner.root / "thesis.tex").write_text("years of work")
    with pytest.raises(UserError, match=r"holds part/thesis\.tex"):
        create(tmp_path, force=True)


def test_force_leaves_a_run_alone_to_whose_folders_a_user_has_added_a_file(tmp_path):
    run = create(tmp_path)
    run.path("data/one.csv").write_text("")
    run.note_files()
    create(tmp_path, force=True).path("data/one.csv").write_text("")
    run.note_files()
    (tmp_path / "data" / "mine.csv").write_text("years of work")
    with pytest.raises(UserError, match=r"holds data/mine\.csv, which the run in it did not write"):
        create(tmp_path, force=True)
    assert (tmp_path / "data" / "mine.csv").exists()


def test_a_run_that_goes_on_may_write_more_files(tmp_path):
    create(tmp_path).note_files()
    run = create(tmp_path, resume=True)
    run.path("data/one.csv").write_text("")
    create(tmp_path, force=True)
    assert not (tmp_path / "data").exists()


def test_a_run_that_goes_on_does_not_take_a_users_files_for_its_own(tmp_path):
    run = create(tmp_path)
    run.path("data/one.csv").write_text("")
    run.note_files()
    (tmp_path / "data" / "mine.csv").write_text("years of work")
    create(tmp_path, resume=True).note_files()
    with pytest.raises(UserError, match=r"holds data/mine\.csv"):
        create(tmp_path, force=True)


def test_a_users_folder_is_seen_though_it_holds_no_file(tmp_path):
    create(tmp_path).note_files()
    (tmp_path / "paper").mkdir()
    with pytest.raises(UserError, match="holds paper"):
        create(tmp_path, force=True)


def test_a_run_that_did_not_note_what_it_wrote_is_replaced_as_a_whole(tmp_path):
    run = create(tmp_path)
    run.log(1, loss=1.0)
    (tmp_path / ".contents").unlink()
    create(tmp_path, resume=True).write_json("summary.json", {})
    assert not (tmp_path / ".contents").exists()
    assert list(create(tmp_path, force=True).metrics()) == []


def test_force_leaves_the_target_of_a_link_alone(tmp_path):
    create(tmp_path / "run")
    (tmp_path / "link").symlink_to(tmp_path / "run")
    with pytest.raises(UserError):
        create(tmp_path / "link", force=True)
    assert (tmp_path / "run" / "config.json").exists()


def test_force_leaves_the_current_folder_alone(tmp_path, monkeypatch):
    create(tmp_path / "run").path("deeper/x")
    monkeypatch.chdir(tmp_path / "run" / "deeper")
    with pytest.raises(UserError, match="current folder"):
        create(tmp_path / "run", force=True)
    assert (tmp_path / "run" / "config.json").exists()


def test_resume_goes_on_with_the_same_settings_and_names_the_one_that_differs(tmp_path):
    create(tmp_path).log(1, loss=1.0)
    resumed = create(tmp_path, resume=True)
    assert resumed.resumed
    assert [line["step"] for line in resumed.metrics()] == [1]
    with pytest.raises(UserError, match=r"config\.inner\.rate = 0\.0003, now it is 0\.1"):
        create(tmp_path, Config(inner=Inner(0.1)), resume=True)
    with pytest.raises(UserError, match="seeds"):
        create(tmp_path, seeds=[3], resume=True)


def test_every_setting_is_written_down_and_held_against_a_resumed_run(tmp_path):
    run = create(tmp_path)
    run.record_settings({"inner": Inner(0.1), "engine": "mujoco"})
    written = run.read_json("config.json")["settings"]
    assert written == {"inner": {"rate": 0.1}, "engine": "mujoco"}
    resumed = create(tmp_path, resume=True)
    resumed.record_settings({"inner": Inner(0.1), "engine": "mujoco"})
    with pytest.raises(UserError, match=r"settings\.inner\.rate = 0\.1, now it is 0\.2"):
        resumed.record_settings({"inner": Inner(0.2), "engine": "mujoco"})


def test_a_setting_without_end_is_written_down_as_null(tmp_path):
    run = create(tmp_path, {"limit": float("inf")})
    assert run.read_json("config.json")["config"] == {"limit": None}
    assert create(tmp_path, {"limit": float("inf")}, resume=True).resumed


def test_a_damaged_file_of_a_run_is_named(tmp_path):
    run = create(tmp_path)
    run.log(1, loss=1.0)
    for name in ("seconds.json", "metrics.jsonl"):
        (run.root / name).write_text("{\n")
    with pytest.raises(UserError, match=r"seconds\.json is damaged"):
        run.read_json("seconds.json")
    with pytest.raises(UserError, match=r"metrics\.jsonl is damaged"):
        list(run.metrics())


def test_a_resumed_run_knows_which_versions_changed(tmp_path):
    run = create(tmp_path)
    assert run.changed_versions() == []
    record = run.read_json("config.json")
    record["versions"]["jax"] = "0.0.1"
    run.write_json("config.json", record)
    assert len(run.changed_versions()) == 1
    assert run.changed_versions()[0].startswith("jax 0.0.1 -> ")


def test_resume_of_an_empty_folder_starts_a_run(tmp_path):
    assert not create(tmp_path / "new", resume=True).resumed


def test_resume_of_a_folder_that_is_no_run_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(UserError, match="no run to resume"):
        create(tmp_path, resume=True)


def test_a_run_of_another_command_is_not_resumed(tmp_path):
    RunDirectory.create(tmp_path / "run", Config(), "garat diagnose a.xml", ())
    with pytest.raises(UserError, match="run holds a run of garat diagnose; give another --out"):
        RunDirectory.create(tmp_path / "run", Config(), "garat transfer x", (), resume=True)


def test_force_and_resume_exclude_each_other(tmp_path):
    with pytest.raises(UserError, match="exclude"):
        create(tmp_path, force=True, resume=True)


def test_a_file_in_the_way_is_refused(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(UserError, match="is a file"):
        create(tmp_path / "file")
    with pytest.raises(UserError, match="cannot make"):
        create(tmp_path / "file" / "run")


def test_open_refuses_what_is_no_run(tmp_path):
    with pytest.raises(UserError, match="holds no run"):
        RunDirectory.open(tmp_path)
    create(tmp_path)
    assert RunDirectory.open(tmp_path).root == tmp_path


def test_metrics_that_are_not_finite_become_null(tmp_path):
    run = create(tmp_path)
    run.log(np.int64(3), loss=np.float32(0.5), returns=np.array([1.0, math.nan]), bound=-math.inf)
    (line,) = (tmp_path / "metrics.jsonl").read_text().splitlines()
    assert json.loads(line) == {"step": 3, "loss": 0.5, "returns": [1.0, None], "bound": None}


def test_rewind_drops_what_was_logged_after_the_checkpoint_and_a_torn_line(tmp_path):
    run = create(tmp_path)
    for step in (10, 20, 30):
        run.log(step, loss=step / 3)
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"step": 40, "lo')
    run.rewind(20)
    run.log(30, loss=0.0)
    assert list(run.metrics()) == [
        {"step": 10, "loss": 10 / 3},
        {"step": 20, "loss": 20 / 3},
        {"step": 30, "loss": 0.0},
    ]


def test_json_is_written_whole_or_not_at_all(tmp_path):
    run = create(tmp_path)
    run.write_json("a/summary.json", {"x": 1})
    with pytest.raises(ValueError, match="JSON"):
        run.write_json("a/summary.json", {"x": math.nan})
    assert run.read_json("a/summary.json") == {"x": 1}
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["summary.json"]


def test_to_plain_refuses_what_has_no_json_form():
    with pytest.raises(TypeError, match="object has no JSON form"):
        to_plain({"x": object()})


def test_provenance_holds_no_path_host_or_user():
    text = json.dumps(provenance())
    assert str(Path.home()) not in text
    assert str(Path(__file__).parent.parent) not in text


def test_git_state_names_the_commit_of_this_tree(repository):
    if not (repository / ".git").exists():
        pytest.skip("not a git checkout")
    state = git_state()
    assert state is None or (len(state["commit"]) == 40 and isinstance(state["dirty"], bool))


def test_a_run_of_which_nothing_came_leaves_no_folder(tmp_path):
    RunDirectory.create(tmp_path / "empty", {}, "garat", []).discard()
    assert not (tmp_path / "empty").exists()
    RunDirectory.create(tmp_path / "runs" / "today" / "empty", {}, "garat", []).discard()
    assert not (tmp_path / "runs").exists()
    (tmp_path / "mine").mkdir()
    RunDirectory.create(tmp_path / "mine" / "empty", {}, "garat", []).discard()
    assert (tmp_path / "mine").is_dir()
    kept = RunDirectory.create(tmp_path / "kept", {}, "garat", [])
    kept.log(1, reward=1.0)
    kept.discard()
    assert kept.path("metrics.jsonl").is_file()


def test_a_command_that_cannot_resume_does_not_offer_it(tmp_path):
    RunDirectory.create(tmp_path, {}, "garat", [])
    with pytest.raises(UserError) as error:
        RunDirectory.create(tmp_path, {}, "garat", [], resume=None)
    assert "--resume" not in str(error.value)
