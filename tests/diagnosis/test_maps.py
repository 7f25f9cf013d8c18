"""Map files: units, signs and offsets by hand, and each refusal in the user's words."""

import numpy as np
import pandas as pd
import pytest

from garat_jax import cli
from garat_jax.diagnosis.maps import read_map
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.units import UNITS
from garat_jax.errors import UserError
from tests import models

MODEL = models.spec(models.PENDULUM).compile()
MAP = """
format = "garat-map/1"
[column]
time = { from = "t", unit = "ms" }
"qpos.hinge" = { from = "angle", unit = "deg", sign = -1, offset = 90 }
"qvel.hinge" = { from = "speed", unit = "rpm", sign = -1 }
"ctrl.motor" = "torque"
"""
TIME = np.arange(50) * 4.0
FOREIGN = {
    "t": TIME,
    "mode": ["swing"] * 50,
    "angle": 90 - 10 * np.sin(0.01 * TIME),
    "speed": np.full(50, 30.0),
    "torque": np.linspace(-1, 1, 50),
}


def write(folder, text=MAP):
    path = folder / "map.toml"
    path.write_text(text)
    return path


def save(folder, separator=",", name="log.csv"):
    path = folder / name
    if name.endswith("parquet"):
        pd.DataFrame(FOREIGN).to_parquet(path)
    else:
        pd.DataFrame(FOREIGN).to_csv(path, index=False, sep=separator)
    return path


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_units_signs_and_offsets_by_hand(tmp_path, separator):
    path = save(tmp_path, separator)
    recording = Recording.read(path, MODEL, read_map(write(tmp_path)))
    np.testing.assert_allclose(recording.time[:3], [0.0, 0.004, 0.008])
    expected = np.radians(10 * np.sin(0.01 * TIME))
    np.testing.assert_allclose(recording.qpos[:, 0], expected, atol=1e-12)
    np.testing.assert_allclose(recording.qvel[:, 0], -np.pi, rtol=1e-12)
    np.testing.assert_allclose(recording.ctrl[:, 0], FOREIGN["torque"])


def test_decimal_commas_are_named(tmp_path):
    log = save(tmp_path, separator=";")
    log.write_text(log.read_text().replace(".", ","))
    with pytest.raises(UserError, match=r"holds '[-\d]+,\d+' at .* a decimal point, not a comma"):
        Recording.read(log, MODEL, write(tmp_path))


def test_parquet_takes_a_map_too(tmp_path):
    path = save(tmp_path, name="log.parquet")
    assert len(Recording.read(path, MODEL, read_map(write(tmp_path))).time) == 50


def test_parquet_whose_columns_are_numbers_and_whose_index_is_time(tmp_path):
    frame = pd.DataFrame({0: FOREIGN["angle"], 1: FOREIGN["speed"], 2: FOREIGN["torque"]})
    frame.index = pd.Index(TIME, name="t")
    frame.to_parquet(tmp_path / "log.parquet")
    text = MAP.replace('"angle"', '"0"').replace('"speed"', '"1"').replace('"torque"', '"2"')
    recording = Recording.read(tmp_path / "log.parquet", MODEL, write(tmp_path, text))
    np.testing.assert_allclose(recording.time, 1e-3 * TIME)
    np.testing.assert_allclose(recording.ctrl[:, 0], FOREIGN["torque"])
    with pytest.raises(UserError, match="unknown column '0'"):
        Recording.read(tmp_path / "log.parquet", MODEL)


def test_an_index_that_is_a_column_already_is_left_alone(tmp_path):
    frame = pd.DataFrame(FOREIGN).set_index("t", drop=False)
    frame.to_parquet(tmp_path / "log.parquet")
    recording = Recording.read(tmp_path / "log.parquet", MODEL, write(tmp_path))
    np.testing.assert_allclose(recording.time, 1e-3 * TIME)


def test_npz_takes_a_map_too(tmp_path):
    path = tmp_path / "log.npz"
    np.savez(path, **{name: v for name, v in FOREIGN.items() if name != "mode"}, extra=np.eye(2))
    assert len(Recording.read(path, MODEL, write(tmp_path)).time) == 50


def test_a_map_names_columns_of_arrays_in_npz(tmp_path):
    path = tmp_path / "log.npz"
    state = np.stack([FOREIGN["angle"], FOREIGN["speed"]], axis=1)
    np.savez(path, t=TIME, torque=FOREIGN["torque"], state=state)
    text = MAP.replace('"angle"', '"state[0]"').replace('"speed"', '"state[1]"')
    recording = Recording.read(path, MODEL, str(write(tmp_path, text)))
    np.testing.assert_allclose(recording.qvel[:, 0], -np.pi, rtol=1e-12)
    with pytest.raises(UserError, match=r"or a map file that names one of its columns state\[0\]"):
        Recording.read(path, MODEL)


