"""Simulated replays: rollouts under recorded commands."""

from dataclasses import replace

import numpy as np
from arm import commands, record, recordings, write_arm

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.data.store import Dataset
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import Scene, load_robot
from gaponet.sim.model import build_model, model_hash
from gaponet.sim.replay import idle_limbs, pair_dataset, replay


def test_the_replay_of_the_nominal_robot_is_bit_identical(tmp_path):
    robot = write_arm(tmp_path)
    # Rows are stored as float32; a start that float32 holds exactly starts the replay exactly.
    sequences = []
    for seed, rows in enumerate((60, 90)):
        ctrl = np.round(commands(rows, seed) * 256) / 256
        sequences.append(record(robot, ctrl, f"m{seed}"))
    for sequence, simulated in zip(sequences, replay(sequences, robot), strict=True):
        np.testing.assert_array_equal(sequence.qpos, simulated.qpos)
        np.testing.assert_array_equal(sequence.qvel, simulated.qvel)


def test_sequences_of_any_length_and_payload_run_side_by_side(tmp_path):
    robot = write_arm(tmp_path)
    sequences = []
    for rows in (40, 120, 80):
        sequences.append(record(robot, commands(rows, rows), f"m{rows}", payload=rows / 500))
    together = replay(sequences, robot)
    for sequence, simulated in zip(sequences, together, strict=True):
        alone = replay([sequence], robot)[0]
        np.testing.assert_array_equal(simulated.qpos, alone.qpos)
        assert simulated.qpos.shape == sequence.qpos.shape


def test_each_recording_runs_at_its_own_gains(tmp_path):
    robot = write_arm(tmp_path)
    ctrl = np.round(commands(60, 1) * 256) / 256
    sequences = []
    for kp, kd in ((8.0, 0.0), (20.0, 0.0), (40.0, 1.0)):
        told = {"kp": (kp, kp), "kd": (kd, kd)}
        made = record(robot.with_gains(*told.values()), ctrl, f"at {kp}")
        sequences.append(replace(made, meta=replace(made.meta, **told)))
    for sequence, simulated in zip(sequences, replay(sequences, robot), strict=True):
        np.testing.assert_array_equal(sequence.qpos, simulated.qpos)
    soft = sequences[0]
    untold = replace(soft, meta=replace(soft.meta, notes={"gains": "of robot.toml"}))
    assert np.abs(replay([untold], robot)[0].qpos - soft.qpos).max() > 0.01


def test_an_identified_gain_scales_with_the_recorded_one(tmp_path):
    robot = write_arm(tmp_path)
    found = robot.with_identified({"elbow": {"kp": 16.0}})
    set_to = found.with_gains((10.0, 10.0), None)
    np.testing.assert_allclose(set_to.servo.kp, [10.0, 8.0])
    np.testing.assert_allclose(set_to.nominal.servo.kp, 10.0)
    assert found.with_gains((20.0, 20.001), (0.0, 0.0)) is found


def test_a_replay_uses_only_the_first_recorded_row(tmp_path):
    robot = write_arm(tmp_path)
    weak = record(robot, commands(50, 3), "m", kp=0.5)
    strong = record(robot, commands(50, 3), "m", kp=2.0)
    (one,) = replay([weak], robot)
    (other,) = replay([strong], robot)
    np.testing.assert_array_equal(one.qpos, other.qpos)


def test_pairing_is_done_once_per_simulator(tmp_path):
    robot = write_arm(tmp_path / "arm")
    dataset = Dataset.create(tmp_path / "data", robot)
    for sequence in recordings(robot, 3, kp=0.7):
        dataset.append(sequence)
    assert pair_dataset(dataset, robot) == 3
    assert pair_dataset(dataset, robot) == 0
    pair = dataset.pair(dataset.entries[0], model_hash(robot))
    np.testing.assert_array_equal(pair.gap[0], 0)
    assert np.abs(pair.gap).max() > 0.01


def test_clamping_idle_limbs_changes_nothing_for_the_others():
    robot = load_robot("h1_2")
    ctrl = np.tile(robot.qpos_home, (40, 1))
    ctrl[:, robot.index(["left_elbow_joint"])] = 0.4 * np.sin(np.arange(40) / 6)[:, None]
    meta = SequenceMeta("h1_2", "a", "elbow", 1.0)
    sequence = Sequence(meta, robot.joint_names, robot.dt, ctrl, ctrl, np.zeros_like(ctrl))
    legs = []
    for joint in robot.joint_names:
        if "hip" in joint or "knee" in joint or "ankle" in joint:
            legs.append(joint)
    assert idle_limbs([sequence], robot) == tuple(legs)
    (whole,) = replay([sequence], robot, lock_idle=False)
    (arms,) = replay([sequence], robot, lock_idle=True)
    operated = robot.operated_index
    np.testing.assert_allclose(whole.qpos[:, operated], arms.qpos[:, operated], atol=1e-6)


def test_a_simulator_without_payload_ignores_the_recorded_payload(arm):
    empty = record(arm, commands(60, 1), "m", payload=0.0)
    laden = record(arm, commands(60, 1), "m", payload=0.2)
    bare = replace(arm, scene=Scene(carries_payload=False))
    (own,) = replay([laden], bare)
    (told,) = replay([laden], arm)
    assert np.abs(own.qpos - told.qpos).max() > 1e-3
    (same,) = replay([replace(laden, meta=empty.meta)], arm)
    np.testing.assert_array_equal(own.qpos, same.qpos)


def test_a_simulator_without_payload_has_another_hash_and_survives_its_folder(arm, tmp_path):
    bare = replace(arm, scene=Scene(carries_payload=False))
    assert model_hash(bare) != model_hash(arm)
    save_robot(bare, tmp_path / "bare")
    again = load_robot(tmp_path / "bare")
    assert not again.scene.carries_payload
    assert model_hash(again) == model_hash(bare)
    assert build_model(again, 0.2).body_mass.sum() == build_model(arm).body_mass.sum()
