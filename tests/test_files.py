"""Files are written whole or not at all."""

import pytest

from garat_jax.files import write_whole, written_whole


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