def test_an_array_may_be_named_like_a_column(tmp_path):
    path = tmp_path / "log.npz"
    arrays = {name: values for name, values in FOREIGN.items() if name not in ("mode", "angle")}
    np.savez(path, **arrays, **{"angle[0]": FOREIGN["angle"]})
    text = MAP.replace('"angle"', '"angle[0]"')
    assert len(Recording.read(path, MODEL, write(tmp_path, text)).time) == 50


def test_scale_counts_before_the_offset(tmp_path):
    text = MAP.replace('from = "angle", unit = "deg"', 'from = "angle", scale = 0.5, unit = "deg"')
    recording = Recording.read(save(tmp_path), MODEL, read_map(write(tmp_path, text)))
    np.testing.assert_allclose(recording.qpos[0, 0], np.radians(-0.5 * 90 + 90))


def test_a_unit_may_be_the_number_1(tmp_path):
    text = MAP.replace('"torque"', '{ from = "torque", unit = 1 }')
    recording = Recording.read(save(tmp_path), MODEL, read_map(write(tmp_path, text)))
    np.testing.assert_allclose(recording.ctrl[:, 0], FOREIGN["torque"])


def test_units_are_what_they_say():
    assert UNITS["rpm"].factor * 60 == pytest.approx(2 * np.pi)
    assert UNITS["deg"].factor * 180 == pytest.approx(np.pi)
    assert UNITS["g"] == ("m/s²", 9.80665)
    assert UNITS["kgf cm"].factor == pytest.approx(9.80665e-2)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("garat-map/1", "garat-map/2", "format is 'garat-map/2'; expected 'garat-map/1'"),
        ("[column]", "[columns]", "unknown key 'columns'; did you mean column?"),
        ("[column]", "[column", "no valid TOML"),
        ('"qpos.hinge"', "qpos.hinge", "ctrl.ACTUATOR or torque.JOINT, in quotes"),
        ('"qpos.hinge"', '"angle.hinge"', "expected time, qpos.JOINT, qvel.JOINT"),
        ('"deg"', '"degs"', "unknown unit of qpos.hinge 'degs'; did you mean deg"),
        ('"deg"', "2", "unit of qpos.hinge '2'; known: %, 1, cm, deg, in, m, mm, mrad, "),
        ('"deg"', '"rpm"', "qpos.hinge cannot be in 'rpm'; expected one of "),
        ('"deg"', '"mm"', "qpos.hinge cannot be in 'mm'; expected one of rad, mrad, deg, turn"),
        ('"ms"', '"hour"', "unknown unit of time 'hour'; known: min, ms, ns, s, us"),
        ('"ms"', '"deg"', "time cannot be in 'deg'; expected one of s, ms"),
        ("sign = -1, offset", "sign = -2, offset", "qpos.hinge sign = -2; expected 1 or -1"),
        ("sign = -1, offset", "scale = 0, offset", "qpos.hinge scale = 0; expected another number"),
        ("offset = 90", 'offset = "90"', "qpos.hinge offset = '90'; expected a finite number"),
        ("offset", "ofset", "unknown key of [column] qpos.hinge 'ofset'; did you mean offset"),
        ('from = "angle", ', "", 'qpos.hinge lacks from = "NAME"'),
        ('"angle"', '"angel"', "unknown column 'angel'; did you mean angle?"),
    ],
)
def test_refusals(tmp_path, old, new, said):
    assert old in MAP
    path, log = write(tmp_path, MAP.replace(old, new, 1)), save(tmp_path)
    with pytest.raises(UserError) as raised:
        Recording.read(log, MODEL, read_map(path))
    assert said in str(raised.value)
    assert str(path) in str(raised.value) or str(log) in str(raised.value)
    assert "\n" not in str(raised.value)


def test_commands_take_a_map(tmp_path, capsys):
    (tmp_path / "pendulum.xml").write_text(models.PENDULUM)
    model, log = str(tmp_path / "pendulum.xml"), str(save(tmp_path))
    run = ["--out", str(tmp_path / "run")]
    assert cli.main(["compare", model, log, "--map", "no.toml", *run]) == 2
    assert "--map: there is no file no.toml" in capsys.readouterr().err
    assert cli.main(["compare", model, log, *run]) == 2
    assert "mode holds 'swing'" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
    assert cli.main(["compare", model, log, "--map", str(write(tmp_path)), *run]) == 0
    assert (tmp_path / "run" / "compare.json").is_file()
