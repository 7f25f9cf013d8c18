"""Recordings: what is read, what is estimated, and each refusal in the words that the user sees."""

import zipfile

import mujoco
import numpy as np
import pandas as pd
import pytest

from garat_jax.diagnosis.columns import signals, torques
from garat_jax.diagnosis.filters import local_slope
from garat_jax.diagnosis.measurements import Recording, noise
from garat_jax.diagnosis.velocity import estimate_velocity
from garat_jax.errors import UserError
from tests import models

MODEL = models.spec(models.PENDULUM).compile()
ARM = models.spec(models.ARM).compile()
TUMBLER = models.spec(models.TUMBLER).compile()


def columns(num=200, rate=250.0, **changes):
    time = np.arange(num) / rate
    angle = 0.4 * np.sin(3 * time)
    table = {
        "time": time,
        "qpos.hinge": angle,
        "qvel.hinge": 1.2 * np.cos(3 * time),
        "ctrl.motor": np.sin(time),
    }
    table.update({name.replace("__", "."): value for name, value in changes.items()})
    return {name: value for name, value in table.items() if value is not None}


def save(folder, table, name="run.csv"):
    path = folder / name
    if name.endswith("csv"):
        pd.DataFrame(table).to_csv(path, index=False)
    elif name.endswith("parquet"):
        pd.DataFrame(table).to_parquet(path)
    else:
        np.savez(path, **table)
    return path


def refusal(path, model=MODEL) -> str:
    with pytest.raises(UserError) as raised:
        Recording.read(path, model)
    message = str(raised.value)
    assert str(path) in message or path.name in message
    assert "\n" not in message
    return message


@pytest.mark.parametrize("name", ["run.csv", "run.parquet", "run.npz"])
def test_kinds_of_file_hold_the_same(tmp_path, name):
    table = columns()
    recording = Recording.read(save(tmp_path, table, name), MODEL)
    assert recording.name == name
    assert recording.velocity_measured
    assert recording.spans == ((0, 200),)
    assert recording.warnings == ()
    np.testing.assert_allclose(recording.qpos[:, 0], table["qpos.hinge"])
    np.testing.assert_allclose(recording.qvel[:, 0], table["qvel.hinge"])
    np.testing.assert_allclose(recording.ctrl[:, 0], table["ctrl.motor"])


def test_signals_have_names_and_units():
    assert [tuple(s) for s in signals(MODEL)] == [("qpos.hinge", "rad"), ("qvel.hinge", "rad/s")]
    names = [s.name for s in signals(TUMBLER)]
    assert len(names) == TUMBLER.nq + TUMBLER.nv
    assert (names[6], names[7], names[-1]) == ("qpos.free.6", "qpos.ball.0", "qvel.ball.2")


def test_a_model_without_actuators_needs_no_commands(tmp_path):
    spec = models.spec(models.PENDULUM)
    spec.delete(spec.actuators[0])
    path = save(tmp_path, columns(ctrl__motor=None))
    assert Recording.read(path, spec.compile()).ctrl.shape == (200, 0)


def test_measured_torque_is_kept(tmp_path):
    path = save(tmp_path, columns(torque__hinge=np.full(200, 0.5)))
    np.testing.assert_array_equal(Recording.read(path, MODEL).torque["hinge"], 0.5)


def test_torques_of_ball_and_free_joints_are_numbered(tmp_path):
    time, qpos, _ = tumbling()
    names = [s.name for s in signals(TUMBLER)][: TUMBLER.nq]
    table = {"time": time, **dict(zip(names, qpos.T, strict=True))}
    assert [s.unit for s in torques(TUMBLER)] == ["N"] * 3 + ["N m"] * 6
    numbered = {s.name: np.full(len(time), float(i)) for i, s in enumerate(torques(TUMBLER))}
    recording = Recording.read(save(tmp_path, table | numbered), TUMBLER)
    assert list(recording.torque)[4:] == ["free.4", "free.5", "ball.0", "ball.1", "ball.2"]
    assert recording.torque["ball.2"][0] == 8.0
    message = refusal(save(tmp_path, table | {"torque.ball": np.zeros(len(time))}), TUMBLER)
    assert "unknown column 'torque.ball'; did you mean torque.ball." in message


