"""The run of a command: what becomes of the folder, and of the run that it replaces."""

import dataclasses
from pathlib import Path

import pytest

from garat_jax.commands.checks import make_run
from garat_jax.errors import UserError


@dataclasses.dataclass(frozen=True)
class Command:
    out: Path
    model: Path = Path("model.xml")
    force: bool = False
    resume: bool = False


def run(out: Path, text: str = "", stop: type[BaseException] | None = None, **options) -> None:
    """Write one result as a command would, and stop there if that is asked for."""
    command = Command(out, **options)
    with make_run(command, out, [0], command.resume) as begun:
        if text:
            begun.path("data/result.txt").write_text(text)
        if stop:
            raise stop


def result(out: Path) -> str:
    return (out / "data" / "result.txt").read_text()


@pytest.fixture
def out(tmp_path) -> Path:
    run(tmp_path / "run", "first")
    return tmp_path / "run"


def test_what_a_user_adds_to_a_folder_of_it_is_left_alone(out):
    (out / "data" / "mine.txt").write_text("years of work")
    with pytest.raises(UserError, match=r"holds data/mine\.txt"):
        run(out, "second", force=True)
    assert result(out) == "first"


def test_both_are_kept_until_what_was_interrupted_has_ended(out):
    with pytest.raises(KeyboardInterrupt, match=r"kept in .*replaced until one has ended"):
        run(out, "second", KeyboardInterrupt, force=True)
    assert (result(out), result(out.with_name(".run.replaced"))) == ("second", "first")
    with pytest.raises(KeyboardInterrupt):
        run(out, "", KeyboardInterrupt, resume=True)
    assert out.with_name(".run.replaced").exists()
    run(out, "third", resume=True)
    assert result(out) == "third"
    assert [path.name for path in out.parent.iterdir()] == ["run"]


def test_the_earlier_one_comes_back_where_another_fails_after_one_that_was_interrupted(out):
    with pytest.raises(KeyboardInterrupt):
        run(out, "second", KeyboardInterrupt, force=True)
    with pytest.raises(UserError):
        run(out, "", UserError, force=True)
    assert result(out) == "first"


def test_one_that_has_ended_is_not_given_up_for_an_older_one(out):
    with pytest.raises(KeyboardInterrupt):
        run(out, "second", KeyboardInterrupt, force=True)
    out.rename(out.with_name("saved"))
    run(out, "third")
    with pytest.raises(UserError):
        run(out, "", UserError, force=True)
    assert result(out) == "third"


def test_input_within_it_is_refused_before_anything_is_removed(out):
    with pytest.raises(KeyboardInterrupt):
        run(out, "second", KeyboardInterrupt, force=True)
    with pytest.raises(UserError, match="which --force replaces"):
        run(out, "third", force=True, model=out / "data" / "result.txt")
    assert result(out) == "second"
