"""Files are written whole or not at all, and TOML is read as editors save it."""

from pathlib import Path

import pytest

from garat_jax.errors import UserError
from garat_jax.files import distinct_names, read_toml, write_whole, written_whole


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


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_toml_may_begin_with_a_byte_order_mark(tmp_path, encoding):
    path = tmp_path / "any.toml"
    path.write_text('format = "any/1"\nname = "ä"\n', encoding=encoding)
    assert read_toml(path, "any/1", ["format", "name"]) == {"format": "any/1", "name": "ä"}


def test_toml_of_another_encoding_is_refused(tmp_path):
    path = tmp_path / "any.toml"
    path.write_text('format = "any/1"\n', encoding="utf-16")
    with pytest.raises(UserError, match=r"any.toml: no valid TOML: not UTF-8 text; save it as"):
        read_toml(path, "any/1", ["format"])
