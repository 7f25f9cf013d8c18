"""What a bag's topics say between their messages: angles, quaternions, joints of one topic."""

import numpy as np
import pandas as pd
import pytest

from tests.diagnosis import test_convert_logs as logs
from tests.diagnosis.test_convert_logs import ANGLE, RATE, STAMPS, convert_only, stamp, write_bag

AT_HINGE = '"qpos.hinge" = "/joint_states.position[hinge]"'


def read_between(folder, joints_at, columns):
    """Convert what lies at commands' stamps, 1 ms before those of the states."""
    log = write_bag(folder, "mcap", joints_at)
    columns = f'"ctrl.motor" = "/effort.data"\n{columns}'
    assert convert_only(folder, log, columns, 'clock = "log"') == 0
    return pd.read_csv(folder / "data.csv")


def test_an_angle_that_begins_anew_is_not_interpolated_across_the_jump(tmp_path):
    angle = (np.pi + 20.0 * STAMPS) % (2 * np.pi) - np.pi
    made = read_between(tmp_path, lambda k: (["hinge"], [angle[k]]), AT_HINGE)
    steps = np.diff(np.unwrap(made["qpos.hinge"]))
    assert np.abs(np.diff(made["qpos.hinge"])).max() > 6.0
    assert steps == pytest.approx(20.0 / RATE, rel=0.6)


def test_a_quaternion_whose_sign_flips_stays_of_length_1(tmp_path):
    turn = 3.0 * STAMPS
    quaternion = np.stack([np.cos(turn), np.sin(turn), 0 * turn, 0 * turn], axis=1)
    quaternion *= np.where(quaternion[:, :1] < 0, -1.0, 1.0)  # a logger that keeps w ≥ 0
    columns = "\n".join(f'"qpos.ball.{i}" = "/joint_states.position[{i}]"' for i in range(4))
    made = read_between(tmp_path, lambda k: (["a", "b", "c", "d"], quaternion[k]), columns)
    length = np.linalg.norm(made[[f"qpos.ball.{i}" for i in range(4)]], axis=1)
    assert length == pytest.approx(np.ones(len(made)), abs=1e-3)


@pytest.mark.parametrize("name", ["hinge", "1"])
def test_joints_that_share_a_topic_with_others_are_read(tmp_path, name):
    def by_turns(k):
        others = (["gripper", "finger"], [0.0, 0.0]), ([], []), ([], [0.0, 0.0])
        return ([name], [ANGLE[k]]) if k % 2 else others[k // 2 % 3]

    made = read_between(tmp_path, by_turns, AT_HINGE.replace("[hinge]", f"[{name}]"))
    at = 0.014 + np.arange(len(made)) / RATE
    assert made["qpos.hinge"].to_numpy() == pytest.approx(np.interp(at, STAMPS, ANGLE), abs=0.2)


def test_hinges_with_numbers_for_names_keep_their_signs(tmp_path):
    angles = 0.1 * np.arange(1, 5)[:, None] * np.sin(9 * STAMPS)
    columns = "\n".join(f'"qpos.arm.{i}" = "/joint_states.position[{i}]"' for i in range(4))
    made = read_between(tmp_path, lambda k: (["a", "b", "c", "d"], [*angles[:, k]]), columns)
    at = 0.006 + np.arange(len(made)) / RATE
    for i in range(4):
        between = np.interp(at, STAMPS, angles[i])
        assert made[f"qpos.arm.{i}"].to_numpy() == pytest.approx(between, abs=0.002)


def test_a_sign_is_mended_although_a_driver_began_with_zeros(tmp_path):
    turn = 3.0 * STAMPS
    quaternion = np.stack([np.cos(turn), np.sin(turn), 0 * turn, 0 * turn], axis=1)
    quaternion *= np.where(np.arange(len(turn)) % 2, -1.0, 1.0)[:, None]
    quaternion[0] = 0.0
    columns = "\n".join(f'"qpos.ball.{i}" = "/joint_states.position[{i}]"' for i in range(4))
    made = read_between(tmp_path, lambda k: (["a", "b", "c", "d"], [*quaternion[k]]), columns)
    length = np.linalg.norm(made[[f"qpos.ball.{i}" for i in range(4)]], axis=1)
    assert length[1:] == pytest.approx(np.ones(len(made) - 1), abs=1e-3)


def test_messages_that_come_in_bursts_leave_no_gaps(tmp_path, monkeypatch):
    def in_bursts(store, seconds):
        k = round(seconds * RATE)
        return stamp(store, (k // 5) * 5 / RATE + (k % 5) * 2e-4)

    monkeypatch.setattr(logs, "stamp", in_bursts)
    log = write_bag(tmp_path, "mcap")
    columns = f'"ctrl.motor" = "/effort.data"\n{AT_HINGE}'
    assert convert_only(tmp_path, log, columns) == 0
    assert len(pd.read_csv(tmp_path / "data.csv")) > 50


def test_states_are_not_invented_across_a_gap(tmp_path):
    def silent_for_a_while(k):
        return ([], []) if 20 <= k < 40 else (["hinge"], [ANGLE[k]])

    made = read_between(tmp_path, silent_for_a_while, AT_HINGE)
    steps = np.diff(made["time"])
    assert np.count_nonzero(steps > 0.2) == 1
    assert np.median(steps) == pytest.approx(1 / RATE)


def test_a_clock_that_begins_anew_is_refused(tmp_path, capsys, monkeypatch):
    def begun_anew(store, seconds):
        return stamp(store, seconds if seconds < 0.3 else seconds - 0.25)

    monkeypatch.setattr(logs, "stamp", begun_anew)
    log = write_bag(tmp_path, "mcap")
    columns = f'"ctrl.motor" = "/effort.data"\n{AT_HINGE}'
    assert convert_only(tmp_path, log, columns) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "go back by 0.24 s at message 31" in line
    assert 'set clock = "log"' in line
    assert convert_only(tmp_path, log, columns, 'clock = "log"') == 0
