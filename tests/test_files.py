"""Files are written whole or not at all."""

from pathlib import Path

import pytest

from garat_jax.files import distinct_names, write_whole, written_whole


def test_a_file_that_fails_leaves_what_lay_there(tmp_path):
    path = write_whole(tmp_path / "data.csv", "whole")
    with pytest.raises(OSError, match="full"), written_whole(path) as temporary:
        temporary.write_text("ha")
        raise OSError("full")
    assert path.read_text() == "whole"
    assert [*tmp_path.iterdir()] == [path]


def test_a_link_stays_a_link(tmp_path):
    path, link = tmp_path / "data.csv", tmp_path / "link.csv"
    path.write_text("old")
    link.symlink_to(path)
    write_whole(link, "new")
    assert link.is_symlink()
    assert path.read_text() == "new"


def test_names_tell_files_apart():
    one, two, other = Path("day1/run.csv"), Path("day2/run.csv"), Path("day2/walk.csv")
    assert distinct_names([two, other]) == {two: "run.csv", other: "walk.csv"}
    assert distinct_names([one, two]) == {one: "day1/run.csv", two: "day2/run.csv"}
    assert distinct_names([one, one]) == {one: "run.csv"}
    assert distinct_names([]) == {}
