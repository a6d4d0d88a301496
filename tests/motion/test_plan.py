"""gaponet excite: motions that a robot can do, as files that come back, and a sheet that says how
long.
"""

import json

import numpy as np
import pytest
from contacts import Contacts

from gaponet.base.errors import UsageError
from gaponet.cli.main import main
from gaponet.motion.files import read_motion, write_motion
from gaponet.motion.plan import make_plan
from gaponet.robot.spec import load_robot

MINUTES = 4.0


@pytest.fixture(scope="module")
def plan(so101):
    return make_plan(so101, MINUTES, (0.0, 0.2))


def test_a_plan_has_the_requested_duration(plan):
    longest = max(motion.duration for motion in plan.motions) * 2 / 60
    assert MINUTES <= plan.minutes <= MINUTES + longest


def test_a_plan_moves_every_joint_alone_or_with_others(so101, plan):
    together = [motion.moved(so101) for motion in plan.motions]
    assert set().union(*together) == set(so101.operated)
    assert max(len(joints) for joints in together) > 1


def test_no_motion_touches_the_arm_or_the_table(so101, plan):
    judge = Contacts(so101)
    for motion in plan.motions:
        touching, *_ = judge.along(motion.ctrl[::10], 0.05)
        assert touching <= 0, motion.name


def test_no_motion_names_the_gripper(so101, plan):
    named = [motion.named(so101) for motion in plan.motions]
    assert set().union(*named) == set(so101.operated)


@pytest.mark.parametrize(("suffix", "rate"), [("txt", 50.0), ("csv", 100.0), ("npz", 30.0)])
def test_a_motion_survives_its_file(so101, plan, tmp_path, suffix, rate):
    motion = plan.motions[0]
    write_motion(tmp_path / f"m.{suffix}", motion, so101, rate)
    if suffix == "csv":  # as a spreadsheet saves it
        text = (tmp_path / "m.csv").read_text()
        (tmp_path / "m.csv").write_text(text, encoding="utf-8-sig")
    back = read_motion(tmp_path / f"m.{suffix}", so101)
    assert back.dt == pytest.approx(1 / rate)
    np.testing.assert_allclose(back.ctrl, motion.sample(1 / rate), atol=1e-6)
    assert back.joints == so101.operated


def test_sage_files_are_at_50_hz(so101, plan, tmp_path):
    with pytest.raises(UsageError, match="100"):
        write_motion(tmp_path / "m.txt", plan.motions[0], so101, 100.0)
    with pytest.raises(UsageError, match="--rate"):
        write_motion(tmp_path / "m.csv", plan.motions[0], so101, 0.02)


def test_too_little_time_and_payloads_without_a_mount_are_refused(arm):
    with pytest.raises(UsageError, match="short"):
        make_plan(arm, 0.1, (0.0,))
    with pytest.raises(UsageError, match="≥"):
        make_plan(arm, 5.0, (-1.0,))


def test_the_command_writes_motions_and_a_sheet(tmp_path, capsys):
    words = ["excite", "--robot", "fr3", "--out", str(tmp_path / "m"), "--minutes", "5", "--json"]
    assert main(words) == 0
    told = json.loads(capsys.readouterr().out)
    sheet = (tmp_path / "m" / "sheet.md").read_text(encoding="utf-8")
    robot = load_robot("fr3")
    for file in told["motions"]:
        assert f"| {file} | 0 |" in sheet
        assert read_motion(tmp_path / "m" / file, robot).duration > 1
    assert "Warm up for ten minutes" in sheet
    assert main(words) == 0
    capsys.readouterr()
    assert main([*words[:-3], "--minutes", "3"]) == 2, "the robot would play the older ones too"
    assert "holds motions of another call: " in capsys.readouterr().err
    assert {path.name for path in (tmp_path / "m").glob("*_*")} == set(told["motions"])
