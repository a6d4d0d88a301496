"""Units to train on: drawn from what is known of a robot, whole, and refused where something is
missing.
"""

import json
import re
import runpy
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from arm import XML, write_arm

from gaponet.base.errors import NoGainError, RobotError
from gaponet.cli.main import main
from gaponet.export import drawn_robots
from gaponet.export.export_folder import export_robot
from gaponet.export.plain_servos import own_motions, rollout_error
from gaponet.export.randomization import NO_PLAIN_UNITS, judge_units, sample_units
from gaponet.export.shipped import mujoco_randomization
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import load_robot
from gaponet.sim.links import COORDINATES, LinkAxes
from gaponet.sim.model import build_model
from gaponet.sysid.uncertainty import (
    JointUncertainty,
    LinkUncertainty,
    ParameterUncertainty,
    to_axes,
)

FIELDS = ("kp", "damping", "frictionloss", "armature", "offset", "delay")
SERVO_FIELDS = {
    "kp": 16.0,
    "damping": 0.5,
    "frictionloss": 0.05,
    "armature": 0.02,
    "offset": 0.0,
    "delay": 0.02,
}
ERRORS = np.array([0.05, 0.001, 1e-4, 1e-4, 2e-3, 1e-3])
LARGE_ERRORS = np.array([0.3, 0.01, 1e-3, 1e-4, 1e-2, 5e-3])


def source(values, unit="a", days=()):
    covariance = {j: [[0.0] * len(FIELDS)] * len(FIELDS) for j in values}
    return {
        "made_by": "identify",
        "days": days,
        "unit": unit,
        "logs": {},
        "seconds": 60.0,
        "values": {j: tuple(v) for j, v in values.items()},
        "covariance": covariance,
    }


def written(arm, folder, servo=SERVO_FIELDS, errors=ERRORS, sources=1, links=None):
    """A robot folder that knows its values; friction and damping err together."""
    moved = LinkAxes(arm).links(np.array(links.values)) if links else {}
    save_robot(
        replace(arm.with_identified(dict.fromkeys(arm.joint_names, servo)), links=moved), folder
    )
    robot = load_robot(folder)
    values = to_axes(robot, FIELDS)
    like = np.eye(6)
    like[1, 2] = like[2, 1] = -0.9
    covariance = like * np.outer(errors, errors)
    none = tuple(np.zeros(7))
    joints = {
        j: JointUncertainty(
            tuple(v), tuple(map(tuple, covariance)), none, (none,) * 7, none, 1e-3, 2e-3, 3e-3
        )
        for j, v in values.items()
    }
    days = [
        {j: v + k * np.array([0.0, 0.0, 5e-4, 0.0, 0.0, 0.0]) for j, v in values.items()}
        for k in range(sources)
    ]
    said = tuple(source(v, days=(f"2026-11-{20 + k}",)) for k, v in enumerate(days[::-1]))
    ParameterUncertainty(FIELDS, joints, said, 24, True, links).save(folder)
    return folder


def heavy_links(slope=0.0):
    """Links of the arm, each 0.5 standard deviations heavier; kp rises with the mass of the second
    one.
    """
    covariance = np.diag(np.tile([0.04, *[1.0] * 9], 2))
    slopes = np.zeros((2, len(FIELDS), 2 * COORDINATES))
    slopes[:, 0, COORDINATES] = slope
    values = np.tile([0.5, *[0.0] * 9], 2)
    by_joint = dict(zip(("shoulder", "elbow"), slopes.tolist(), strict=True))
    return LinkUncertainty(tuple(values), tuple(map(tuple, covariance)), by_joint)


def exported(capsys, *words):
    code = main(["export", *map(str, words), "--to", "randomization", "--json"])
    said = capsys.readouterr()
    return code, json.loads(said.out) if said.out else said.err


@pytest.fixture
def arm(tmp_path):
    return write_arm(tmp_path / "arm")


