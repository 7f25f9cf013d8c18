"""`garat convert`: real logs of every kind become the same recording."""

import shutil
import sqlite3
import sys

import numpy as np
import pandas as pd
import pytest
from scipy import io

from garat_jax import cli
from garat_jax.diagnosis.measurements import Recording
from tests import models

rosbags = pytest.importorskip("rosbags")

MODEL = models.spec(models.PENDULUM).compile()
NUM, RATE = 60, 100.0
STAMPS = np.arange(NUM) / RATE
ANGLE = 30 * np.sin(3 * STAMPS)
SPEED = 90 * np.cos(3 * STAMPS)
EPOCH = 1_700_000_000
COLUMNS = """
"qpos.hinge" = {{ from = "{angle}", unit = "deg" }}
"qvel.hinge" = {{ from = "{speed}", unit = "deg/s" }}
"ctrl.motor" = "{torque}"
"""
OF_ARRAYS = COLUMNS.format(angle="state[0]", speed="state[1]", torque="u")
OF_BAGS = COLUMNS.format(
    angle="/joint_states.position[hinge]", speed="/joint_states.velocity[1]", torque="/effort.data"
)


def convert(
    folder, log, columns, time='time = "t"', head="", force=False
) -> tuple[int, Recording | None]:
    status = convert_only(folder, log, f"{time}\n{columns}", head, force)
    return status, Recording.read(folder / "data.csv", MODEL) if status == 0 else None


def convert_only(folder, log, columns, head="", force=False) -> int:
    path, out = folder / "map.toml", folder / "data.csv"
    path.write_text(f'format = "garat-map/1"\n{head}\n[column]\n{columns}')
    given = ["convert", str(log), "--map", str(path), "--out", str(out), *["--force"] * force]
    return cli.main(given)


def check(recording, torque=None):
    np.testing.assert_allclose(recording.time, STAMPS, atol=1e-6)
    np.testing.assert_allclose(recording.qpos[:, 0], np.radians(ANGLE), atol=1e-6)
    np.testing.assert_allclose(recording.qvel[:, 0], np.radians(SPEED), atol=1e-6)
    np.testing.assert_allclose(recording.ctrl[:, 0], STAMPS if torque is None else torque)


def arrays():
    return {"t": STAMPS + 5, "state": np.stack([ANGLE, SPEED]), "u": STAMPS}


def test_npz_with_an_array_of_states(tmp_path):
    np.savez(tmp_path / "log.npz", **arrays())
    check(convert(tmp_path, tmp_path / "log.npz", OF_ARRAYS)[1])


def test_mat_with_a_structure(tmp_path):
    io.savemat(tmp_path / "log.mat", {"run": {**arrays(), "state": arrays()["state"].T}})
    columns = OF_ARRAYS.replace("state[", "run.state[").replace('"u"', '"run.u"')
    check(convert(tmp_path, tmp_path / "log.mat", columns, 'time = "run.t"')[1])


def test_mat_with_cells_of_recordings_that_are_not_equally_long(tmp_path):
    made, cells = arrays(), {}
    for name, array in made.items():
        cells[name] = np.empty(2, object)
        cells[name][:] = [array[:5], array]
    io.savemat(tmp_path / "log.mat", cells)
    columns = OF_ARRAYS.replace("state[", "state.1[").replace('"u"', '"u.1"')
    check(convert(tmp_path, tmp_path / "log.mat", columns, 'time = "t.1"')[1])


def test_mat_with_an_array_of_structures(tmp_path):
    made = arrays()
    runs = np.empty(2, [(name, object) for name in made])
    runs[0], runs[1] = tuple(array[:5] for array in made.values()), tuple(made.values())
    io.savemat(tmp_path / "log.mat", {"run": runs})
    columns = OF_ARRAYS.replace("state[", "run.1.state[").replace('"u"', '"run.1.u"')
    check(convert(tmp_path, tmp_path / "log.mat", columns, 'time = "run.1.t"')[1])


@pytest.mark.parametrize("shape", [(3,), (3, 2)])
@pytest.mark.parametrize("first", ["a note", {"t": 0.0}])
def test_mat_with_structures_in_cells(tmp_path, shape, first):
    made = np.empty(shape, object)
    made.flat[:] = [first] + [arrays()] * (made.size - 1)
    io.savemat(tmp_path / "log.mat", {"run": {"parts": made}})
    columns = OF_ARRAYS.replace("state[", "run.parts.2.state[").replace('"u"', '"run.parts.2.u"')
    check(convert(tmp_path, tmp_path / "log.mat", columns, 'time = "run.parts.2.t"')[1])


