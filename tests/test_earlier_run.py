"""A run that another one replaces is there until that has ended."""

from pathlib import Path

import pytest

from garat_jax.earlier_run import earlier_run_kept, forget_earlier, put_back_earlier
from garat_jax.errors import UserError
from garat_jax.runs import RunDirectory


def create(path, seeds=(0, 1)):
    return RunDirectory.create(path, {"method": "garat"}, "garat transfer", seeds)


def test_an_earlier_run_stays_where_the_next_one_has_no_results(tmp_path):
    create(tmp_path / "run").log(1, loss=1.0)
    with pytest.raises(UserError, match="wrong input"), earlier_run_kept(tmp_path / "run"):
        create(tmp_path / "run", seeds=[7])
        raise UserError("wrong input")
    run = RunDirectory.open(tmp_path / "run")
    assert run.read_json("config.json")["seeds"] == [0, 1]
    assert len(list(run.metrics())) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_the_time_that_compiling_took_is_no_result(tmp_path):
    create(tmp_path / "run").log(1, loss=1.0)
    with pytest.raises(UserError), earlier_run_kept(tmp_path / "run"):
        create(tmp_path / "run", seeds=[7]).write_json("seconds.json", {"compile": 20.0})
        raise UserError("wrong input")
    assert RunDirectory.open(tmp_path / "run").read_json("config.json")["seeds"] == [0, 1]


def test_an_earlier_run_goes_where_the_next_one_ends(tmp_path):
    create(tmp_path / "run").log(1, loss=1.0)
    with earlier_run_kept(tmp_path / "run"):
        create(tmp_path / "run", seeds=[7]).log(2, loss=3.0)
    run = RunDirectory.open(tmp_path / "run")
    assert run.read_json("config.json")["seeds"] == [7]
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_the_current_folder_may_be_named_by_a_dot(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with earlier_run_kept(Path()):
        create(Path()).log(1, loss=1.0)
    with pytest.raises(UserError, match="current folder"), earlier_run_kept(Path()):
        raise AssertionError
    assert len(list(RunDirectory.open(tmp_path).metrics())) == 1


def test_an_earlier_run_that_a_killed_process_put_aside_comes_back(tmp_path):
    create(tmp_path / ".run.replaced").log(1, loss=1.0)
    put_back_earlier(tmp_path / "run", resume=True)
    assert len(list(RunDirectory.open(tmp_path / "run").metrics())) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_an_earlier_run_comes_back_where_a_killed_process_had_no_results(tmp_path):
    create(tmp_path / ".run.replaced").log(1, loss=1.0)
    create(tmp_path / "run", seeds=[7])
    put_back_earlier(tmp_path / "run", resume=True)
    assert len(list(RunDirectory.open(tmp_path / "run").metrics())) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize("stop", [KeyboardInterrupt, UserError])
def test_both_runs_are_kept_where_the_next_one_stops_with_results(tmp_path, stop):
    create(tmp_path / "run").log(1, loss=1.0)
    with pytest.raises(stop), earlier_run_kept(tmp_path / "run"):
        create(tmp_path / "run", seeds=[7]).log(2, loss=3.0)
        raise stop
    assert RunDirectory.open(tmp_path / "run").read_json("config.json")["seeds"] == [7]
    earlier = RunDirectory.open(tmp_path / ".run.replaced")
    assert earlier.read_json("config.json")["seeds"] == [0, 1]


def test_an_earlier_run_stays_aside_while_the_next_one_is_gone_on_with(tmp_path):
    create(tmp_path / ".run.replaced").log(1, loss=1.0)
    create(tmp_path / "run", seeds=[7]).log(2, loss=3.0)
    assert not put_back_earlier(tmp_path / "run", resume=True)
    assert RunDirectory.open(tmp_path / "run").read_json("config.json")["seeds"] == [7]
    assert (tmp_path / ".run.replaced").is_dir()
    forget_earlier(tmp_path / "run")
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_an_earlier_run_comes_back_where_the_next_one_is_started_again(tmp_path):
    create(tmp_path / ".run.replaced").log(1, loss=1.0)
    create(tmp_path / "run", seeds=[7]).log(2, loss=3.0)
    assert put_back_earlier(tmp_path / "run", resume=False)
    assert RunDirectory.open(tmp_path / "run").read_json("config.json")["seeds"] == [0, 1]
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize("is_begun", [False, True])
def test_what_a_killed_process_left_beside_other_files_stays(tmp_path, is_begun):
    create(tmp_path / ".run.replaced").log(1, loss=1.0)
    if is_begun:
        create(tmp_path / "run")
    (tmp_path / "run").mkdir(exist_ok=True)
    (tmp_path / "run" / "thesis.tex").write_text("years of work")
    with pytest.raises(UserError, match=r"run\.replaced holds the run that was to be replaced"):
        put_back_earlier(tmp_path / "run", resume=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".run.replaced", "run"]
    assert (tmp_path / "run" / "thesis.tex").exists()


def test_a_file_that_a_killed_process_had_not_finished_is_no_result(tmp_path):
    create(tmp_path / ".run.replaced").log(1, loss=1.0)
    run = create(tmp_path / "run", seeds=[7])
    run.path("stages/one.json")
    run.write_json("seconds.json", {"compile": 20.0})  # of the first program
    (tmp_path / "run" / ".123.seconds.json").write_text("{")
    assert put_back_earlier(tmp_path / "run", resume=True)
    assert len(list(RunDirectory.open(tmp_path / "run").metrics())) == 1


def test_an_earlier_run_goes_where_another_has_ended_in_its_place(tmp_path):
    create(tmp_path / ".run.replaced").log(1, loss=1.0)
    create(tmp_path / "run", seeds=[7]).note_files()
    assert not put_back_earlier(tmp_path / "run", resume=False)
    assert RunDirectory.open(tmp_path / "run").read_json("config.json")["seeds"] == [7]
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_what_a_user_has_added_within_a_run_that_did_not_end_stays(tmp_path):
    create(tmp_path / ".run.replaced").log(1, loss=1.0)
    within = create(create(tmp_path / "run").path("part"))
    (within.root / "thesis.tex").write_text("years of work")
    with pytest.raises(UserError, match="both are left alone"):
        put_back_earlier(tmp_path / "run", resume=False)
    assert (within.root / "thesis.tex").exists()
