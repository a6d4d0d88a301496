"""Joints under each other's names in command and state alike: what gravity, inertia and ranges
tell.
"""

from dataclasses import replace

import numpy as np
import pytest
from arm import TOML, XML, commands, record, write_arm, write_dataset
from logs import arm_sequence, late

from gaponet.data.checks.exchanges import mirrored_joints
from gaponet.data.doctor import DoctorResult
from gaponet.sim.dynamics import dynamics_of, gravity_of, inverse_dynamics
from gaponet.sim.model import build_model

ROWS = 400
OTHER = [1, 0]


def motions(arm, **how):
    time = 0.02 * np.arange(1000)[:, None]
    wide = 1.2 * np.sin(2 * np.pi * np.array([0.11, 0.17]) * time + np.array([0.0, 1.0]))
    return [record(arm, wide, "wide", **how), record(arm, commands(ROWS, 0), "usual", **how)]


def exchanged(sequence):
    tau = None if sequence.tau is None else sequence.tau[:, OTHER]
    return replace(
        sequence,
        ctrl=sequence.ctrl[:, OTHER],
        qpos=sequence.qpos[:, OTHER],
        qvel=sequence.qvel[:, OTHER],
        tau=tau,
    )


def with_torque(arm, sequence):
    """The sequence with the torque of its motion, in a unit of its own."""
    qacc = np.gradient(sequence.qvel, sequence.dt, axis=0)
    tau = inverse_dynamics(build_model(arm), sequence.qpos, sequence.qvel, qacc)
    return replace(sequence, tau=0.3 * tau)


def warnings(folder, arm, sequences):
    """Findings of other names."""
    models = {"gravity_model": gravity_of(arm), "dynamics_model": dynamics_of(arm)}
    findings = DoctorResult.of(write_dataset(folder, arm, sequences), arm, **models).findings
    return [f for f in findings if f.check == "order" and f.level == "warning"]


@pytest.mark.parametrize("delay", [0, 3])
def test_names_exchanged_in_command_and_state_show_in_the_distance_to_the_command(
    arm, tmp_path, delay
):
    (finding,) = warnings(tmp_path / "d", arm, [exchanged(s) for s in motions(arm, delay=delay)])
    assert finding.mend == {"names": {"shoulder": "elbow", "elbow": "shoulder"}}


def test_names_exchanged_in_command_state_and_torque_show_in_the_torque(arm, tmp_path):
    logs = [exchanged(with_torque(arm, s)) for s in motions(arm)]
    assert warnings(tmp_path / "d", arm, logs)


@pytest.mark.parametrize("kp", [0.5, 1.0, 2.0])
def test_right_names_are_not_doubted(arm, tmp_path, kp):
    logs = [with_torque(arm, s) for s in motions(arm, kp=kp)]
    assert warnings(tmp_path / "d", arm, logs) == []


def test_positions_that_fit_another_joints_range_only_show_other_names(tmp_path):
    narrow = XML.replace(
        'name="elbow" axis="0 1 0" range="-1.5 1.5"', 'name="elbow" axis="0 0 1" range="1.0 2.5"'
    )
    arm = write_arm(tmp_path / "arm", TOML + "\n", narrow.replace("-1.5 1.5", "-0.8 0.8"))
    flat = arm  # both axes hardly loaded: ranges alone tell
    time = 0.02 * np.arange(ROWS)
    ctrl = np.stack([0.5 * np.sin(time), 1.7 + 0.5 * np.sin(1.3 * time)], axis=1)
    log = record(flat, ctrl, "m")
    assert warnings(tmp_path / "right", flat, [log]) == []
    (finding,) = warnings(tmp_path / "wrong", flat, [exchanged(log)])
    assert finding.mend == {"names": {"shoulder": "elbow", "elbow": "shoulder"}}


def test_counterparts_are_found_by_their_names():
    sides = mirrored_joints(("left_hip", "right_hip", "waist", "FL_calf", "RL_calf"))
    assert sides == {"left and right": {0: 1, 1: 0}, "front and rear": {3: 4, 4: 3}}


def exchanged_legs(tmp_path, left, right):
    """Warnings of a recording of two legs that swing alike, each within its own range."""
    named = XML.replace('name="shoulder"', 'name="left_hip"').replace('"elbow"', '"right_hip"')
    toml = TOML.replace('"shoulder"', '"left_hip"').replace('"elbow"', '"right_hip"')
    ranges = named.replace("-1.5 1.5", left, 1).replace("-1.5 1.5", right, 1)
    robot = write_arm(tmp_path / "legs", toml, ranges)
    swing = 0.2 * np.sin(0.5 * np.arange(30))
    ctrl = np.stack([1.7 + swing, swing], axis=1)
    return warnings(tmp_path / "data", robot, [arm_sequence(robot, ctrl, late(ctrl, 1))])


def test_ranges_alone_tell_legs_exchanged_where_few_rows_were_recorded(tmp_path):
    """30 rows are too few for torques. Left and right name the same exchange as the pair does."""
    (finding,) = exchanged_legs(tmp_path, "-0.8 0.8", "1.0 2.5")
    assert finding.mend == {"names": {"left_hip": "right_hip", "right_hip": "left_hip"}}
    assert "left and right" in finding.message
    assert "other" in finding.message


def test_positions_outside_of_every_range_are_no_exchange(tmp_path):
    assert exchanged_legs(tmp_path, "-0.8 0.8", "-0.8 0.8") == []