def test_mat_without_the_array_names_the_nearest(tmp_path, capsys):
    io.savemat(tmp_path / "log.mat", {"run": arrays()})
    columns = OF_ARRAYS.replace("state[", "run.states[").replace('"u"', '"run.u"')
    assert convert(tmp_path, tmp_path / "log.mat", columns, 'time = "run.t"')[0] == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "unknown array 'run.states'; did you mean run.state" in line


@pytest.mark.parametrize("name", ["log.csv", "log.parquet"])
def test_foreign_tables(tmp_path, name, capsys):
    frame = pd.DataFrame({"t": STAMPS, "a": ANGLE, "s": SPEED, "u": STAMPS, "note": "x"})
    path = tmp_path / name
    if name.endswith("csv"):
        frame.to_csv(path, index=False, sep=";")
    else:
        frame.to_parquet(path)
    columns = COLUMNS.format(angle="a", speed="s", torque="u")
    check(convert(tmp_path, path, columns)[1])
    assert f"({NUM} samples over 0.59 s: time, qpos.hinge" in capsys.readouterr().out


def stamp(store, seconds):
    nanoseconds = round(seconds * 1e9)
    cls = store.types["builtin_interfaces/msg/Time"]
    return cls(sec=EPOCH + nanoseconds // 1_000_000_000, nanosec=nanoseconds % 1_000_000_000)


def hinge_beside_another(k):
    return ["other", "hinge"], [0.0, ANGLE[k]]


def messages(store, joints_at):
    """Yield (topic, message type, recorded nanoseconds, message): states recorded 13 ms late.

    `joints_at` returns names and positions of each sample.
    """
    header, joints = store.types["std_msgs/msg/Header"], store.types["sensor_msgs/msg/JointState"]
    number = store.types["std_msgs/msg/Float64"]
    nothing = np.zeros(0)
    extra = {"seq": 0} if "seq" in header.__dataclass_fields__ else {}
    for k in range(NUM):
        at = EPOCH * 10**9 + round(STAMPS[k] * 1e9)
        yield "/effort", number, at - 10**6, number(data=float(STAMPS[k]))
        names, position = joints_at(k)
        state = joints(
            header(stamp=stamp(store, STAMPS[k]), frame_id="", **extra),
            names,
            np.asarray(position),
            np.asarray([0.0, SPEED[k]]),
            nothing,
        )
        yield "/joint_states", joints, at + 13 * 10**6, state


def write_bag(folder, kind, joints_at=hinge_beside_another):
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    if kind == "ros1":
        path, store = folder / "log.bag", get_typestore(Stores.ROS1_NOETIC)
        writer, serialize = Writer1(path), store.serialize_ros1
    else:
        plugin = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}[kind]
        path, store = folder / "log", get_typestore(Stores.ROS2_HUMBLE)
        writer, serialize = Writer(path, version=9, storage_plugin=plugin), store.serialize_cdr
    connections = {}
    with writer:
        for topic, cls, at, message in messages(store, joints_at):
            name = cls.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=store)
            writer.write(connections[topic], at, serialize(message, name))
    return path


@pytest.mark.parametrize("kind", ["ros1", "mcap", "sqlite3"])
def test_bags_of_ros_1_and_2(tmp_path, kind):
    check(convert(tmp_path, write_bag(tmp_path, kind), OF_BAGS, time="")[1])


def test_a_single_mcap_file(tmp_path):
    (file,) = write_bag(tmp_path, "mcap").glob("*.mcap")
    check(convert(tmp_path, file, OF_BAGS, time="")[1])


def test_the_clock_of_the_log_shifts_the_states_against_the_commands(tmp_path):
    log = write_bag(tmp_path, "mcap")
    _, recording = convert(tmp_path, log, OF_BAGS, time="", head='clock = "log"')
    check(recording, torque=np.append(STAMPS[1:], STAMPS[-1]))


def database(folder):
    (path,) = write_bag(folder, "sqlite3").glob("*.db3")
    return shutil.copy(path, folder / "log.db3")