def test_units_scatter_as_the_values_err_and_together(arm, tmp_path, capsys):
    folder = written(arm, tmp_path / "known")
    code, said = exported(capsys, folder)
    assert code == 0
    made = json.loads((folder / "randomization" / "randomization.json").read_text())
    kp, damping, friction = (
        np.array(made["units"][f])[:, 1] for f in ("kp", "damping", "frictionloss")
    )
    assert np.log(kp).std() == pytest.approx(0.05, rel=0.2)
    assert np.corrcoef(damping / kp, friction / kp)[0, 1] < -0.8
    low, high = (said["ranges"]["elbow"]["kp"][k] for k in (0, 2))
    np.testing.assert_allclose([np.log(low / 16), np.log(high / 16)], [-0.0822, 0.0822], atol=0.006)
    assert min(np.min(made["units"][f]) for f in FIELDS if f != "offset") >= 0
    np.testing.assert_allclose(
        np.array(made["units"]["effort_limit"])[:, 1] / arm.servo.effort_limit[1],
        kp / 16,
        rtol=1e-5,
    )


def test_drawn_links_are_physical_and_servos_follow_them(arm, tmp_path):
    plain, alone, together = (
        sample_units(written(arm, tmp_path / str(i), links=links))
        for i, links in enumerate((None, heavy_links(), heavy_links(0.5)))
    )
    for field, values in plain.units.items():
        np.testing.assert_array_equal(alone.units[field], values)
    links = np.array([together.links.inertials(row) for row in together.units["links"]])
    file = LinkAxes(arm).inertials(np.zeros(2 * COORDINATES))
    mass = np.log(links[..., 0] / file[:, 0])
    moments = np.sort(links[..., 4:7])
    assert (moments[..., 0] + moments[..., 1] >= moments[..., 2]).all()
    scale = 2 * LinkAxes(arm).scale[:, 0]  # of log mass
    np.testing.assert_allclose(mass.mean(axis=0) / scale, 0.5, atol=0.05)
    np.testing.assert_allclose(mass.std(axis=0) / scale, 0.2, rtol=0.15)
    assert np.corrcoef(mass[:, 1], np.log(together.units["kp"][:, 0]))[0, 1] > 0.8
    assert abs(np.corrcoef(mass[:, 0], np.log(together.units["kp"][:, 0]))[0, 1]) < 0.2


def test_an_exported_unit_has_its_links_in_mujoco_and_isaac_lab_says_that_it_has_none(
    arm, tmp_path, capsys
):
    folder = written(arm, tmp_path / "known", links=heavy_links())
    assert exported(capsys, folder, "--engine", "mujoco", "--out", tmp_path / "out")[0] == 0
    functions = runpy.run_path(str(tmp_path / "out" / "mujoco_randomization.py"))
    model = mujoco.MjModel
    moved = model.from_xml_path(str(arm.mjcf))
    drawn = functions["units"](tmp_path / "out" / "randomization.json")
    functions["apply"](moved, drawn, 7)
    unit = sample_units(folder)
    robot = drawn_robots.robots_of(load_robot(folder), unit.units)[7]
    wanted = build_model(robot)
    for name in ("body_mass", "body_ipos", "body_inertia", "body_subtreemass"):
        np.testing.assert_allclose(
            getattr(moved, name), getattr(wanted, name)[:3], rtol=1e-5, atol=1e-9
        )
    assert wanted.body_mass[1] != build_model(load_robot(folder)).body_mass[1]
    np.testing.assert_allclose(
        places_of_geoms(moved), places_of_geoms(model.from_xml_path(str(arm.mjcf)))
    )
    assert exported(capsys, folder, "--engine", "isaaclab", "--out", tmp_path / "isaac")[0] == 0
    content = json.loads((tmp_path / "isaac" / "randomization.json").read_text())
    assert "links" not in content["units"]
    assert content["notes"][0].startswith("all units have the identified links: Isaac Lab")
    text = (folder / "robot.toml").read_text()
    (folder / "robot.toml").write_text(re.sub(r'(fore"\]\nmass = )[\d.]+', r"\g<1>9.0", text))
    with pytest.raises(RobotError, match="links"):
        ParameterUncertainty.load(load_robot(folder))


