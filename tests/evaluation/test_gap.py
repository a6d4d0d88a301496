"""Where the gap comes from: steps, causes and floor."""

import json
from dataclasses import replace

import numpy as np
import pytest
from arm import recordings, write_arm
from runs import untrained

from gaponet.data.repeatability import Repetitions
from gaponet.data.signals import encoder_step
from gaponet.data.store import Dataset
from gaponet.evaluation.candidate import Candidate
from gaponet.evaluation.gap import CAUSES, cause_steps, error_floor, gap_by_step, reductions
from gaponet.evaluation.methods import title
from gaponet.evaluation.run_files import read_gap
from gaponet.evaluation.verdict import LEARNED
from gaponet.report.figures.evaluation import waterfall
from gaponet.robot.folder import save_robot
from gaponet.sim.metrics import Run
from gaponet.sim.model import model_hash
from gaponet.sim.replay import replay, rollout_errors


def test_the_encoder_step_is_estimated_from_recordings():
    rng = np.random.default_rng(0)
    angle = np.cumsum(rng.normal(0, 0.01, 4000))
    step = 2 * np.pi / 4096
    assert encoder_step([(np.round(angle / step) * step).astype(np.float32)]) == pytest.approx(
        step, rel=1e-3
    )
    assert encoder_step([angle.astype(np.float32)]) == 0.0


def test_the_floor_is_what_two_repetitions_differ_by(tmp_path):
    robot = write_arm(tmp_path / "arm")
    first = recordings(robot, 1, rows=400)[0]
    noise = np.random.default_rng(1).normal(0, 0.002, (2, *first.qpos.shape))
    same = [replace(first, qpos=(first.qpos + n).astype(np.float32)) for n in noise]
    for joint in error_floor(same, robot).values():
        assert joint["repeatability"] == pytest.approx(0.002 * np.sqrt(2 / np.pi), rel=0.1)
        assert joint["both"] == joint["repeatability"]
    assert all(f["repeatability"] is None for f in error_floor(same[:1], robot).values())


@pytest.mark.parametrize("kind", LEARNED)
def test_every_kind_of_model_has_its_bar(kind):
    steps = {"nominal": 0.01, "delay": 0.008, "offset": 0.007, "identified": 0.004, kind: 0.002}
    floor = {"encoder": 0.0005, "repeatability": None, "both": 0.0005}
    found = {
        "left": steps,
        "floor": floor,
        "by_joint": {"elbow_joint": {"left": steps, "floor": floor}},
        "virtual": True,
        "robot": "arm",
        "sequences": 3,
        "unseen": True,
    }
    ax = waterfall(found).axes[0]
    ticks = [t.get_text() for t in ax.get_yticklabels()]
    assert ticks == [*map(title, steps), "remaining"]
    assert ax.patches[4].get_width() == pytest.approx(2.0)  # what the model removes, mrad


def test_a_run_has_its_steps_and_its_figure(arm, tmp_path):
    kind = "gaponet"
    data = Dataset.create(tmp_path / "data", arm)
    for sequence in recordings(arm, 3, rows=60, kp=0.5):
        data.append(sequence)
    motions = sorted({e.meta.motion for e in data.entries})
    run = untrained(
        tmp_path / "run", arm, data, kind, train=motions[:1], val=motions[1:2], test=motions[2:]
    )
    found = gap_by_step(Candidate.load(run, arm), data)
    assert list(found["left"]) == ["nominal", "delay", "offset", kind]
    assert found["left"][kind] == pytest.approx(
        found["left"]["nominal"], rel=0.2
    )  # it corrects nothing yet
    assert found["floor"] == {"encoder": None, "repeatability": None, "both": None}
    (run / "gap.json").write_text(json.dumps(found))
    for shown in (found, read_gap(run)):
        assert [ax.get_title("right") for ax in waterfall(shown).axes if ax.get_visible()] == [
            "floor –"
        ] * 3


def test_bars_and_floor_carry_their_values():
    panel = {"left": {"nominal": 0.01, "delay": 0.012, "mlp": 0.002}, "floor": {"both": 0.0005}}
    found = panel | {
        "by_joint": {"elbow": panel},
        "virtual": True,
        "robot": "arm",
        "sequences": 3,
        "unseen": True,
    }
    ax = waterfall(found).axes[1]
    assert [t.get_text() for t in ax.texts] == ["+2.0", "−10.0", "2.0", "10.0"]
    assert ax.get_title("right") == "floor 0.5"


def test_causes_lead_from_the_nominal_simulator_to_the_identified_one(tmp_path):
    robot = write_arm(tmp_path / "arm")
    found = robot.with_identified(
        {"elbow": {"kp": 15.0, "frictionloss": 0.1, "stribeck": 0.05, "stribeck_speed": 0.1}}
    )
    steps = cause_steps(found)
    assert [step.name for step in steps] == ["gain", "friction", "creep", "stribeck"]
    assert model_hash(steps[-1].simulator) == model_hash(found)
    assert steps[0].simulator.servo.frictionloss[1] != 0.1
    assert cause_steps(robot) == []


def test_a_servo_with_less_damping_than_its_files_kd_is_the_last_step_too(tmp_path):
    robot = write_arm(tmp_path / "arm")
    robot = robot.with_servo(kd=np.full_like(robot.servo.kd, 0.5))
    found = robot.with_identified({"elbow": {"damping": -0.3}})
    assert found.servo.kd[1] == pytest.approx(0.2)
    assert model_hash(cause_steps(found)[-1].simulator) == model_hash(found)