def test_unknown_column_names_the_nearest(tmp_path):
    path = save(tmp_path, columns(qpos__hing=np.zeros(200), qpos__hinge=None))
    said = refusal(path)
    assert "unknown column 'qpos.hing'; did you mean qpos.hinge" in said
    assert "--map renames columns" in said


@pytest.mark.parametrize(
    ("wanted", "written"), [("ctrl.motor", "torque"), ("time", "t"), ("time", "time_s")]
)
def test_foreign_column_is_named_beside_the_one_that_lacks(tmp_path, wanted, written):
    table = columns()
    table[written] = table.pop(wanted)
    message = refusal(save(tmp_path, table))
    assert f"unknown column '{written}'" in message
    assert wanted in message
    assert "torque.hinge" not in message
    assert "--map renames columns" in message


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("time", "the time of each sample in seconds"),
        ("qpos.hinge", "the position of every joint is needed); there are time, "),
        ("ctrl.motor", "the command of every actuator is needed; write 0"),
    ],
)
def test_missing_column_says_what_it_is_for(tmp_path, name, said):
    table = columns()
    del table[name]
    message = refusal(save(tmp_path, table))
    assert f"missing column '{name}'" in message
    assert said in message


def test_some_velocities_only_are_refused(tmp_path):
    num = 50
    names = [s.name for s in signals(ARM)][:3]
    table = {"time": np.arange(num) * 0.01, **{name: np.zeros(num) for name in names}}
    table |= {"ctrl.shoulder": np.zeros(num), "ctrl.elbow": np.zeros(num)}
    message = refusal(save(tmp_path, table), ARM)
    assert "missing column 'qvel.elbow'" in message
    assert "or of none and it is estimated" in message


def test_nan_and_infinity_name_their_lines(tmp_path):
    angle = np.zeros(200)
    angle[[3, 7]] = np.nan, np.inf
    message = refusal(save(tmp_path, columns(qpos__hinge=angle)))
    assert "qpos.hinge is NaN, infinite or empty at lines 5, 9;" in message
    assert "leave such samples out" in message
    message = refusal(save(tmp_path, columns(qpos__hinge=angle), "run.npz"))
    assert "at rows 3, 7;" in message


def test_what_nothing_measures_names_its_line(tmp_path):
    table = columns()
    table["qvel.hinge"][7] = -1e300
    message = refusal(save(tmp_path, table))
    assert "qvel.hinge is -1e+300 at line 9; nothing was measured that is beyond 1e+10" in message


def test_many_bad_rows_are_counted(tmp_path):
    message = refusal(save(tmp_path, columns(ctrl__motor=np.full(200, np.nan))))
    assert "lines 2, 3, 4, 5, 6 and 195 more" in message


def test_text_among_numbers_is_quoted(tmp_path):
    table = columns()
    table["ctrl.motor"] = ["off", *table["ctrl.motor"][1:]]
    assert "ctrl.motor holds 'off' at line 2; expected numbers" in refusal(save(tmp_path, table))


@pytest.mark.parametrize("second", [0.0, -1.0])
def test_time_must_increase(tmp_path, second):
    time = np.arange(200) / 250.0
    time[10] = time[9] + second
    message = refusal(save(tmp_path, columns(time=time)))
    assert "time does not increase at line 12;" in message


def test_too_few_samples(tmp_path):
    assert "5 samples; expected at least 20" in refusal(save(tmp_path, columns(num=5)))


def test_gap_is_split_with_a_warning(tmp_path):
    time = np.arange(200) / 250.0
    time[120:] += 1.0
    recording = Recording.read(save(tmp_path, columns(time=time)), MODEL)
    assert recording.spans == ((0, 120), (120, 200))
    assert recording.warnings == (
        "run.csv: 1 gap (0.476 s after the start, usual step 0.004 s); split there into 2 parts",
    )


def test_short_parts_between_gaps_are_left_out(tmp_path):
    time = np.arange(200) / 250.0
    time[190:] += 1.0
    recording = Recording.read(save(tmp_path, columns(time=time)), MODEL)
    assert recording.spans == ((0, 190),)
    assert "10 samples in shorter parts are left out" in recording.warnings[0]


def test_velocity_is_not_estimated_across_a_gap(tmp_path):
    time = np.arange(200) / 250.0
    time[120:] += 1.0
    angle = np.where(np.arange(200) < 120, 0.0, 1.0)
    table = columns(time=time, qpos__hinge=angle, qvel__hinge=None)
    recording = Recording.read(save(tmp_path, table), MODEL)
    assert not recording.velocity_measured
    np.testing.assert_allclose(recording.qvel, 0.0, atol=1e-9)


