"""One plan before motion: from the found pose through the motion and back, judged by MuJoCo's own
collision.
"""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from contacts import Contacts
from hw.noted_arm import phases

from gaponet.base.errors import UsageError
from gaponet.cli.main import main
from gaponet.hw.control.clock import SimulatedClock
from gaponet.hw.control.controller import Controller
from gaponet.hw.control.driver import Fault, State
from gaponet.hw.control.phases import ControlConfig
from gaponet.hw.control.plan import (
    COMMAND_CLEARANCE_SHARE,
    GOAL_SHARES,
    MAX_POSTURE_DRIFT_RAD,
    MAX_START_DRIFT_RAD,
    MAX_START_OVERLAP_M,
    CollisionGuard,
    Planner,
)
from gaponet.hw.control.recording import Recording
from gaponet.hw.control.safety import SafetyConfig
from gaponet.motion.files import read_motion
from gaponet.motion.motion import Motion
from gaponet.motion.path_planner import Trajectory, find_points, finish_search
from gaponet.robot.collision import POSTURE_STEP_RAD, read_shapes
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import RobotSpec, load_robot, named_robots
from gaponet.virtual.fleet import load_fleet
from gaponet.virtual.virtual_driver import VirtualDriver

# Pan, lift, elbow, wrist flex and roll, gripper.
FOLDED = np.array([0.2, -1.70, 1.65, 0.9, 0.4, 1.2])
OVER = np.array([0.0, -1.2, 0.0, 1.4, 0.0, 0.0])
DOWN = np.array([0.5, 1.7, 0.3, 0.5, 0.3, 0.0])  # in the table
PAGE = Path(__file__).parents[3] / "docs" / "deploy-safety.md"
QUICK = ControlConfig(blend=0.3, blend_speed=2.0, settle=0.1, damp=0.1)


@pytest.fixture(scope="module")
def planner(so101: RobotSpec) -> Planner:
    return Planner(so101, so101.joint_names)


@pytest.fixture(scope="module")
def judge(so101: RobotSpec) -> Contacts:
    return Contacts(so101)


def motion(
    robot: RobotSpec, to: np.ndarray, joints: tuple[str, ...] | None = None, rows: int = 60
) -> Motion:
    """A small swing of the first named joint around a posture."""
    ctrl = np.repeat(to[None], rows, axis=0)
    ctrl[:, robot.index(list(joints or robot.joint_names))[0]] += 0.1 * np.sin(
        np.linspace(0, 2 * np.pi, rows)
    )
    return Motion("swing", "joint", 0.02, ctrl, joints)


def test_a_file_for_one_joint_moves_that_joint_alone(so101, planner, judge, tmp_path):
    rows = "\n".join(f"{0.1 * np.sin(0.1 * k):.5f}" for k in range(63))
    (tmp_path / "pan.txt").write_text(f"shoulder_pan\n{rows}\n")
    plan = planner.plan(read_motion(tmp_path / "pan.txt", so101), FOLDED)
    assert np.flatnonzero(np.ptp(plan.rows, axis=0)).tolist() == [0]
    np.testing.assert_allclose(plan.rows[[0, -1]], [FOLDED] * 2)
    assert judge.along(plan.rows)[0] == 0


def test_a_way_through_home_is_found_where_the_straight_one_is_not_clear():
    wall = lambda rows: bool(((np.abs(rows[:, 0]) > 0.2) | (rows[:, 1] > 0.6)).all())  # noqa: E731
    start, goal = np.array([[-1.0, 0.5, 0.3], [1.0, 0.5, 0.3]])
    home = np.array([0.0, 3.0, 0.3])
    points = finish_search(find_points(wall, start, goal, home))
    np.testing.assert_array_equal(points, [start, home, goal])


def test_no_way_is_found_where_straight_and_through_home_are_not_clear():
    shut = lambda rows: bool((np.abs(rows[:, 0]) > 0.2).all())  # noqa: E731
    ends = np.array([[-1.0, -0.5, 0.3], [1.0, -0.5, 0.3]])
    assert finish_search(find_points(shut, *ends, home=np.zeros(3))) is None


def test_what_cannot_be_is_refused_with_what_is_in_the_way(so101, planner):
    under = np.array([0.0, 1.2, 0.6, 0.0, 0.0, 0.0])
    with pytest.raises(UsageError, match="found"):
        planner.plan(motion(so101, OVER), under)
    with pytest.raises(UsageError, match="plane"):
        planner.plan(motion(so101, under), FOLDED)
    with pytest.raises(UsageError, match="target"):
        finish_search(planner.begin(under, FOLDED))