def places_of_geoms(model):
    """Return where the geoms are in the first posture, (geoms, 3) m."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data.geom_xpos


def test_what_no_log_determines_is_said(arm, tmp_path, capsys):
    folder = written(arm, tmp_path / "known", errors=np.where(np.arange(6) == 3, 0.02 / 16, ERRORS))
    code, said = exported(capsys, folder)
    assert (code, said["unknown"]) == (0, ["shoulder: armature", "elbow: armature"])
    low, value, high = said["ranges"]["elbow"]["armature"]
    assert low == 0
    assert value < high < 4 * value


def test_any_day_needs_two_days_and_any_robot_three(arm, tmp_path, capsys):
    one = written(arm, tmp_path / "one")
    two = written(arm, tmp_path / "two", sources=2)
    code, said = exported(capsys, one, "--scope", "any-day")
    assert code == 2
    assert "known from one day; adapt it with logs of another one" in said
    assert exported(capsys, one, "--scope", "any-robot", "--units", two)[0] == 2
    wide = exported(capsys, two, "--scope", "any-day")[1]["ranges"]["elbow"]["frictionloss"]
    close = exported(capsys, two)[1]["ranges"]["elbow"]["frictionloss"]
    assert wide[2] - wide[0] > 1.5 * (close[2] - close[0])
    other = written(arm, tmp_path / "other", SERVO_FIELDS | {"kp": 24.0})
    low, _, high = exported(capsys, one, "--scope", "any-robot", "--units", two, other)[1][
        "ranges"
    ]["elbow"]["kp"]
    assert low < 16
    assert high > 24


@pytest.mark.parametrize("transmission", ["joint", "jointinparent"])
def test_a_model_takes_a_unit_without_gaponet(arm, tmp_path, capsys, transmission):
    folder = written(arm, tmp_path / "known")
    assert exported(capsys, folder, "--engine", "mujoco", "--out", tmp_path / "out")[0] == 0
    (tmp_path / "robot.xml").write_text(
        XML.replace(
            "</mujoco>",
            f'<actuator><position {transmission}="elbow" kp="20" forcerange="-3 3"/></actuator>'
            "</mujoco>",
        )
    )
    code = (
        "import sys; sys.path.insert(0, sys.argv[1])\nimport mujoco, mujoco_randomization as r\n"
        "m = mujoco.MjModel.from_xml_path(sys.argv[2]); u = r.units(); r.apply(m, u, 7)\n"
        "assert abs(m.actuator_gainprm[0, 0] - u['units']['kp'][7][1]) < 1e-6\n"
        "assert abs(m.actuator_forcerange[0, 1] - u['units']['effort_limit'][7][1]) < 1e-6\n"
        "assert abs(m.dof_frictionloss[1] - u['units']['frictionloss'][7][1]) < 1e-6\n"
        "bias = u['units']['kp'][7][1] * u['units']['offset'][7][1]\n"
        "assert abs(m.actuator_biasprm[0, 0] - bias) < 1e-6\n"
        "assert 'gaponet' not in sys.modules\n"
    )
    subprocess.run(
        [sys.executable, "-c", code, tmp_path / "out", tmp_path / "robot.xml"], check=True
    )
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml")).nu == 1


@pytest.mark.skipif(not hasattr(mujoco.MjsActuator, "set_to_pid"), reason="needs MuJoCo 4")
def test_a_servo_that_limits_the_speed_of_targets_takes_a_unit(tmp_path):
    slow = write_arm(tmp_path / "arm").with_servo(target_speed=np.array([1.0, 1.0]))
    exported = export_robot(slow, "mjcf", tmp_path / "out")
    model = mujoco.MjModel.from_xml_path(str(exported.file))
    gains = model.actuator_gainprm.copy()
    mujoco_randomization.apply(model, one_unit(), 0)
    np.testing.assert_array_equal(model.actuator_gainprm, gains)


def one_unit():
    """Return a file with one unit of the arm, without links."""
    units = {field: [[value, value]] for field, value in SERVO_FIELDS.items()}
    units["effort_limit"] = [[5.0, 5.0]]
    return {"joints": ["shoulder", "elbow"], "units": units}


def arm_with(actuators, xml=XML):
    """Return the arm with these actuators, compiled."""
    text = xml.replace("</mujoco>", f"<actuator>{actuators}</actuator></mujoco>")
    return mujoco.MjModel.from_xml_string(text)


def test_a_unit_changes_position_servos_and_no_other_actuators():
    model = arm_with(
        '<velocity joint="shoulder" kv="3"/><position joint="shoulder" kp="20"/>'
        '<motor joint="elbow"/>'
    )
    mujoco_randomization.apply(model, one_unit(), 0)
    assert model.actuator_gainprm[:, 0].tolist() == [3.0, SERVO_FIELDS["kp"], 1.0]
    assert model.actuator_biasprm[:, 1].tolist() == [0.0, -SERVO_FIELDS["kp"], 0.0]


def test_a_joint_with_two_position_servos_takes_no_unit():
    model = arm_with('<position joint="shoulder" kp="20"/><position joint="shoulder" kp="5"/>')
    with pytest.raises(ValueError, match="joint 'shoulder' has 2 position servos"):
        mujoco_randomization.apply(model, one_unit(), 0)


def test_a_unit_finds_joints_and_bodies_behind_a_prefix():
    model = arm_with('<position joint="left_elbow" kp="20"/>', XML.replace('name="', 'name="left_'))
    drawn = one_unit() | {"bodies": ["fore"]}
    drawn["units"]["links"] = [[[0.7, 0.1, 0.0, 0.0, 1e-3, 1e-3, 1e-3, 1.0, 0.0, 0.0, 0.0]]]
    mujoco_randomization.apply(model, drawn, 0, prefix="left_")
    assert model.actuator_gainprm[0, 0] == SERVO_FIELDS["kp"]
    assert model.body("left_fore").mass[0] == 0.7


@pytest.mark.parametrize("engine", ["mjlab", "isaaclab"])
def test_the_file_of_an_engine_needs_no_gaponet_and_reads_whole_units(
    arm, tmp_path, capsys, engine
):
    folder = written(arm, tmp_path / "known")
    assert exported(capsys, folder, "--engine", engine)[0] == 0
    file = folder / "randomization" / f"{engine}_randomization.py"
    assert not re.search(r"^(from|import) gaponet", file.read_text(), re.M)
    events = runpy.run_path(str(file))
    env = SimpleNamespace(num_envs=9, device="cpu")
    ids, joints, units = events["draw_units"](
        file.parent / "randomization.json", "plain_units", env, None, None
    )
    assert (len(ids), joints) == (9, ["shoulder", "elbow"])
    stored = json.loads((file.parent / "randomization.json").read_text())["units"]
    row = int(np.abs(np.array(stored["kp"])[:, 0] - float(units["kp"][4, 0])).argmin())
    for field, values in units.items():
        np.testing.assert_allclose(values[4], stored[field][row], rtol=1e-6)


def few_units(patch):
    patch.setattr(drawn_robots, "DRAWN", 32)
    patch.setattr(drawn_robots, "JUDGED", 4)


@pytest.fixture(scope="module")
def judged(tmp_path_factory):
    """Few units, drawn of a robot that is known badly and compared with its own motions."""
    folder = tmp_path_factory.mktemp("judged")
    robot = load_robot(written(write_arm(folder / "arm"), folder / "known", errors=LARGE_ERRORS))
    motions = [s.rows(slice(0, 200)) for s in own_motions(robot, count=4)]
    recordings = (motions[::2], motions[1::2])
    drawn = sample_units(robot)
    with pytest.MonkeyPatch.context() as patch:
        few_units(patch)
        made = drawn_robots.draw_robots(robot, drawn.units, recordings)
    return SimpleNamespace(robot=robot, recordings=recordings, drawn=drawn, made=made)


def test_units_that_follow_the_recordings_are_retained(judged):
    _, held_out = judged.recordings
    drawn = drawn_robots.robots_of(judged.robot, judged.drawn.units)[:8]
    error_as_drawn = np.mean([rollout_error(held_out, robot) for robot in drawn])
    assert judged.made.errors["exported"] < 1e-4  # the motions are the robot's own
    assert judged.made.errors["units"] < 0.5 * error_as_drawn
    assert len(judged.made.units["kp"]) == 8


def test_units_are_not_compared_with_recordings_at_other_gains(judged, monkeypatch):
    few_units(monkeypatch)
    others = []
    for motions in judged.recordings:
        others.append([replace(s, meta=replace(s.meta, kp=(5.0, 5.0))) for s in motions])
    notes = judge_units(judged.drawn, judged.robot, tuple(others)).notes
    assert "were not compared with recordings" in notes[-1]


def test_a_note_says_that_units_without_the_servo_model_are_missing(arm, tmp_path, capsys):
    servo = {**SERVO_FIELDS, "stribeck": 0.02, "stribeck_speed": 0.1}
    folder = written(arm, tmp_path / "known", servo)
    exported(capsys, folder, "--engine", "isaaclab")
    drawn = json.loads((folder / "randomization" / "randomization.json").read_text())
    assert "plain_units" not in drawn
    assert NO_PLAIN_UNITS in drawn["notes"]


def test_no_note_speaks_of_the_servo_model_of_a_robot_without_one(arm, tmp_path, capsys):
    folder = written(arm, tmp_path / "known")
    exported(capsys, folder)
    drawn = json.loads((folder / "randomization" / "randomization.json").read_text())
    assert NO_PLAIN_UNITS not in drawn["notes"]


def test_units_worse_than_ranges_by_hand_are_refused(judged):
    errors = judged.made.errors | {"by hand": judged.made.errors["units"] / 2}
    with pytest.raises(NoGainError, match=r"units are \d"):
        replace(judged.made, errors=errors).require_better_than_by_hand()


def test_retained_units_are_stored_and_compared_again_only_if_others_are_drawn(judged, monkeypatch):
    few_units(monkeypatch)
    rollouts = []

    def counted(*given):
        rollouts.append(given)
        return rollout_error(*given)

    monkeypatch.setattr(drawn_robots, "rollout_error", counted)
    again = judge_units(judged.drawn, judged.robot, judged.recordings)
    assert not rollouts
    np.testing.assert_array_equal(again.units["kp"], judged.made.units["kp"])
    low, value, high = again.ranges["elbow"]["kp"]
    assert low < value == judged.drawn.ranges["elbow"]["kp"][1] < high
    others = sample_units(judged.robot, seed=1).units
    drawn_robots.draw_robots(judged.robot, others, judged.recordings)
    assert rollouts


def test_units_for_an_engine_with_a_torque_speed_line_have_one_each(arm, tmp_path, monkeypatch):
    monkeypatch.setattr(drawn_robots, "DRAWN", 8)
    monkeypatch.setattr(drawn_robots, "JUDGED", 2)
    robot = load_robot(written(arm, tmp_path / "known", errors=LARGE_ERRORS))
    drawn = {field: values[:8] for field, values in sample_units(robot).units.items()}
    plain = robot.with_servo(no_load_speed=np.array([3.0, 0.0]))
    robot = plain.with_servo(stribeck=np.full(2, 0.01), stribeck_speed=np.full(2, 0.05))
    monkeypatch.setattr(
        drawn_robots, "fit_plain_servos", lambda robot, recordings, progress, terms: plain
    )
    motions = [s.rows(slice(0, 100)) for s in own_motions(robot, count=2)]
    drawn["no_load_speed"] = np.array([3.0, 0.0]) * np.random.default_rng(0).uniform(
        0.9, 1.1, (8, 2)
    )
    drawn["stribeck"] = np.full((8, 2), 0.01)
    made = drawn_robots.draw_robots(
        robot, drawn, (motions[:1], motions[1:]), True, engine_terms=("no_load_speed",)
    )
    assert "stribeck" not in made.units
    speed = np.array(made.units["no_load_speed"])
    assert ((speed[:, 0] > 2.5) & (speed[:, 0] < 3.5)).all()
    assert np.ptp(speed[:, 0]) > 0
    assert (speed[:, 1] == 0).all()
