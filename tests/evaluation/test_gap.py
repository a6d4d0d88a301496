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
from gaponet.robot.servo_fields import SERVO_FIELDS
from gaponet.sim.metrics import Run
from gaponet.sim.model import model_hash
from gaponet.sim.replay import replay, rollout_errors


def test_the_encoder_step_is_estimated_from_recordings():
    rng = np.random.default_rng(0)
    angle = np.cumsum(rng.normal(0, 0.01, 4000))
    step = 2 * np.pi / 4096
    read = np.round(angle / step) * step
    assert encoder_step([read.astype(np.float32)]) == pytest.approx(step, rel=1e-3)
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


@pytest.fixture
def run(arm, tmp_path):
    """A run that corrects nothing yet, and its steps."""
    data = Dataset.create(tmp_path / "data", arm)
    for sequence in recordings(arm, 3, rows=60, kp=0.5):
        data.append(sequence)
    train, val, test = sorted({entry.meta.motion for entry in data.entries})
    made = untrained(
        tmp_path / "run", arm, data, "gaponet", train=(train,), val=(val,), test=(test,)
    )
    return made, gap_by_step(Candidate.load(made, arm), data)


def test_a_run_has_its_steps(run):
    _, found = run
    left = found["left"]
    assert list(left) == ["nominal", "delay", "offset", "gaponet"]
    assert left["gaponet"] == pytest.approx(left["nominal"], rel=0.2)
    assert found["floor"] == {"encoder": None, "repeatability": None, "both": None}


def test_a_run_has_its_figure(run):
    folder, found = run
    (folder / "gap.json").write_text(json.dumps(found))
    for shown in (found, read_gap(folder)):
        panels = [ax for ax in waterfall(shown).axes if ax.get_visible()]
        assert [ax.get_title("right") for ax in panels] == ["floor –"] * 3


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
    elbow = {"kp": 15.0, "frictionloss": 0.1, "stribeck": 0.05, "stribeck_speed": 0.1}
    found = robot.with_identified({"elbow": elbow})
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

    def off(*sizes):
        made = []
        for s, size in zip(sequences, sizes, strict=True):
            made.append(Run.of(s, s.qpos + size, robot))
        return made

    alike = {"nominal": off(0.03, 0.02, 0.01), "gain": off(0.02, 0.01, 0.0)}
    assert reductions(alike)["gain"] == pytest.approx((0.01, 0.0), abs=1e-6)
    apart = {"nominal": off(0.03, 0.03, 0.03), "gain": off(0.0, 0.01, 0.02)}
    assert reductions(apart)["gain"] == pytest.approx((0.02, 0.01 / np.sqrt(3)), abs=1e-6)


@pytest.fixture
def repeated(arm):
    """A motion of 60 rows, four and a half times, read with noise."""
    once = recordings(arm, 1, rows=60)[0]
    noise = np.random.default_rng(1).normal(0, 0.002, (270, 2))
    qpos = np.tile(once.qpos, (5, 1))[:270] + noise
    ctrl = np.tile(once.ctrl, (5, 1))[:270]
    qvel = np.zeros((270, 2), np.float32)
    return replace(once, ctrl=ctrl, qpos=qpos.astype(np.float32), qvel=qvel)


def test_periods_are_whole_and_without_the_first(repeated):
    assert [len(period) for period in Repetitions.periods(repeated)] == [60, 60, 60]


def test_a_motion_that_repeats_itself_tells_repeatability(arm, repeated):
    for joint in error_floor([repeated], arm).values():
        assert joint["repeatability"] == pytest.approx(0.002 * np.sqrt(2 / np.pi), rel=0.1)


def test_a_motion_that_does_not_repeat_itself_has_no_periods(repeated):
    other_end = repeated.ctrl.copy()
    other_end[-1] = repeated.ctrl[0] + 0.3
    assert not Repetitions.periods(repeated.rows(slice(60)))
    assert not Repetitions.periods(replace(repeated, ctrl=other_end))


def test_friction_creeps_only_with_the_option(tmp_path):
    robot = write_arm(tmp_path / "arm")
    stiff = {"kp": 20.0, "frictionloss": 2.0, "armature": 0.002}
    heavy = robot.with_identified(dict.fromkeys(robot.joint_names, stiff))
    still = recordings(robot, 1, rows=100)[0]
    ctrl = np.repeat(still.qpos[:1] + 0.05, 100, axis=0)
    held = replace(still, ctrl=ctrl, qvel=np.zeros_like(still.qvel))
    (stuck,) = replay([held], heavy, creeps=False)
    (creeping,) = replay([held], heavy, creeps=True)
    assert np.ptp(creeping.qpos, axis=0).max() > 5 * np.ptp(stuck.qpos, axis=0).max()


def test_the_steps_of_an_identified_simulator_are_those_that_a_report_reads(tmp_path):
    steps = ["nominal", *CAUSES, "creep", "identified+gaponet"]
    panel = {"left": dict.fromkeys(steps, 0.01), "floor": {"both": 0.001}}
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
    shoulder = found["by_joint"]["shoulder"]
    assert found["removed"]["gain"] == pytest.approx(shoulder["removed"]["gain"])
    both = rollout_errors(data.sequences(data.entries), robot)
    nominal = found["methods"]["nominal"]["by_joint"]["shoulder"]["mpjae"]
    assert both.mean() == pytest.approx(nominal, rel=1e-3)


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


def test_after_the_last_cause_the_simulator_is_the_identified_robot(tmp_path):
    """Also where every number of a servo was identified: a new one needs a cause in CAUSES."""
    arm = write_arm(tmp_path)
    numbers = dict.fromkeys(SERVO_FIELDS, 0.01)
    numbers |= {"kp": 15.0, "effort_limit": 4.0, "no_load_speed": 20.0}
    numbers |= {"stop_low": -1.4, "stop_high": 1.4}
    identified = arm.with_identified(dict.fromkeys(arm.joint_names, numbers))

    last = cause_steps(identified)[-1]

    assert model_hash(last.simulator) == model_hash(identified)