def test_a_motion_is_slowed_until_no_joint_accelerates_beyond_the_limit_and_no_further(so101):
    planner = Planner(so101, so101.joint_names, safety=SafetyConfig(acceleration=1.0))
    plan = planner.plan(motion(so101, OVER), OVER)
    assert "times slower" in plan.changed
    acceleration = np.abs(np.diff(plan.motion.sample(0.02), 2, axis=0)).max() / 0.02**2
    assert 0.8 < acceleration <= 1.0


def test_a_plan_is_slowed_to_a_share_of_the_speed_that_commands_may_have(so101):
    """Faster targets would be cut joint by joint, and leave the path that was checked."""
    planner = Planner(so101, so101.joint_names, config=QUICK, safety=SafetyConfig(speed=0.2))
    plan = planner.plan(motion(so101, OVER), FOLDED)
    assert "times slower" in plan.changed
    fastest = np.abs(np.diff(plan.sample(0.02), axis=0)).max() / 0.02
    assert 0.14 < fastest < 0.17


def test_a_plan_that_needs_more_than_the_stated_share_of_torque_is_refused(so101):
    level = np.zeros(6)
    need = Planner(so101, so101.joint_names).plan(motion(so101, level), OVER).torque * 0.85
    enough = Planner(so101, so101.joint_names, safety=SafetyConfig(torque_share=1.05 * need))
    enough.plan(motion(so101, level), OVER)
    little = Planner(so101, so101.joint_names, safety=SafetyConfig(torque_share=0.9 * need))
    with pytest.raises(UsageError, match="torque-share"):
        little.plan(motion(so101, level), OVER)


def test_a_way_begins_and_ends_at_rest_and_keeps_its_speed():
    way = Trajectory.minimum_jerk(np.array([[0.0, 0.0], [1.0, 0.2], [0.4, 0.2]]), 0.5, 50.0, 2.0)
    rows = way.rows(0.01)
    speed = np.diff(rows, axis=0) / (way.duration / (len(rows) - 1))
    assert np.abs(speed).max() <= 0.5 + 1e-6
    np.testing.assert_allclose(
        [rows[0], rows[-1], way.at(way.times[1])], way.points[[0, 2, 1]], atol=1e-12
    )
    assert np.abs(speed[[0, -1]]).max() < 0.01


def virtual(robot: RobotSpec, found: np.ndarray) -> tuple[Controller, list[np.ndarray]]:
    """A controller of a virtual arm that stands in a posture, and its commands."""
    clock = SimulatedClock()
    sent = []

    class Driver(VirtualDriver):
        def write(self, ctrl: np.ndarray, weight: float = 1.0) -> None:
            sent.append(ctrl.copy())
            super().write(ctrl, weight)

    stands = dataclasses.replace(robot, qpos_home=found)
    driver = Driver(stands, load_fleet("easy", robot).unit("virtual-1"), clock, period=0.01)
    return Controller(driver, robot, config=QUICK, clock=clock), sent


def push_down(
    planner: Planner, sag: np.ndarray | float = 0.0
) -> tuple[CollisionGuard, list[np.ndarray]]:
    """Live targets go into the table: the guard, and what it makes of them."""
    home = planner.robot.qpos_home
    guard = CollisionGuard(planner, home)
    targets = (home + min(1.0, k / 60) * (DOWN - home) for k in range(200))
    return guard, [guard.step(target, guard.qpos + sag, 0.02) for target in targets]


def test_live_targets_that_go_for_the_table_are_cut(so101, planner, judge):
    assert judge.deepest(DOWN)[0] > 0.1
    guard, at = push_down(planner)
    assert max(judge.deepest(q)[0] for q in at) == 0
    assert "the plane at 0 m" in guard.obstacle
    assert abs(at[-1][0] - DOWN[0]) < 0.05, "what does not lead into it goes on"
    back = [guard.step(so101.qpos_home, guard.qpos, 0.02) for _ in range(300)]
    np.testing.assert_allclose(back[-1], so101.qpos_home, atol=1e-6)
    assert not guard.obstacle
    slow = planner.config.blend_speed * 0.02  # away from an obstacle
    assert np.abs(np.diff([at[-1], *back], axis=0)).max() <= slow + 1e-9


def test_of_an_arm_that_sags_the_arm_itself_is_kept_clear(planner):
    sag = np.array([0.0, 0.08, 0.0, 0.0, 0.0, 0.0])
    guard, at = push_down(planner, sag)
    clearance = planner.collision.clearance
    assert "the plane at 0 m" in guard.obstacle
    assert planner.collision.along(np.array(at) + sag).min() > clearance - 0.002
    assert planner.collision.along(at[-1][None]).min() > clearance + 0.005, "the sag matters here"


