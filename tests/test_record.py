import json
import math
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from benchmarks import record
from benchmarks.figures.results import commits
from benchmarks.record import command_line, write_result


def test_a_result_names_what_is_needed_to_get_it_again(tmp_path):
    rows = [{"env": "x", "rate": np.float32(2.0)}]
    path = write_result("speed", rows, seeds=range(2), command="python x.py", folder=tmp_path)
    result = json.loads(path.read_text())
    assert path == tmp_path / "speed.json"
    assert result["rows"] == [{"env": "x", "rate": 2.0}]
    assert result["seeds"] == [0, 1]
    assert result["command"] == "python x.py"
    assert {"git", "versions", "machine", "device", "date"} <= result.keys()
    assert {"cpu", "cores", "memory_gib"} <= result["machine"].keys()


def test_a_result_of_an_accelerator_is_named_after_it(tmp_path, monkeypatch):
    gpu = SimpleNamespace(platform="gpu", device_kind="NVIDIA H100")
    monkeypatch.setattr(jax, "devices", lambda: [gpu])
    path = write_result("speed", [{}], seeds=[0], command="python x.py", folder=tmp_path)
    assert path == tmp_path / "speed_gpu.json"
    assert json.loads(path.read_text())["device"] == "NVIDIA H100"


def test_a_result_written_anew_keeps_the_state_it_began_from(tmp_path, monkeypatch):
    states = iter(("clean", "changed by the result"))
    monkeypatch.setattr(record, "provenance", lambda: {"git": next(states)})
    record._made_by.cache_clear()
    for rate in (1.0, 2.0):
        rows = [{"rate": rate}]
        path = write_result("speed", rows, seeds=[0], command="python x.py", folder=tmp_path)
    record._made_by.cache_clear()
    result = json.loads(path.read_text())
    assert result["rows"] == [{"rate": 2.0}]
    assert result["git"] == "clean"


@pytest.mark.parametrize("rows", [[], [{"rate": math.nan}]])
def test_a_result_without_a_value_is_refused(tmp_path, rows):
    with pytest.raises(ValueError):
        write_result("speed", rows, seeds=[0], command="python x.py", folder=tmp_path)
    assert not (tmp_path / "speed.json").exists()


def test_the_command_is_recorded_without_where_the_result_goes(monkeypatch):
    words = ["/somewhere/benchmarks/speed.py", "--out", "/elsewhere", "--envs", "hopper"]
    monkeypatch.setattr("sys.argv", words)
    assert command_line() == "python benchmarks/speed.py --envs hopper"


@pytest.mark.parametrize(
    ("of_rows", "own", "said"),
    [
        (["a", "b"], "a", "The rows are of the commits a, b."),
        (["b", "b"], "a", "The rows are of the commit b."),
        (["a", None], "a", ""),
        ([None], "a", ""),
    ],
)
def test_tables_say_where_rows_are_of_other_commits_than_their_file(of_rows, own, said):
    rows = [{"commit": commit} for commit in of_rows]
    assert commits(rows, own).strip() == said
