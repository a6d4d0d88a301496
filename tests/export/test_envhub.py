"""An environment of LeRobot's EnvHub, in a folder that needs no gaponet."""

import json
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from arm import SERVO, XML, write_arm

from gaponet.export.drawn_robots import DrawnRobots
from gaponet.export.export_folder import Source, export_robot
from gaponet.export.plain_servos import own_motions
from gaponet.export.randomization import Randomization
from gaponet.robot.spec import load_robot
from gaponet.sim.links import COORDINATES, MASS_LOG_STD, LinkAxes

pytest.importorskip("gymnasium")
NAME = "so101@sage"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The export of an identified SO-101."""
    folder = tmp_path_factory.mktemp("envhub") / "out"
    robot = load_robot(NAME)
    motions = [s.rows(slice(0, 40)) for s in own_motions(robot, count=2)]
    with pytest.MonkeyPatch.context() as patch:
        # judging by recordings takes minutes; tests/export/test_ranges.py does it
        patch.setattr("gaponet.export.envhub.judge_units", lambda drawn, *_: drawn)
        export_robot(robot, "envhub", folder, (motions, motions))
    return folder


def loaded(folder):
    """Import env.py as LeRobot does: by its path, under a name of its own."""
    import importlib.util

    spec = importlib.util.spec_from_file_location("hub_env_user_name", folder / "env.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def own_imports(monkeypatch):
    """Forget the modules of a folder after a test."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield
    for name in ("mujoco_servos", "mujoco_randomization"):
        sys.modules.pop(name, None)


@pytest.fixture
def hub(folder, own_imports):
    return loaded(folder)


def test_robots_are_stepped_by_targets_in_degrees_and_come_near(hub):
    (envs,) = hub.make_env(n_envs=2)["so101"].values()
    seen, _ = envs.reset(seed=1)
    first = np.abs(seen["agent_pos"] - seen["environment_state"])[:, :5].max(axis=1)

    for _ in range(60):
        seen, reward, terminated, _, info = envs.step(seen["environment_state"])

    now = np.abs(seen["agent_pos"] - seen["environment_state"])[:, :5].max(axis=1)
    assert (now < first / 3).all()
    assert reward.shape == (2,)
    assert not terminated.any() or "final_info" in info
    envs.close()


def test_an_episode_ends_in_success_at_the_goal_and_without_it_after_its_time(hub):
    env = hub.RobotEnv()
    env.reset(seed=3)
    env.goal = env.robot.home
    outcomes = [env.step(env.values.of(env.robot.home)) for _ in range(hub.HELD_PERIODS)]
    assert [terminated for _, _, terminated, _, _ in outcomes].count(True) == 1
    assert outcomes[-1][-1]["is_success"]

    env.reset(seed=3)
    away = env.values.of(env.values.low)
    ends = [env.step(away)[3] for _ in range(env._max_episode_steps)]
    assert ends.index(True) == len(ends) - 1


def test_drawn_servos_differ_between_episodes_and_identified_ones_do_not(hub):
    gains = {}
    for servos in hub.SERVOS:
        env = hub.RobotEnv(servos)
        found = []
        for seed in range(2):
            env.reset(seed=seed)
            found.append(env.robot.servos.numbers.kp.tolist())
        gains[servos] = found
    assert gains["identified"][0] == gains["identified"][1]
    assert gains["drawn"][0] != gains["drawn"][1]


def test_the_task_of_lerobots_configuration_chooses_drawn_servos(hub):
    (envs,) = hub.make_env(cfg=SimpleNamespace(task="drawn"))["so101"].values()
    assert envs.envs[0].robot.units is not None
    envs.close()


def test_the_gripper_has_0_to_100_and_other_joints_have_degrees(hub, folder):
    env = hub.RobotEnv()
    joints = json.loads((folder / "facts.json").read_text())["joints"]
    gripper = list(joints).index("gripper")
    assert env.action_space.low[gripper] == pytest.approx(0.0, abs=1e-4)
    assert env.action_space.high[gripper] == pytest.approx(100.0, abs=1e-3)
    pan = joints["shoulder_pan"]["range"]
    assert np.radians(env.action_space.high[0]) == pytest.approx(pan[1], rel=1e-5)