@pytest.fixture(scope="module")
def low(so101: RobotSpec, planner: Planner) -> np.ndarray:
    """A posture with half of the clearance."""
    posture = so101.qpos_home.copy()
    while planner.collision.along(posture[None]).min() > 0.5 * planner.collision.clearance:
        posture[so101.index(["shoulder_lift"])] += 0.002
    return posture


def test_a_first_live_target_is_gone_to_and_never_beyond(so101, planner):
    target = so101.qpos_home.copy()
    target[0] += 0.2  # the way goes on beyond it, and is clear

    plan = finish_search(planner.begin(target, so101.qpos_home))

    np.testing.assert_allclose(plan.approach.points[-1], target, atol=1e-12)


def test_a_first_live_target_within_the_clearance_is_gone_to_as_far_as_is_clear(
    so101, planner, low
):
    plan = finish_search(planner.begin(low, so101.qpos_home))

    goal = plan.approach.points[-1]
    way = low - so101.qpos_home
    lift = so101.index(["shoulder_lift"])[0]
    next_place = goal + way / (GOAL_SHARES - 1)
    assert 0 < (goal - so101.qpos_home)[lift] < way[lift]
    assert planner.collision.along(goal[None]).min() >= planner.collision.clearance
    assert planner.collision.along(next_place[None]).min() < planner.collision.clearance


@pytest.mark.parametrize("cut", [False, True])
def test_an_arm_that_started_below_the_clearance_is_brought_back_there_or_as_far_as_it_may(
    so101, low, monkeypatch, cut
):
    if cut:
        monkeypatch.setattr(CollisionGuard, "allow_start_clearance", lambda guard: None)
    controller, sent = virtual(so101, low)
    recording = controller.run(lambda k, state: so101.qpos_home if k < 50 else None)
    assert recording.fault is None
    where = (
        "where it is: gripper and the plane at 0 m would come too near"
        if cut
        else "back where it was found"
    )
    assert where in recording.events[-1].text
    assert not cut or np.abs(sent[-1] - low).max() > 0.02


@pytest.mark.parametrize("allowed", [True, False])
def test_live_targets_reach_a_start_below_the_clearance_only_on_the_way_back(
    so101, planner, low, allowed
):
    clearance = planner.collision.clearance
    guard = CollisionGuard(planner, low)
    for _ in range(200):
        guard.step(so101.qpos_home, guard.qpos, 0.02)
    np.testing.assert_allclose(guard.qpos, so101.qpos_home, atol=1e-6)
    if allowed:
        guard.allow_start_clearance()
    for _ in range(400):
        guard.step(low, guard.qpos, 0.02)
    free = planner.collision.along(guard.qpos[None]).min()
    assert free < 0.6 * clearance if allowed else free > clearance - 1e-3


def test_a_controller_cuts_them_and_says_what_for(so101, judge):
    controller, sent = virtual(so101, so101.qpos_home)
    way = DOWN - so101.qpos_home
    recording = controller.run(
        lambda k, state: so101.qpos_home + min(1, k / 50) * way if k < 90 else None
    )
    assert recording.fault is None
    assert max(judge.deepest(q)[0] for q in sent) == 0
    assert any(
        "targets are cut: " in e.text and "the plane at 0 m" in e.text for e in recording.events
    )


ACROSS = np.array(
    [-2.27, 2.08, -0.49, 1.26, 1.31, -0.92, 0.13, -2.16, 2.5, 1.78]
)  # straight from there to HERE …
HERE = np.array(
    [-1.04, 0.21, 2.95, 0.67, -0.13, 0.96, -0.73, -0.37, 2.6, -1.31]
)  # … its arms go 11 cm into each other, and through the home posture they do not


def straight(free, start, goal, *_):
    """A search that looks at nothing."""
    yield
    return np.stack([start, goal])


def test_a_plan_is_judged_as_a_whole_whatever_was_found_on_the_way(so101, monkeypatch):
    monkeypatch.setattr("gaponet.hw.control.plan.find_points", straight)
    robot = load_robot("h1_2")
    found = robot.qpos_home.copy()
    far = robot.qpos_home.copy()
    found[robot.index(robot.operated)] = HERE
    far[robot.index(robot.operated)] = ACROSS
    with pytest.raises(UsageError, match="into"):
        finish_search(Planner(robot, robot.operated).begin(far, found))
    hasty = ControlConfig(blend=0.01, blend_speed=1e3), SafetyConfig(speed=1e4, acceleration=1e5)
    with pytest.raises(UsageError, match="torque"):
        Planner(so101, so101.joint_names, *hasty).plan(motion(so101, OVER), so101.qpos_home)