def test_degrees_are_suspected(tmp_path):
    path = save(tmp_path, columns(qpos__hinge=np.linspace(0, 300, 200)))
    (warning,) = Recording.read(path, MODEL).warnings
    assert "qpos.hinge reaches 300 rad; is it in degrees? multiply by pi/180" in warning


def test_an_angle_far_beyond_the_joints_range_is_suspected(tmp_path):
    num = 50
    table = {name: np.zeros(num) for name in ("qpos.elbow", "ctrl.shoulder", "ctrl.elbow")}
    table |= {"time": np.arange(num) * 0.01, "qpos.shoulder": np.full(num, 30.0)}
    (warning,) = Recording.read(save(tmp_path, table), ARM).warnings
    assert "qpos.shoulder reaches 30 rad and the joint's range is -2.97 to 2.97 rad" in warning


def test_commands_beyond_limits_are_warned_of(tmp_path):
    command = np.zeros(200)
    command[:7] = 3.5
    (warning,) = Recording.read(save(tmp_path, columns(ctrl__motor=command)), MODEL).warnings
    assert "ctrl.motor is beyond its range -3 to 3 in 7 of 200 samples" in warning
    assert "the model clamps it" in warning


def test_pickled_npz_is_never_loaded(tmp_path):
    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "sprung"), "w"))

    path = tmp_path / "run.npz"
    np.savez(path, time=np.asarray([Trap()], dtype=object))
    assert "array 'time' holds pickled Python objects, which are never loaded" in refusal(path)
    with zipfile.ZipFile(path) as archive:  # NumPy's header, then the pickle
        _, _, pickled = archive.read("time.npy").partition(b"\n")
    path.write_bytes(pickled)
    assert "not an NPZ archive" in refusal(path)
    assert not (tmp_path / "sprung").exists()


def test_npz_arrays_must_be_equally_long_columns(tmp_path):
    table = columns()
    message = refusal(save(tmp_path, table | {"ctrl.motor": np.zeros(3)}, "run.npz"))
    assert "array 'ctrl.motor' has 3 samples" in message
    message = refusal(save(tmp_path, table | {"ctrl.motor": np.zeros((200, 2))}, "run.npz"))
    assert "array 'ctrl.motor' has shape (200, 2)" in message


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("run.csv", b"", "the file is empty"),
        ("run.npz", b"", "the file is empty"),
        ("run.parquet", b"nonsense, not parquet", "cannot be read as PARQUET"),
        ("run.csv", b"\xff\xfe\x00\x01", "cannot be read as CSV: not UTF-8 text; save it as"),
        ("run.csv", "time,qpos.hinge\n0,1\n".encode("utf-16-le"), "not UTF-8 text; save it as"),
        ("run.csv", b"time,qpos.hinge\n\x1f\x8b,1\n", "first if it is compressed"),
        ("run.txt", b"time\n0\n", "unknown kind of file '.txt'; expected .csv, .parquet, .npz"),
        ("run.csv", b"time;qpos.hinge\n0;1\n", "separated by ';'; expected commas, or a map"),
        ("run.csv", b"0.0,1.0\n0.1,1.1\n", "line 1 holds numbers; expected the columns' names"),
        ("run.csv", b"\n\n", "line 1 is empty; expected the columns' names"),
        ("run.csv", b"time,time\n0.1,1.1\n", "column 'time' is there 2 times"),
        ("run.csv", b"time,qpos.hinge\n0,1\n0,1,2,3\n", "cannot be read as CSV"),
        ("run.csv", b"time,qpos.hinge,ctrl.motor\n", "0 samples; expected at least 20"),
    ],
)
def test_unreadable_files(tmp_path, name, content, said):
    path = tmp_path / name
    path.write_bytes(content)
    assert said in refusal(path)


def as_r_writes(table) -> str:
    """R's write.table(table, sep = ","): a name before each row, which line 1 does not name."""
    lines = [",".join(f'"{name}"' for name in table)]
    rows = enumerate(zip(*table.values(), strict=True), 1)
    lines += [",".join([f'"{number}"', *map(str, row)]) for number, row in rows]
    return "\n".join(lines)


