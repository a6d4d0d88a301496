"""Recordings in which the doctor finds an error are refused before anything is learned from
them.
"""

from dataclasses import replace

import numpy as np
import pytest
from arm import recordings, write_dataset
from logs import arm_sequence, late, wave

from gaponet.base.errors import DatasetError
from gaponet.data.checks.gate import TORQUE_DRIVEN_CHECKS, pass_gate, used_recordings
from gaponet.data.doctor import DoctorResult
from gaponet.data.signals import lowpass
from gaponet.data.split import split_entries
from gaponet.robot.finding import errors_of

ROWS = 600


def white_noise(ctrl, qpos):
    noise = np.random.default_rng(0)
    return ctrl, noise.normal(0.0, 0.3, qpos.shape)


def opposite_sign(ctrl, qpos):
    return ctrl, -qpos


def states_before_commands(ctrl, qpos):
    return qpos, ctrl


def degrees(ctrl, qpos):
    return ctrl, qpos * [1.0, 57.3]


def swapped_joints(ctrl, qpos):
    return ctrl, qpos[:, ::-1]


def a_copy(ctrl, qpos):
    return ctrl, ctrl


def a_stuck_joint(ctrl, qpos):
    return ctrl, qpos * [1.0, 0.0]


# What is wrong → check whose error says so.
WRONG = {
    white_noise: "command",
    opposite_sign: "sign",
    states_before_commands: "copied",
    degrees: "unit",
    swapped_joints: "order",
    a_copy: "copied",
    a_stuck_joint: "stuck",
}


def motions(robot, change=lambda ctrl, qpos: (ctrl, qpos), unit="a"):
    """Four motions of a robot that follows its commands three periods late, with a fault."""
    logs = []
    for number in range(4):
        ctrl = wave(ROWS, 2, 0.02, 0.4, 0.4 + 0.05 * number)
        faulty = change(ctrl, late(ctrl, 3))
        logs.append(arm_sequence(robot, *faulty, motion=f"m{number}", unit=unit))
    return logs


@pytest.mark.parametrize("fault", WRONG, ids=lambda fault: fault.__name__)
def test_what_the_doctor_calls_an_error_is_refused_with_the_finding_and_the_way_out(
    arm, tmp_path, fault
):
    data = write_dataset(tmp_path / "data", arm, motions(arm, fault))
    with pytest.raises(DatasetError) as refusal:
        pass_gate(data, data.entries, arm)
    text = str(refusal.value)
    assert text.startswith(f"{tmp_path / 'data'}: stopped at what the doctor calls an error")
    assert f" {WRONG[fault]}: " in text
    assert "gaponet doctor DATASET --fix" in text
    assert text.endswith("--despite-errors (Python: despite_errors=True)")


@pytest.mark.parametrize("fault", WRONG, ids=lambda fault: fault.__name__)
def test_the_gate_finds_the_errors_of_the_doctor(arm, tmp_path, fault):
    data = write_dataset(tmp_path / "data", arm, motions(arm, fault))
    found = pass_gate(data, data.entries, arm, despite_errors=True)
    examined = errors_of(DoctorResult.of(data, arm).findings)
    assert [(f.check, f.message) for f in found.errors] == [(f.check, f.message) for f in examined]


def test_one_recording_under_two_labels_is_refused(arm, tmp_path):
    logs = motions(arm)
    twice = replace(logs[0], meta=replace(logs[0].meta, payload_mass=0.2))
    data = write_dataset(tmp_path / "data", arm, [*logs, twice])
    with pytest.raises(DatasetError, match="labels"):
        pass_gate(data, data.entries, arm)


def test_clocks_that_drift_apart_are_refused(arm, tmp_path):
    logs = []
    rows = np.arange(900)
    for seed in range(5):
        steps = np.random.default_rng(seed).uniform(-0.5, 0.5, (30, 2))
        ctrl = np.repeat(steps, 30, axis=0)
        qpos = late(lowpass(ctrl, arm.dt, 4.0), 4)
        fast_clock = np.stack([np.interp(1.003 * rows, rows, q) for q in qpos.T], axis=1)
        logs.append(arm_sequence(arm, ctrl, fast_clock, motion=f"m{seed}"))
    data = write_dataset(tmp_path / "data", arm, logs)
    with pytest.raises(DatasetError, match="clock"):
        pass_gate(data, data.entries, arm)


def test_recordings_without_an_error_pass_and_keep_their_warnings(arm, tmp_path):
    logs = motions(arm, lambda ctrl, qpos: (ctrl, qpos * [1.0, 1.3]))
    data = write_dataset(tmp_path / "data", arm, logs)
    found = pass_gate(data, data.entries, arm)
    assert found.errors == ()
    assert "elbow goes 1.30 rad" in found.to_dict()["warnings"][0]


def test_a_unit_that_is_held_out_is_not_examined(arm, tmp_path):
    logs = [*motions(arm, unit="good"), *motions(arm, opposite_sign, unit="bad")]
    data = write_dataset(tmp_path / "data", arm, logs)
    used = used_recordings(data, split_entries(data, ("bad",)))
    assert {entry.meta.unit_id for entry in used} == {"good"}
    assert len(used) == 4
    assert pass_gate(data, used, arm).errors == ()


def test_without_position_commands_a_state_that_equals_its_command_is_no_error(arm, tmp_path):
    data = write_dataset(tmp_path / "data", arm, motions(arm, a_copy))
    assert pass_gate(data, data.entries, arm, checks=TORQUE_DRIVEN_CHECKS).errors == ()


def test_progress_counts_the_recordings(arm, tmp_path):
    data = write_dataset(tmp_path / "data", arm, recordings(arm, 3))
    seen = []
    pass_gate(data, data.entries, arm, progress=lambda *at: seen.append(at[:2]))
    assert seen == [(1, 3), (2, 3), (3, 3)]