@pytest.fixture(scope="module")
def h1_2() -> RobotSpec:
    return load_robot("h1_2")


@pytest.fixture(scope="module")
def h1_2_judge(h1_2: RobotSpec) -> Contacts:
    return Contacts(h1_2)


def posture(robot: RobotSpec, operated: np.ndarray) -> np.ndarray:
    """Home, with the operated joints elsewhere."""
    qpos = robot.qpos_home.copy()
    qpos[robot.index(robot.operated)] = operated
    return qpos


class Outing:
    """A robot that does as told is led from HERE through home to ACROSS, where its targets end.

    Attributes:
        found_way: Whether the search for a way back finds one.
        obeys: Whether it still does as told on the way back.
        sent: Its commands.
    """

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        robot: RobotSpec,
        found_way: bool = True,
        obeys: bool = True,
    ) -> None:
        self.monkeypatch = monkeypatch
        self.found_way = found_way
        self.obeys = obeys
        self.found = posture(robot, HERE)
        self.controller, self.sent = virtual(robot, self.found)
        self.clock = self.controller.context.clock
        self.controller.context.driver.at_end = "hold" if obeys else "hand_over"
        self.controller.context.driver.read = self.read
        self.controller.output.monitor.frozen.noisy = False
        legs = [
            np.stack([self.found, robot.qpos_home]),
            np.stack([robot.qpos_home, posture(robot, ACROSS)]),
        ]
        self.rows = np.concatenate(
            [Trajectory.minimum_jerk(leg, 2.0, 50.0, 0.3).rows(0.02) for leg in legs]
        )

    def run(self) -> Recording:
        return self.controller.run(self.policy)

    def read(self) -> State:
        fault = None
        if not self.obeys and self.controller.phase == "blend_out":
            fault = Fault("obedience", "it ignores goals")
        qpos = self.sent[-1] if self.sent else self.found
        return State(self.clock.now(), qpos, *np.zeros((3, len(qpos))), fault=fault)

    def policy(self, k: int, state: State) -> np.ndarray | None:
        if k:
            self.monkeypatch.setattr("gaponet.hw.control.plan.find_points", self.search)
        return self.rows[k] if k < len(self.rows) else None

    def search(self, *given):
        """Each step takes a millisecond, and where there is no way it takes a few to find that
        out.
        """
        for _ in find_points(*given) if self.found_way else range(50):
            self.clock.advance(0.001)
            yield
        return finish_search(find_points(*given)) if self.found_way else None


def commanded(recording: Recording) -> np.ndarray:
    """All commands that were sent, (T, n) rad."""
    return np.array([row.ctrl for row in recording.rows if row.ctrl is not None])


def test_straight_back_from_there_its_arms_go_into_each_other(h1_2, h1_2_judge):
    straight_back = np.stack([posture(h1_2, ACROSS), posture(h1_2, HERE)])
    assert h1_2_judge.along(straight_back, 0.02)[0] > 0.1


def test_when_targets_end_it_stands_until_a_clear_way_back_is_found(monkeypatch, h1_2, h1_2_judge):
    outing = Outing(monkeypatch, h1_2)

    recording = outing.run()

    assert recording.fault is None
    assert recording.events[-1].text == "back where it was found; hold"
    np.testing.assert_allclose(outing.sent[-1], outing.found, atol=0.02)
    assert h1_2_judge.along(commanded(recording), 0.02)[0] == 0
    ending = [row.target for row in recording.rows if row.phase == "blend_out"]
    back = np.array([target for target in ending if target is not None])
    standing = int(np.argmax(np.abs(back - back[0]).max(axis=1) > 0))
    assert 2 < standing < 100, "it looks for a share of each period"


def test_when_targets_end_and_no_clear_way_back_is_found_it_ends_there(
    monkeypatch, h1_2, h1_2_judge
):
    outing = Outing(monkeypatch, h1_2, found_way=False)

    recording = outing.run()

    assert recording.fault is None
    text = "where it is: no clear way back to where it was found: straight it brings .*; hold"
    assert re.fullmatch(text, recording.events[-1].text)
    np.testing.assert_allclose(outing.sent[-1], posture(h1_2, ACROSS), atol=0.02)
    assert h1_2_judge.along(commanded(recording), 0.02)[0] == 0