def test_the_folder_needs_no_gaponet(folder):
    blocked = (
        "import sys; sys.modules['gaponet'] = None; sys.path.insert(0, '.'); import env; "
        "envs = env.make_env(1)['so101'][0]; envs.reset(seed=0); "
        "envs.step(envs.action_space.sample())"
    )
    subprocess.run([sys.executable, "-c", blocked], cwd=folder, check=True)


def test_the_card_calls_motions_of_no_real_robot_virtual(folder):
    assert "VIRTUAL" in (folder / "README.md").read_text()


def test_a_robot_without_uncertainty_has_no_drawn_servos(folder, tmp_path, own_imports):
    robot = load_robot("so101")
    motions = [s.rows(slice(0, 20)) for s in own_motions(robot, count=1)]
    export_robot(robot, "envhub", tmp_path / "out", (motions, motions))
    module = loaded(tmp_path / "out")
    with pytest.raises(ValueError, match=r"README\.md says why"):
        module.RobotEnv("drawn")
    assert not (tmp_path / "out" / "randomization.json").exists()
    text = (tmp_path / "out" / "README.md").read_text()
    assert "identified servos" not in text
    assert "none are drawn: their uncertainty is not known" in text


UNIT_KP = 17.0


def errors(units):
    """Errors of units, in rad, beside 4 mrad of ranges by hand."""
    return {"exported": 1e-3, "units": units, "one by one": 1e-2, "by hand": 4e-3}


@pytest.fixture
def exported(tmp_path, monkeypatch):
    """Function that exports an arm with one unit, whose links have twice the mass.

    Its arguments are the errors of units with and without the servo model, rad. The file of the
    user has "left_" before the names.
    """
    robot = write_arm(tmp_path / "arm").with_identified({"elbow": {"kp": 16.0}})
    motions = [s.rows(slice(0, 20)) for s in own_motions(robot, count=1)]
    values = SERVO | {"kp": UNIT_KP, "effort_limit": 5.0}
    units = {field: np.full((1, 2), value) for field, value in values.items()}
    heavier = [np.log(2) / MASS_LOG_STD, *[0.0] * (COORDINATES - 1)]
    units["links"] = np.array([[*heavier, *heavier]])
    mine = tmp_path / "mine.xml"
    text = XML
    for name in ("shoulder", "elbow", "upper", "fore"):
        text = text.replace(f'name="{name}"', f'name="left_{name}"')
    mine.write_text(text)
    envhub = "gaponet.export.envhub"
    monkeypatch.setattr(f"{envhub}.ParameterUncertainty.load", lambda robot: True)
    monkeypatch.setattr(f"{envhub}.judge_units", lambda drawn, *_: drawn)

    def export(with_model, plain):
        made = Randomization(
            robot="arm",
            scope="today",
            units=units,
            ranges={joint: {"kp": (15.0, 16.0, 17.0)} for joint in robot.operated},
            unknown=(),
            notes=(),
            links=LinkAxes(robot),
            judged=DrawnRobots(units, errors(with_model)),
            plain=DrawnRobots(units, errors(plain)),
        )
        monkeypatch.setattr(f"{envhub}.sample_units", lambda *_, **__: made)
        out = tmp_path / "out"
        return export_robot(robot, "envhub", out, (motions, motions), Source(mine, "left_"))

    return export


def test_a_unit_is_drawn_in_a_file_with_a_prefix(exported, tmp_path, own_imports):
    exported(with_model=2e-3, plain=2e-3)
    env = loaded(tmp_path / "out").RobotEnv("drawn")
    env.reset(seed=0)
    assert env.robot.model.body("left_fore").mass[0] == pytest.approx(0.4)
    assert env.robot.servos.numbers.kp.tolist() == [UNIT_KP, UNIT_KP]


def test_units_are_judged_with_the_servo_model_in_which_they_are_played(exported, tmp_path):
    made = exported(with_model=2e-3, plain=5e-3)
    assert made.notes == ()
    assert (tmp_path / "out" / "randomization.json").is_file()


def test_units_worse_than_ranges_by_hand_are_left_out_and_those_before_are_removed(
    exported, tmp_path
):
    exported(with_model=2e-3, plain=2e-3)
    made = exported(with_model=5e-3, plain=2e-3)
    assert "drawn units are 5.00 mrad" in made.notes[-1]
    assert not (tmp_path / "out" / "randomization.json").exists()
    assert "none are drawn: on validation motions" in (tmp_path / "out" / "README.md").read_text()