def test_a_message_type_that_nothing_defines_is_named(tmp_path, capsys):
    log = database(tmp_path)
    bag = sqlite3.connect(log)
    with bag:
        bag.execute("UPDATE topics SET type = 'own_msgs/msg/Effort' WHERE name = '/effort'")
    bag.close()
    assert convert(tmp_path, log, OF_BAGS, time="")[0] == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{log}: nothing defines the message type 'own_msgs/msg/Effort' of /effort" in line
    assert "take another topic" in line


@pytest.mark.parametrize("kept", [1000, 5000, 0.5, 0.9])
def test_a_bag_damaged_after_its_beginning_is_refused(tmp_path, capsys, kept):
    log = database(tmp_path)
    content = log.read_bytes()
    begin = kept if kept > 1 else int(kept * len(content))
    log.write_bytes(content[:begin] + bytes([7]) * (len(content) - begin))
    assert convert(tmp_path, log, OF_BAGS, time="")[0] == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{log}: cannot be read as a bag: " in line


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("/joint_states.pos", "/joint_state.pos", "unknown topic '/joint_state'; did you mean"),
        (".position[", ".positon[", "unknown field of /joint_states 'positon'; did you mean"),
        ("[hinge]", "[hing]", "unknown name in /joint_states 'hing'; did you mean hinge?"),
        (
            "velocity[1]",
            "velocity[2]",
            "no message of /joint_states has an element [2] of velocity",
        ),
        ("[hinge]", "", "is no number; name one of its elements"),
        (
            "/effort.data",
            "effort",
            "'effort' in the map names no field of a topic",
        ),
    ],
)
def test_refusals_of_bags(tmp_path, capsys, old, new, said):
    assert old in OF_BAGS
    log = write_bag(tmp_path, "mcap")
    assert convert(tmp_path, log, OF_BAGS.replace(old, new, 1), time="")[0] == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert line.count(str(log)) <= 1
    assert not (tmp_path / "data.csv").exists()


def test_without_rosbags_the_extra_is_named(tmp_path, capsys, monkeypatch):
    log = write_bag(tmp_path, "mcap")
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    assert convert(tmp_path, log, OF_BAGS, time="")[0] == 2
    assert "pip install 'garat_jax[logs]'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("columns", "time", "said"),
    [
        (OF_ARRAYS.replace("state[0]", "states[0]"), 'time = "t"', "'states'; did you mean state?"),
        (OF_ARRAYS.replace("state[0]", "state"), 'time = "t"', "name one column, such as state[0]"),
        (OF_ARRAYS.replace("state[0]", "state[7]"), 'time = "t"', "it has 2 columns"),
        (OF_ARRAYS.replace('"u"', '"u[0]"'), 'time = "t"', "has one column only; leave [0] out"),
        (OF_ARRAYS.replace('"u"', '"deep"'), 'time = "t"', "expected one or two dimensions"),
        (OF_ARRAYS.replace('"u"', '"deep[0]"'), 'time = "t"', "expected one or two dimensions"),
        (OF_ARRAYS.replace('"u"', '"short"'), 'time = "t"', "expected one value a sample in each"),
        (OF_ARRAYS, "", 'the samples have no time; add time = "NAME"'),
    ],
)
def test_refusals_of_arrays(tmp_path, capsys, columns, time, said):
    np.savez(tmp_path / "log.npz", **arrays(), short=STAMPS[:5], deep=np.zeros((5, 2, 3)))
    assert convert(tmp_path, tmp_path / "log.npz", columns, time)[0] == 2
    assert said in capsys.readouterr().err


def test_pickled_arrays_are_never_loaded(tmp_path, capsys):
    np.savez(tmp_path / "log.npz", **arrays() | {"t": np.asarray([{}], dtype=object)})
    assert convert(tmp_path, tmp_path / "log.npz", OF_ARRAYS)[0] == 2
    assert "array 't' holds pickled Python objects, which are never" in capsys.readouterr().err


def test_arrays_that_the_map_leaves_out_stay_unread(tmp_path, capsys):
    others = {"info": np.asarray([{}], dtype=object), "names": np.asarray(["hinge"])}
    np.savez(tmp_path / "log.npz", **arrays(), **others)
    check(convert(tmp_path, tmp_path / "log.npz", OF_ARRAYS)[1])
    columns = OF_ARRAYS.replace('"u"', '"inf"')
    assert convert(tmp_path, tmp_path / "log.npz", columns, force=True)[0] == 2
    assert "unknown array 'inf'; did you mean info?" in capsys.readouterr().err