def test_when_targets_end_a_robot_that_ignores_goals_is_damped(monkeypatch, h1_2):
    recording = Outing(monkeypatch, h1_2, found_way=False, obeys=False).run()

    assert recording.fault.kind == "obedience"
    assert phases(recording)[-3:] == ["blend_out", "damp", "stopped"]


@pytest.mark.parametrize(
    ("beyond", "servo_end", "kind"),
    [
        (0.03, None, None),
        (0.2, None, "plan"),
        (0.015, 0.0, None),
        (0.03, 0.0, "plan"),
        (0.2, 0.2, None),
        (-0.1, -0.3, "plan"),
    ],
)
def test_the_first_command_is_where_it_was_found_or_none_leaves(so101, beyond, servo_end, kind):
    """Servos that know their own range cut goals beyond it, so that less is admitted.

    Both ends are rad beyond the end of the MJCF's range.
    """
    found = so101.qpos_home.copy()
    found[0] = so101.qpos_range[0, 1] + beyond
    controller, sent = virtual(so101, found)
    driver = controller.context.driver
    honest = driver.read
    driver.read = lambda: honest() if sent else dataclasses.replace(honest(), qpos=found.copy())
    if servo_end is not None:
        driver.qpos_range = so101.qpos_range + np.array([0.0, servo_end])
    recording = controller.run(lambda k, state: so101.qpos_home if k < 5 else None)
    assert (recording.fault.kind if recording.fault else None) == kind, recording.fault
    assert [c[0] for c in sent[:1]] == ([] if kind else [pytest.approx(found[0], abs=2e-3)])


def test_an_arm_without_shapes_and_a_robot_that_may_fall_are_asked_for(so101, tmp_path, capsys):
    (tmp_path / "pan.txt").write_text("shoulder_pan\n0.0\n0.1\n")
    save_robot(so101, tmp_path / "mine")
    (tmp_path / "mine" / "collision.toml").unlink()
    words = [
        "run",
        "--driver",
        "so101",
        "--port",
        "/dev/none",
        "--motion",
        str(tmp_path / "pan.txt"),
        "--yes",
    ]
    assert (
        main([*words, "--robot", str(tmp_path / "mine"), "--limits-from", str(tmp_path / "mine")])
        == 2
    )
    assert "so101 has no collision.toml" in " ".join(capsys.readouterr().err.split())
    assert (
        main(
            [
                "run",
                "--driver",
                "unitree",
                "--topic",
                "lowcmd",
                "--motion",
                "sweep-left_elbow",
                "--yes",
            ]
        )
        == 2
    )
    said = " ".join(capsys.readouterr().err.split())
    assert "legs and torso go off, and a robot that stands falls; say --hangs" in said


# ---- the page about it


def on_page(pattern: str) -> tuple[str, ...]:
    """Return the groups of a pattern that the section about the plan has once."""
    section = PAGE.read_text(encoding="utf-8").split("## One plan before motion\n")[1]
    found = re.findall(pattern, section.split("\n## ")[0])
    assert len(found) == 1, pattern
    return found[0] if isinstance(found[0], tuple) else (found[0],)


def test_the_page_states_in_which_steps_and_from_which_start_a_plan_is_checked():
    (step,) = on_page(r"at least every ([\d.]+) rad of motion")
    (drift,) = on_page(r"moved by more than ([\d.]+) rad since the plan")
    (posture_drift,) = on_page(r"may sway by ([\d.]+) rad")
    (overlap,) = on_page(r"overlap by more than ([\d.]+) cm")
    assert float(step) == POSTURE_STEP_RAD
    assert float(drift) == MAX_START_DRIFT_RAD
    assert float(posture_drift) == MAX_POSTURE_DRIFT_RAD
    assert float(overlap) / 100 == MAX_START_OVERLAP_M


def test_the_page_states_how_much_stays_free_of_each_robot():
    usual, near = on_page(r"([\d.]+) cm must stay free \(SO-101 and G1: ([\d.]+) cm\)")
    half, half_near = on_page(r"\(([\d.]+) cm; SO-101 and G1: ([\d.]+) cm\) must stay free")
    assert float(half) == COMMAND_CLEARANCE_SHARE * float(usual)
    assert float(half_near) == COMMAND_CLEARANCE_SHARE * float(near)
    for name in named_robots():
        robot = load_robot(name)
        shapes = read_shapes(robot.folder)
        if shapes.capsule:
            stated = near if robot.name in ("so101", "g1_23", "g1_29") else usual
            assert shapes.clearance == float(stated) / 100, name
