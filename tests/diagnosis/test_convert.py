"""Published recordings become recordings that fit their models."""

import mujoco
import numpy as np
import pytest
from scipy import io

from garat_jax.diagnosis import Recording, convert
from garat_jax.errors import UserError


def check(converted):
    model = mujoco.MjModel.from_xml_path(str(converted.model))
    return model, [Recording.read(path, model) for path in (*converted.fit, *converted.holdout)]


def test_free_pendulum_hangs_at_pi(tmp_path):
    cell = np.empty(2, object)
    cell[:] = [np.arange(50.0)[:, None] * 1e-3 + 7.0] * 2
    state = np.empty(2, object)
    state[:] = [np.tile([[3.0], [0.0]], 50)] * 2
    content = {"Time_id": cell, "Y_id": state, "Time_vad": cell[:1], "Y_vad": state[:1]}
    io.savemat(tmp_path / convert.FREE_PENDULUM_FILE, content)
    converted = convert.free_pendulum(tmp_path, tmp_path / "out")
    assert (len(converted.fit), len(converted.holdout)) == (2, 1)
    model, recordings = check(converted)
    assert recordings[0].time[0] == 0.0
    data = mujoco.MjData(model)
    data.qpos[0] = np.pi
    mujoco.mj_forward(model, data)
    assert data.qacc[0] == pytest.approx(0.0, abs=1e-9)
    assert data.xipos[1, 2] < 0
    # The published inertia about the pivot and the frequency that follows from it.
    data.qpos[0] = np.pi - 1e-4
    mujoco.mj_forward(model, data)
    inertia = 1.09119e-4 + 0.147585 * 0.147755**2
    expected = 0.147585 * 9.81 * 0.147755 / inertia * 1e-4
    assert data.qacc[0] == pytest.approx(expected, rel=1e-4)


def cells(*arrays):
    made = np.empty(len(arrays), object)
    made[:] = arrays
    return made


TIMES, STATES = np.arange(50.0)[:, None] * 1e-3, np.zeros((2, 50))


@pytest.mark.parametrize(
    "wrong",
    [
        {"Y_vad": cells(STATES[:, :7])},
        {"Y_vad": cells(STATES[:1])},
        {"Y_vad": cells(STATES, STATES)},
        {"Y_vad": cells("swing")},
        {"Y_vad": STATES},
        {"Time_vad": cells(TIMES[:0]), "Y_vad": cells(STATES[:, :0])},
    ],
)
def test_other_segments_of_the_free_pendulum_are_refused(tmp_path, wrong):
    right = {"Time_id": cells(TIMES), "Time_vad": cells(TIMES)}
    right |= {"Y_id": cells(STATES), "Y_vad": cells(STATES)}
    io.savemat(tmp_path / convert.FREE_PENDULUM_FILE, right)
    convert.free_pendulum(tmp_path, tmp_path / "right")
    io.savemat(tmp_path / convert.FREE_PENDULUM_FILE, right | wrong)
    with pytest.raises(UserError, match=r"no recording of the free pendulum: .*; expected cells"):
        convert.free_pendulum(tmp_path, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_matlab_file_cut_short_is_refused(tmp_path):
    path = tmp_path / convert.FREE_PENDULUM_FILE
    io.savemat(path, {"Time_id": cells(TIMES), "Y_id": cells(STATES)})
    path.write_bytes(path.read_bytes()[:900])
    with pytest.raises(UserError, match=f"{path.name}: cannot be read as MAT: "):
        convert.free_pendulum(tmp_path, tmp_path / "out")


def test_another_run_of_the_motor_pendulum_is_refused(tmp_path):
    name, _ = convert.MOTOR_PENDULUM_RUNS["ddp"]
    (tmp_path / name).write_text("time,positions,velocity,torque\n0,0,0,0\n")
    with pytest.raises(UserError, match="unknown column 'position'; did you mean positions"):
        convert.motor_pendulum(tmp_path, tmp_path / "out", ["ddp"])


def test_a_folder_without_the_recording_is_refused(tmp_path):
    with pytest.raises(UserError, match="there is no SinglePendulumData"):
        convert.free_pendulum(tmp_path, tmp_path / "out")


def test_another_matlab_file_is_refused(tmp_path):
    io.savemat(tmp_path / convert.FREE_PENDULUM_FILE, {"x": 1.0})
    with pytest.raises(UserError, match="no recording of the free pendulum: 'Time_id'"):
        convert.free_pendulum(tmp_path, tmp_path / "out")


def test_motor_pendulum_has_the_published_moment(tmp_path):
    model = mujoco.MjModel.from_xml_string(convert.MOTOR_PENDULUM_MJCF)
    data = mujoco.MjData(model)
    data.qpos[0] = np.pi / 2
    mujoco.mj_forward(model, data)
    assert model.body("rod").mass[0] == pytest.approx(0.676)
    assert abs(data.qfrc_bias[0]) == pytest.approx(0.676 * 0.45 * 9.81, rel=1e-3)


def test_real_free_pendulum(tmp_path, shared_data):
    _, recordings = check(convert.free_pendulum(shared_data / "free_pendulum", tmp_path))
    assert len(recordings) == 6
    assert all(r.velocity_measured and not r.warnings for r in recordings)


def test_real_motor_pendulum(tmp_path, shared_data):
    converted = convert.motor_pendulum(
        shared_data / "motor_pendulum", tmp_path, ["ddp", "sac"], ["energy_shaping"]
    )
    _, recordings = check(converted)
    assert [round(float(r.time[-1])) for r in recordings] == [3, 3, 4]
    assert all(r.ctrl.std() > 0.1 and not r.warnings for r in recordings)