def test_one_array_under_the_name_of_an_archive_is_refused(tmp_path, capsys):
    with (tmp_path / "log.npz").open("wb") as file:
        np.save(file, STAMPS)
    assert convert(tmp_path, tmp_path / "log.npz", OF_ARRAYS)[0] == 2
    assert "log.npz: not an NPZ archive; write it with numpy.savez" in capsys.readouterr().err


def test_a_recording_never_replaces_its_log(tmp_path, capsys):
    log = tmp_path / "data.csv"
    pd.DataFrame({"t": STAMPS, "a": ANGLE, "s": SPEED, "u": STAMPS}).to_csv(log, index=False)
    raw = log.read_bytes()
    columns = COLUMNS.format(angle="a", speed="s", torque="u")
    for force in (False, True):
        assert convert(tmp_path, log, columns, force=force)[0] == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert f"--out {log} is LOG itself; give another name" in line
    assert log.read_bytes() == raw


@pytest.mark.parametrize("name", ["log.mat", "log.npz", "log.mcap", "log.bag", "log.parquet"])
def test_damaged_logs_are_refused(tmp_path, capsys, name):
    (tmp_path / name).write_bytes(b"nonsense, and not much of it")
    assert convert(tmp_path, tmp_path / name, OF_BAGS, time="")[0] == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert name in line


def test_other_logs_are_refused(tmp_path, capsys):
    (tmp_path / "log.txt").write_text("1 2 3")
    assert convert(tmp_path, tmp_path / "log.txt", OF_ARRAYS)[0] == 2
    assert "unknown kind of log; expected a bag" in capsys.readouterr().err
    assert cli.main(["convert", "no.mcap", "--map", "m", "--out", "x.csv"]) == 2
    assert "LOG: there is no file no.mcap" in capsys.readouterr().err


WRITERS = {
    "log.csv": lambda path, table: pd.DataFrame(table).to_csv(path, index=False),
    "log.parquet": lambda path, table: pd.DataFrame(table).to_parquet(path),
    "log.npz": lambda path, table: np.savez(path, **table),
    "log.mat": lambda path, table: io.savemat(path, table),
}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda table: {n: c[:0] for n, c in table.items()}, "0 samples; expected at least 20"),
        (lambda table: {n: c[:1] for n, c in table.items()}, "1 samples; expected at least 20"),
        (lambda table: table | {"a": np.full(NUM, np.nan)}, "qpos.hinge is NaN, infinite or empty"),
        (lambda table: table | {"t": np.full(NUM, np.nan)}, "time is NaN, infinite or empty"),
        (lambda table: table | {"t": table["t"][::-1]}, "time does not increase"),
    ],
)
def test_logs_that_hold_no_recording_are_refused(tmp_path, capsys, name, change, said):
    made = {"t": STAMPS, "a": ANGLE, "s": SPEED, "u": STAMPS}
    WRITERS[name](tmp_path / name, change(made))
    columns = COLUMNS.format(angle="a", speed="s", torque="u")
    (tmp_path / "data.csv").write_text("kept")
    log, path = str(tmp_path / name), tmp_path / "map.toml"
    path.write_text(f'format = "garat-map/1"\n[column]\ntime = "t"\n{columns}')
    out = str(tmp_path / "data.csv")
    assert cli.main(["convert", log, "--map", str(path), "--out", out, "--force"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert name in line
    assert (tmp_path / "data.csv").read_text() == "kept"


def test_a_bag_of_one_message_is_refused(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "NUM", 1)
    assert convert(tmp_path, write_bag(tmp_path, "mcap"), OF_BAGS, time="")[0] == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "samples; expected at least 20" in line


@pytest.mark.parametrize("suffix", ["csv", "parquet", "npz", "mat", "mcap", "bag", "db3"])
def test_empty_files_are_refused(tmp_path, capsys, suffix):
    log = tmp_path / f"log.{suffix}"
    log.touch()
    assert convert(tmp_path, log, OF_BAGS, time="")[0] == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{log}: the file is empty; expected a bag" in line


def test_an_archive_cut_short_is_refused(tmp_path, capsys):
    whole, log = tmp_path / "whole.npz", tmp_path / "log.npz"
    np.savez_compressed(whole, **arrays())
    content = bytearray(whole.read_bytes())
    content[80:120] = bytes(40)
    for damaged in (content, whole.read_bytes()[:300]):
        log.write_bytes(damaged)
        assert convert(tmp_path, log, OF_ARRAYS)[0] == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert "log.npz" in line