def test_rows_with_more_fields_than_names_are_refused(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text(as_r_writes(columns()))
    message = refusal(path)
    assert "rows have more fields than line 1 names (4); expected as many" in message
    assert "leave row names out (in R: row.names = FALSE)" in message


def test_a_comma_may_end_each_row(tmp_path):
    path = tmp_path / "run.csv"
    header, *rows = save(tmp_path, columns()).read_text().splitlines()
    path.write_text("\n".join([header, *(f"{row}," for row in rows)]))
    assert len(Recording.read(path, MODEL).time) == 200


def test_absent_file(tmp_path):
    assert "no such file" in refusal(tmp_path / "absent.csv")


def test_a_nameless_joint_is_refused(tmp_path):
    spec = models.spec(models.PENDULUM)
    spec.actuators[0].target = ""
    spec.delete(spec.actuators[0])
    spec.delete(spec.sensors[0])
    spec.joints[0].name = ""
    with pytest.raises(UserError, match="joint 0 of the model has no name; name it in the MJCF"):
        Recording.read(save(tmp_path, columns()), spec.compile())


def tumbling(num=150, rate=100.0):
    """A free box with a ball joint, falling and turning: time, qpos, qvel by MuJoCo."""
    data = mujoco.MjData(TUMBLER)
    data.qpos[2] = 20.0
    data.qvel[:] = [0.3, -0.2, 1.0, 1.5, -2.0, 1.0, 0.7, 1.1, -0.4]
    every = round(1 / rate / TUMBLER.opt.timestep)
    rows = []
    for _ in range(num):
        rows.append((data.time, data.qpos.copy(), data.qvel.copy()))
        mujoco.mj_step(TUMBLER, data, every)
    return tuple(np.asarray(column) for column in zip(*rows, strict=True))


def test_velocity_estimate_agrees_with_mujoco_on_free_and_ball_joints():
    time, qpos, qvel = tumbling()
    qpos[40:90, 3:7] *= -1  # the same rotation
    estimate = estimate_velocity(TUMBLER, time, qpos)
    np.testing.assert_allclose(estimate[3:-3], qvel[3:-3], atol=0.05)


def test_velocity_estimate_takes_irregular_sampling(tmp_path):
    rng = np.random.default_rng(0)
    time = np.sort(rng.uniform(0, 2, 500))
    angle = 0.4 * np.sin(3 * time)
    estimate = estimate_velocity(MODEL, time, angle[:, None])[:, 0]
    np.testing.assert_allclose(estimate, 1.2 * np.cos(3 * time), atol=0.02)


def test_long_signals_are_differentiated_piece_by_piece(monkeypatch):
    time = np.cumsum(np.random.default_rng(0).uniform(0.5, 1.5, 1000)) / 250
    values = np.sin(3 * time)[:, None]
    at_once = local_slope(time, values)
    monkeypatch.setattr("garat_jax.diagnosis.filters.ROWS", 300)
    np.testing.assert_array_equal(local_slope(time, values), at_once)


def test_quaternions_must_have_unit_norm(tmp_path):
    time, qpos, _ = tumbling()
    qpos[5, 3:7] *= 1.5
    names = [s.name for s in signals(TUMBLER)][: TUMBLER.nq]
    table = {"time": time, **dict(zip(names, qpos.T, strict=True))}
    message = refusal(save(tmp_path, table), TUMBLER)
    assert "qpos.free.3 to qpos.free.6 are no unit quaternion (w x y z) at line 7" in message


@pytest.mark.parametrize("rate", [50.0, 1000.0])
def test_noise_is_recovered_on_motion(tmp_path, rate):
    rng = np.random.default_rng(0)
    table = columns(num=1000, rate=rate)
    table["qpos.hinge"] = table["qpos.hinge"] + rng.normal(size=1000) * 1e-3
    table["qvel.hinge"] = table["qvel.hinge"] + rng.normal(size=1000) * 1e-2
    found = noise(Recording.read(save(tmp_path, table), MODEL))
    np.testing.assert_allclose(found, [1e-3, 1e-2], rtol=0.15)


def test_noise_of_an_encoder_is_at_least_its_step(tmp_path):
    table = columns(num=1000, rate=1000.0)
    step = 2 * np.pi / 4096
    table["qpos.hinge"] = np.round(table["qpos.hinge"] / step) * step
    found = noise(Recording.read(save(tmp_path, table), MODEL))
    np.testing.assert_allclose(found[0], step / np.sqrt(12), rtol=0.2)