def test_the_reduction_by_a_step_has_a_standard_error_over_motions(tmp_path):
    robot = write_arm(tmp_path / "arm")
    sequences = recordings(robot, 3, rows=50)
    off = lambda sizes: [  # noqa: E731
        Run.of(s, s.qpos + x, robot) for s, x in zip(sequences, sizes, strict=True)
    ]
    done = {"nominal": off([0.03, 0.02, 0.01]), "gain": off([0.02, 0.01, 0.0])}
    assert reductions(done)["gain"] == pytest.approx([0.01, 0.0], abs=1e-6)
    less, error = reductions({"nominal": off([0.03, 0.03, 0.03]), "gain": off([0.0, 0.01, 0.02])})[
        "gain"
    ]
    assert (less, error) == pytest.approx((0.02, 0.01 / np.sqrt(3)), abs=1e-6)


def test_a_motion_that_repeats_itself_tells_repeatability(tmp_path):
    robot = write_arm(tmp_path / "arm")
    once = recordings(robot, 1, rows=60)[0]
    start, noise = once.ctrl[:1] + 0.3, np.random.default_rng(1).normal(0, 0.002, (270, 2))
    qpos = np.concatenate([np.tile(once.qpos, (5, 1))[:270] + noise, once.qpos[:1]])
    thrice = replace(
        once,
        ctrl=np.tile(once.ctrl, (5, 1))[:270],
        qpos=qpos[:270].astype(np.float32),
        qvel=np.zeros((270, 2), np.float32),
    )
    assert [len(p) for p in Repetitions.periods(thrice)] == [
        60,
        60,
        60,
    ]  # without the first, and the last is not whole
    for joint in error_floor([thrice], robot).values():
        assert joint["repeatability"] == pytest.approx(0.002 * np.sqrt(2 / np.pi), rel=0.1)
    assert not Repetitions.periods(once)
    assert not Repetitions.periods(replace(thrice, ctrl=np.concatenate([thrice.ctrl[:-1], start])))


def test_friction_creeps_only_with_the_option(tmp_path):
    robot = write_arm(tmp_path / "arm")
    stiff = {"kp": 20.0, "frictionloss": 2.0, "armature": 0.002}
    heavy = robot.with_identified(dict.fromkeys(robot.joint_names, stiff))
    still = recordings(robot, 1, rows=100)[0]
    held = replace(
        still, ctrl=np.repeat(still.qpos[:1] + 0.05, 100, axis=0), qvel=np.zeros_like(still.qvel)
    )
    moved = [
        np.abs(np.ptp(replay([held], heavy, creeps=c)[0].qpos, axis=0)).max() for c in (False, True)
    ]
    assert moved[1] > 5 * moved[0]


def test_the_steps_of_an_identified_simulator_are_those_that_a_report_reads(tmp_path):
    panel = {
        "left": dict.fromkeys(
            ["nominal", "delay", "offset", *CAUSES, "creep", "identified+gaponet"], 0.01
        )
    }
    panel |= {"floor": {"both": 0.001}}
    gap = panel | {
        "by_joint": {"elbow": panel},
        "virtual": True,
        "unseen": True,
        "sequences": 1,
        "robot": "arm",
    }
    (tmp_path / "gap.json").write_text(json.dumps(gap))
    assert read_gap(tmp_path)["left"].keys() == panel["left"].keys()


def test_a_joint_that_nobody_recorded_has_no_bar_and_dilutes_nothing(tmp_path):
    robot = write_arm(tmp_path / "arm")
    data = Dataset.create(tmp_path / "data", robot)
    for s in recordings(robot, 3, rows=200):
        data.append(replace(s, meta=replace(s.meta, notes={"posture": {"elbow": 0.0}})))
    stiffer = robot.with_identified({"shoulder": {"kp": 30.0}})
    found = gap_by_step(Candidate(stiffer.folder, stiffer, None), data)
    assert list(found["by_joint"]) == ["shoulder"]
    assert found["removed"]["gain"] == pytest.approx(
        found["by_joint"]["shoulder"]["removed"]["gain"]
    )
    both = rollout_errors(data.sequences(data.entries), robot)
    assert both.mean() == pytest.approx(
        found["methods"]["nominal"]["by_joint"]["shoulder"]["mpjae"], rel=1e-3
    )


def test_a_gap_that_is_measured_again_simulates_nothing(tmp_path, monkeypatch):
    robot = write_arm(tmp_path / "arm")
    data = Dataset.create(tmp_path / "data", robot)
    for sequence in recordings(robot, 3, rows=60, kp=0.5):
        data.append(sequence)
    changed = {"kp": 15.0, "frictionloss": 0.1}
    fitted = robot.with_identified(dict.fromkeys(robot.joint_names, changed))
    save_robot(fitted, tmp_path / "fitted")
    candidate = Candidate.load(tmp_path / "fitted", robot)
    first = gap_by_step(candidate, data)
    monkeypatch.delattr("gaponet.sim.replay.rollout")
    assert gap_by_step(candidate, Dataset(data.path)) == first
    assert first["left"]["friction"] != first["left"]["creep"]
