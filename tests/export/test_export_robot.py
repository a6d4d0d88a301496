"""A robot leaves: a user's own MJCF with identified servos, the law beside it, and a check that
needs no gaponet.
"""

import json
import re
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from arm import XML, write_arm

import gaponet as gp
from gaponet.base.errors import RobotError
from gaponet.base.files import write_json
from gaponet.cli.main import main
from gaponet.export import export_folder as exporting
from gaponet.export import plain_servos
from gaponet.export.export_folder import Source, export_robot
from gaponet.export.plain_servos import (
    fit_plain_servos,
    keep_plain_servos,
    own_motions,
    rollout_error,
)
from gaponet.export.shipped.mujoco_servos import (
    Check,
    Servos,
    addresses,
    delay_weights,
    play,
    read,
)
from gaponet.export.simulator_facts import simulator_facts
from gaponet.robot.folder import PROVENANCE_FILE, save_robot
from gaponet.robot.servo_fields import SERVO_FIELDS, SERVO_TERMS
from gaponet.robot.spec import Link, load_robot
from gaponet.robot.toml_file import Table
from gaponet.sim.model import build_model, model_hash
from gaponet.sim.replay import replay

FOUND = {
    "shoulder": {
        "kp": 16.0,
        "damping": 0.8,
        "frictionloss": 0.1,
        "delay": 0.013,
        "offset": 0.02,
        "zero": 0.01,
    },
    "elbow": {"kp": 24.0, "armature": 0.03, "delay": 0.006, "stop_low": -1.2},
}
LAWS = {joint: {"stribeck": 0.3, "stribeck_speed": 0.1, "friction_motor": 0.1} for joint in FOUND}
MAIN = """<mujoco model="my scene">
  <!-- degrees, as MuJoCo has it where nothing is said -->
  <compiler autolimits="true" meshdir="meshes"/>
  <option integrator="implicitfast" timestep="{step}"><flag contact="disable"/></option>
  <include file="parts/defaults.xml"/>
  <asset><mesh name="wedge" file="wedge.obj"/></asset>
  <worldbody>
    <body name="ball" pos="1 0 0"><freejoint/><geom size="0.1" mass="1"/></body>
    <include file="parts/arm.xml"/>
  </worldbody>
  <tendon><fixed name="both"><joint joint="shoulder" coef="1"/>
    <joint joint="elbow" coef="1"/></fixed></tendon>
  <actuator>
    <!-- mine -->
    <position class="servo" name='first' joint="shoulder" ctrlrange="-80 80"/>
    <motor name="thumb" joint="thumb" gear="2"/>
    <general name="second" joint="elbow"/>
  </actuator>
  <sensor><jointpos joint="elbow"/><tendonpos tendon="both"/></sensor>
  <keyframe><key name="home" qpos="1 0 0 1 0 0 0 0.1 0.2 0" ctrl="0.1 0 0.2"/></keyframe>
</mujoco>
"""
DEFAULTS = """<mujocoinclude><default>
  <joint damping="0.5" armature="0.02" frictionloss="0.05"/>
  <general gear="3" dyntype="integrator" biastype="none"/>
  <default class="servo"><position kp="99" forcerange="-1 1" gear="1"/></default>
</default></mujocoinclude>
"""
ARM = """<mujocoinclude>
  <body name="upper">
    <joint name="shoulder" axis="0 1 0"
           range="-85.94366926962348 85.94366926962348"/> <!-- turned by hand -->
    <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.3" contype="0" conaffinity="0"/>
    <body name="fore" pos="0.2 0 0">
      <joint armature='7' name="elbow" axis="0 1 0" range="-85.94366926962348 85.94366926962348"/>
      <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.2"
            contype="0" conaffinity="0"/>
      <geom type="mesh" mesh="wedge" mass="0" contype="0" conaffinity="0"/>
      <site name="tip" pos="0.2 0 0"/>
      <body name="thumb" pos="0.2 0 0"><joint name="thumb" axis="0 0 1"/>
        <geom size="0.01" mass="1e-6"/></body>
    </body>
  </body>
</mujocoinclude>
"""
WEDGE = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("arm") / "arm").with_identified(FOUND)


@pytest.fixture(scope="module")
def lawful(robot):
    return robot.with_identified(LAWS)


@pytest.fixture(autouse=True)
def short_motions(monkeypatch):
    """Motions of the robot itself last three seconds."""
    monkeypatch.setattr(plain_servos, "OWN_MOTION_S", 3.0)


def write_scene(folder):
    """Write a user's scene: includes, degrees, defaults, a mesh, a tendon, sensors, a keyframe, a
    servo and a body before.
    """
    for name, text in {
        "scene.xml": MAIN.format(step=0.005),
        "parts/defaults.xml": DEFAULTS,
        "parts/arm.xml": ARM,
        "meshes/wedge.obj": WEDGE,
    }.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder / "scene.xml"


@pytest.fixture
def mine(tmp_path):
    """A user's scene."""
    return write_scene(tmp_path / "mine")


def without_terms(robot, *args, **options):
    """The form without the law is not searched for: that is identification's, and tried below."""
    return robot.with_identified({joint: dict.fromkeys(SERVO_TERMS, 0.0) for joint in FOUND})


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(exporting, "fit_plain_servos", without_terms)


@pytest.fixture(scope="module")
def edited(lawful, tmp_path_factory):
    """A user's scene that took the robot's servos: the export, and the model before and now."""
    folder = tmp_path_factory.mktemp("edited")
    scene = write_scene(folder / "mine")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plain_servos, "OWN_MOTION_S", 3.0)
        patch.setattr(exporting, "fit_plain_servos", without_terms)
        made = export_robot(lawful, "mjcf", folder / "out", source=Source(scene))
    before, now = (mujoco.MjModel.from_xml_path(str(file)) for file in (scene, made.file))
    return SimpleNamespace(made=made, scene=scene, out=folder / "out", before=before, now=now)


def test_a_users_file_moves_as_gaponet_does(edited):
    errors = edited.made.errors
    assert edited.made.virtual
    assert errors["in gaponet"] == pytest.approx(0.0, abs=1e-9)
    assert errors["scene.xml with mujoco_servos.py"] < 2e-5
    assert errors["scene.xml alone"] == pytest.approx(
        errors["in gaponet, without the servo model"], rel=0.02
    )
    assert errors["scene.xml alone"] > 0.003
    assert any("elbow met something at -1.20 rad" in note for note in edited.made.notes)


def test_a_users_file_keeps_all_that_is_the_users(edited):
    before = edited.before
    now = edited.now
    assert np.array_equal(before.key_qpos, now.key_qpos)
    assert [now.actuator(i).name for i in range(3)] == ["first", "thumb", "second"]
    assert now.actuator_gear[1, 0] == 2
    assert now.sensor_type.tolist() == before.sensor_type.tolist()
    assert now.site("tip").pos.tolist() == before.site("tip").pos.tolist()
    assert (before.nsite, before.ntendon, before.nmesh) == (1, 1, 1)
    assert (now.nsite, now.ntendon, now.nmesh) == (1, 1, 1)


def test_a_users_file_in_degrees_gets_ranges_in_degrees_and_zeros_of_its_joints(edited):
    now = edited.now
    low_and_high = [-80 * 180 / np.pi, 80 * 180 / np.pi]
    assert np.degrees(now.actuator_ctrlrange[0]) == pytest.approx(low_and_high)
    assert now.qpos0[now.joint("shoulder").qposadr[0]] == pytest.approx(-0.01)


def test_only_what_had_to_change_is_changed_in_a_copy_of_a_users_file(edited):
    text = edited.made.file.read_text() + (edited.out / "parts/arm.xml").read_text()
    assert "<!-- mine -->" in text
    assert "<!-- turned by hand -->" in text
    assert (edited.out / "parts/defaults.xml").read_text() == DEFAULTS
    assert edited.scene.read_text() == MAIN.format(step=0.005)
    changed = []
    for line in (edited.out / "changes.diff").read_text().splitlines():
        if line[:1] in "+-" and line[:3] not in ("+++", "---"):
            changed.append(line)
    # Two joints, of which one is of two lines, two servos, and the solver's tolerance.
    assert len(changed) == 9


def test_the_check_travels(robot, mine, tmp_path):
    made = export_robot(robot, "mjcf", tmp_path / "out", source=Source(mine))
    assert not [f for f in (tmp_path / "out").glob("*.py") if "from gaponet" in f.read_text()]
    said = subprocess.run(
        [sys.executable, "check.py"],
        cwd=tmp_path / "out",
        check=True,
        capture_output=True,
        text=True,
    )
    assert "the MJCF alone: 0.0" in said.stdout
    assert made.errors["scene.xml alone"] < 2e-5


def test_an_engine_that_steps_twice_as_long_keeps_delays_and_tells_its_price(robot, mine, tmp_path):
    mine.write_text(MAIN.format(step=0.01))
    made = export_robot(robot, "mjcf", tmp_path / "out", source=Source(mine))
    model = mujoco.MjModel.from_xml_path(str(made.file))
    assert model.opt.timestep == 0.01
    assert model.actuator_delay.tolist() == [0.013, 0.0, 0.006]
    assert 2e-5 < made.errors["scene.xml alone"] < 0.002


def test_a_servo_whose_gains_and_commands_are_in_degrees_takes_radians_from_now_on(
    robot, lawful, mine, tmp_path, quick
):
    degrees = 'gainprm="0.42" biasprm="0 -24 -0.5" biastype="affine" gear="1" ctrlrange="-90 90"'
    plain = '<general name="second" joint="elbow"/>'
    mine.write_text(mine.read_text().replace(plain, f"{plain[:-2]} {degrees}/>"))
    made = export_robot(lawful, "mjcf", tmp_path / "out", source=Source(mine))
    servo = mujoco.MjModel.from_xml_path(str(made.file)).actuator("second")
    assert servo.gainprm[0] == 24.0
    assert servo.biasprm[:2].tolist() == [0.0, -24.0]
    assert servo.ctrlrange.tolist() == pytest.approx([-90 * 0.42 / 24, 90 * 0.42 / 24])
    assert "targets of elbow were not in rad before (degrees, or another sign?)" in made.notes[-1]
    assert made.errors["scene.xml with mujoco_servos.py"] < 2e-5
    assert (
        f'-    <general name="second" joint="elbow" {degrees}/>'
        in (tmp_path / "out/changes.diff").read_text()
    )


def test_a_joint_that_turns_without_end_leaves_beside_one_that_does_not(tmp_path, quick):
    xml = XML.replace(' range="-1.5 1.5"/>', "/>", 1).replace(
        "<option ", '<option timestep="0.005" '
    )
    endless = write_arm(tmp_path / "arm", xml=xml).with_identified(LAWS)
    made = export_robot(endless, "mjcf", tmp_path / "out")
    assert made.errors["robot.xml with mujoco_servos.py"] < 2e-5


def test_two_robots_in_one_scene_are_told_apart_by_what_stands_before_their_names(
    robot, lawful, tmp_path, quick
):
    body = """<body name="{0}upper">
        <joint name="{0}shoulder" axis="0 1 0"/><geom size=".1" mass=".3"/>
        <body pos=".2 0 0">
        <joint name="{0}elbow" axis="0 1 0"/><geom size=".1" mass=".2"/></body></body>"""
    scene = tmp_path / "scene.xml"
    scene.write_text(
        f"<mujoco><worldbody>{body.format('left_')}{body.format('right_')}</worldbody></mujoco>"
    )
    first = export_robot(robot, "mjcf", tmp_path / "one", source=Source(scene, "left_"))
    both = export_robot(lawful, "mjcf", tmp_path / "two", source=Source(first.file, "right_"))
    model = mujoco.MjModel.from_xml_path(str(both.file))
    assert [model.actuator(i).name for i in range(4)] == [
        "left_shoulder",
        "left_elbow",
        "right_shoulder",
        "right_elbow",
    ]
    assert model.actuator_gainprm[:, 0].tolist() == [16.0, 24.0, 16.0, 24.0]
    with pytest.raises(RobotError, match="--prefix"):
        export_robot(robot, "mjcf", tmp_path / "none", source=Source(scene))

    facts = read(tmp_path / "two" / "facts.json")
    stiff = model.dof_invweight0 * facts["dof_invweight0_factor"]
    Servos(model, facts, "left_")
    Servos(model, facts, "right_")
    np.testing.assert_allclose(model.dof_invweight0 / stiff, 1.0, rtol=0.5)
    weaker = facts | {
        "joints": {name: servo | {"effort_limit": 1.5} for name, servo in facts["joints"].items()}
    }
    Servos(model, weaker, "right_")
    np.testing.assert_array_equal(model.actuator_forcerange[2:], [[-1.5, 1.5]] * 2)


def test_an_export_whose_error_is_not_finite_is_refused(robot, tmp_path, monkeypatch):
    monkeypatch.setattr(exporting, "_error_in_mujoco", lambda *_: np.nan)
    with pytest.raises(RobotError, match=r"robot\.xml alone is nan"):
        export_robot(robot, "mjcf", tmp_path / "out")
    assert not (tmp_path / "out" / "facts.json").exists()


def test_an_actuator_of_a_tendon_with_a_joints_number_is_no_servo(robot, tmp_path):
    spec = mujoco.MjSpec.from_file(str(export_robot(robot, "mjcf", tmp_path / "out").file))
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    spec.add_tendon(name="both").wrap_joint("elbow", 1.0)
    for trntype, target in (
        (mujoco.mjtTrn.mjTRN_TENDON, "both"),
        (mujoco.mjtTrn.mjTRN_JOINT, "shoulder"),
        (mujoco.mjtTrn.mjTRN_JOINT, "elbow"),
    ):
        spec.add_actuator(name=target, target=target, trntype=trntype).set_to_position(kp=1.0)
    at = addresses(spec.compile(), ["shoulder", "elbow"])
    assert at.servo.tolist() == [1, 2]


IN_PARENT = """<tendon><fixed name="both"><joint joint="elbow" coef="1"/></fixed></tendon>
  <actuator><general name="pull" tendon="both"/><general name="pull2" tendon="both"/>
  <general name="mine" jointinparent="elbow" gainprm="20" biastype="affine" biasprm="0 -20 0"
    forcerange="-5 5"/></actuator></mujoco>"""


def test_a_servo_in_the_parents_frame_is_the_joints_servo(robot, tmp_path):
    scene = tmp_path / "scene.xml"
    text = robot.mjcf.read_text().replace("<option ", '<option timestep="0.005" ')
    scene.write_text(text.replace("</mujoco>", IN_PARENT))
    made = export_robot(robot, "mjcf", tmp_path / "out", source=Source(scene))
    model = mujoco.MjModel.from_xml_path(str(made.file))
    assert [model.actuator(i).name for i in range(model.nu)] == [
        "pull",
        "pull2",
        "mine",
        "shoulder",
    ]
    assert made.errors["scene.xml alone"] < 2e-5
    spec = mujoco.MjSpec.from_file(str(scene))
    assert addresses(spec.compile(), ["elbow"]).servo.tolist() == [2]


def test_a_users_file_carries_the_payload_that_the_robot_carries_or_none(robot, tmp_path):
    empty = replace(robot, scene=replace(robot.scene, carries_payload=False))
    made = export_robot(empty, "mjcf", tmp_path / "out", payload_mass=1.0)
    assert mujoco.MjModel.from_xml_path(str(made.file)).body_mass.sum() < 1.0
    scene = tmp_path / "scene.xml"
    text = robot.mjcf.read_text().replace("<compiler ", '<compiler settotalmass="0.5" ')
    scene.write_text(text)
    with pytest.raises(RobotError, match="settotalmass"):
        export_robot(robot, "mjcf", tmp_path / "mine", source=Source(scene), payload_mass=1.0)


def test_a_file_in_one_line_takes_a_payload_right_before_a_joint(robot, tmp_path):
    text = re.sub(r">\s+<", "><", robot.mjcf.read_text().strip())
    scene = tmp_path / "scene.xml"
    scene.write_text(text.replace("<option ", '<option timestep="0.005" '))
    made = export_robot(robot, "mjcf", tmp_path / "out", source=Source(scene), payload_mass=0.2)
    assert '"/></body><joint' in made.file.read_text().replace("\n", "")
    model = mujoco.MjModel.from_xml_path(str(made.file))
    own = build_model(robot, 0.2)
    assert model.body_mass.sum() == pytest.approx(own.body_mass.sum())
    assert model.dof_armature.tolist() == own.dof_armature.tolist()
    assert made.errors["scene.xml alone"] < 2e-5


def test_an_engine_with_another_order_of_joints_is_told_by_name(lawful, tmp_path, quick):
    free = 'type="capsule" size=".1 .1" mass=".3" contype="0" conaffinity="0"'
    other = f'<body name="other"><joint name="elbow_of_another" axis="0 1 0"/><geom {free}/></body>'
    servos = [("a", "elbow", 3), ("z", "elbow_of_another", 7), ("b", "shoulder", 5)]
    drives = "".join(
        f'<position name="{name}" joint="{joint}" kp="{kp}"/>' for name, joint, kp in servos
    )
    text = lawful.mjcf.read_text().replace("<option ", '<option timestep="0.005" ')
    text = text.replace("<worldbody>", f"<worldbody>{other}").replace(
        "</mujoco>", f"<actuator>{drives}</actuator></mujoco>"
    )
    scene = tmp_path / "scene.xml"
    scene.write_text(text)
    made = export_robot(lawful, "mjcf", tmp_path / "out", source=Source(scene))
    model = mujoco.MjModel.from_xml_path(str(made.file))
    assert [model.actuator(i).name for i in range(3)] == ["a", "z", "b"]
    assert model.actuator_gainprm[:, 0].tolist() == [24.0, 7.0, 16.0]
    assert made.errors["scene.xml with mujoco_servos.py"] < 2e-5


def test_a_joint_with_two_servos_is_refused(robot, mine, tmp_path):
    text = mine.read_text().replace(
        '<motor name="thumb" joint="thumb"', '<velocity name="thumb" joint="elbow"'
    )
    mine.write_text(text)
    with pytest.raises(RobotError, match="elbow"):
        export_robot(robot, "mjcf", tmp_path / "out", source=Source(mine))


def test_a_delay_buffer_of_five_lines_is_mujocos_own_delay(robot, tmp_path):
    made = export_robot(robot, "mjcf", tmp_path / "out")
    facts = json.loads((tmp_path / "out/facts.json").read_text())
    spec = mujoco.MjSpec.from_file(str(made.file))
    late = spec.compile()
    for servo in spec.actuators:
        servo.delay = servo.nsample = 0
    model = spec.compile()
    late.opt.timestep = model.opt.timestep = 0.005
    (motion,) = own_motions(robot, count=1)
    native = play(
        late,
        facts,
        {"ctrl": motion.ctrl, "qpos": motion.qpos, "qvel": motion.qvel, "dt": 0.02},
        form="plain",
    )
    weights = delay_weights([0.013, 0.006], 0.005)
    data = mujoco.MjData(model)
    data.qpos[:] = motion.qpos[0]
    past = np.tile(motion.ctrl[0], (len(weights), 1))
    found = [motion.qpos[0]]
    for ctrl in motion.ctrl[:-1]:
        for _ in range(4):
            past = np.concatenate([ctrl[None], past[:-1]])
            data.ctrl[:] = (weights * past).sum(0)
            mujoco.mj_step(model, data)
        found.append(data.qpos.copy())
    np.testing.assert_allclose(found, native, atol=1e-6)


def test_the_nearest_servos_without_a_law_are_nearer_than_those_with_the_law_struck_out(lawful):
    motions = [s.rows(slice(0, 150)) for s in own_motions(lawful, count=4)]
    struck = lawful.with_identified({j: dict.fromkeys(SERVO_TERMS, 0.0) for j in FOUND})
    plain = fit_plain_servos(lawful, motions[:2])
    assert not plain.servo.has_terms
    assert rollout_error(motions[2:], plain) < 0.8 * rollout_error(motions[2:], struck)
    assert fit_plain_servos(struck, motions) is struck


@pytest.fixture(scope="module")
def two_motions(lawful):
    return own_motions(lawful, count=2)


@pytest.fixture
def fitted(lawful, two_motions, tmp_path, monkeypatch):
    """A stored robot that was fitted once: its folder, the fits made, and the first fit's robot."""
    fits = []

    def identify(sequences, start, **_):
        fits.append(sequences)
        return SimpleNamespace(robot=start.with_identified({"elbow": {"kp": 23.0}}))

    monkeypatch.setattr(plain_servos, "identify", identify)
    folder = tmp_path / "identified"
    save_robot(lawful, folder)
    first = fit_plain_servos(load_robot(folder), two_motions)
    return SimpleNamespace(folder=folder, fits=fits, first=first)


def test_an_export_of_an_unchanged_robot_does_not_fit_again(fitted, two_motions):
    again = fit_plain_servos(load_robot(fitted.folder), two_motions)
    assert len(fitted.fits) == 1
    for field in SERVO_FIELDS:
        assert np.array_equal(fitted.first.servo[field], again.servo[field], equal_nan=True)
    assert model_hash(fitted.first) == model_hash(again)
    assert not fitted.first.servo.has_terms
    assert again.nominal is not None


def test_an_export_with_other_recordings_fits_again(fitted, two_motions):
    others = [replace(s, qvel=s.qvel + 1.0) for s in two_motions]
    fit_plain_servos(load_robot(fitted.folder), others)
    assert len(fitted.fits) == 2


def test_an_export_whose_stored_fit_is_damaged_fits_again(fitted, two_motions):
    (fitted.folder / "plain_servos.json").write_text("damaged")
    fit_plain_servos(load_robot(fitted.folder), two_motions)
    assert len(fitted.fits) == 2


def test_an_export_stores_no_fit_in_a_folder_that_the_user_made(fitted, lawful, two_motions):
    fit_plain_servos(lawful, two_motions)
    assert len(fitted.fits) == 2
    assert not (lawful.folder / "plain_servos.json").exists()


def test_check_motions_run_in_worlds_that_restart(robot, tmp_path, capsys):
    motions = [s.rows(slice(0, 20 + 7 * i)) for i, s in enumerate(own_motions(robot, count=5))]
    export_robot(robot, "newton", tmp_path, (motions, motions))
    check = Check(tmp_path)
    recorded = {}

    def start(begun, ctrl):
        for world, motion in begun.items():
            assert np.array_equal(ctrl[world], motion["ctrl"][0])
            recorded[world] = iter(motion["qpos"][1:])

    path = check.run(
        start, lambda ctrl: np.array([next(recorded[w], np.zeros(2)) for w in range(check.worlds)])
    )
    check.report("recorded", path)
    assert capsys.readouterr().out == "recorded, 3 worlds: 0.00 mrad; in gaponet 0.00\n"


def test_recordings_at_another_period_than_the_robots_are_checked_at_their_own(robot, tmp_path):
    motions = own_motions(robot, count=3)
    export_robot(replace(robot, dt=3 * robot.dt), "newton", tmp_path, (motions, motions))
    check = Check(tmp_path)
    assert check.facts["dt"] == pytest.approx(robot.dt)
    assert check.step == pytest.approx(robot.timestep)


def test_of_recordings_at_two_rates_those_at_the_robots_are_checked(robot, tmp_path):
    motions = own_motions(robot, count=4)
    twice_as_fast = [replace(motion, dt=robot.dt / 2) for motion in motions[:2]]
    motions = [*twice_as_fast, *motions[2:]]
    export_robot(robot, "newton", tmp_path, (motions, motions))
    check = Check(tmp_path)
    assert [float(motion["dt"]) for motion in check.motions] == pytest.approx([robot.dt] * 2)
    assert check.step == pytest.approx(robot.timestep)


def test_a_robot_folder_leaves_by_the_command_and_without_torch(robot, tmp_path, capsys):
    alone = (
        "import sys; from gaponet.cli.main import main; "
        "sys.exit(main(sys.argv[1:]) or 9 * ('torch' in sys.modules))"
    )
    words = ["export", str(robot.folder), "--to", "mjcf", "--out", str(tmp_path / "alone")]
    subprocess.run([sys.executable, "-c", alone, *words], check=True)
    for to in ("mjcf", "newton", "json", "mjlab", "isaaclab"):
        assert (
            main(["export", str(robot.folder), "--to", to, "--out", str(tmp_path / to), "--json"])
            == 0
        )
        told = json.loads(capsys.readouterr().out)
        assert told["robot"] == "arm"
        facts = json.loads((tmp_path / to / "facts.json").read_text())
        assert facts["plain"]["elbow"]["kp"] == 20.0
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "newton/robot.xml")).nu == 0
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "mjlab/robot.xml")).nu == 2
    compile((tmp_path / "newton" / "robot_cfg.py").read_text(), "newton", "exec")
    assert main(["export", str(robot.folder), "--to", "torch"]) == 2
    assert "is a robot, which has no network" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("dataset", "state"), [("../data", "gone from {}"), ("data", "not at hand")]
)
def test_an_export_says_when_the_recordings_of_a_robot_are_not_there(
    robot, tmp_path, dataset, state
):
    save_robot(robot, tmp_path / "identified")
    nothing = {"train": {}, "val": {}, "test": {}}
    origin = {"dataset": dataset, "parts": nothing, "motions": {}, "val_mpjae": {}}
    write_json(tmp_path / "identified" / PROVENANCE_FILE, origin)
    made = gp.export_robot(tmp_path / "identified", to="json", out=tmp_path / "out")
    note = made.notes[-1]
    assert state.format(tmp_path / "data") in note
    assert "--data DATASET" in note


def test_json_names_the_masses_and_the_table_that_the_users_model_lacks(robot, tmp_path):
    fore = robot.payload_mounts[0]
    link = Link(0.4, (0.12, 0.0, 0.01), (1e-4, 2e-3, 2e-3, 0.0, 0.0, 0.0))
    heavy = replace(robot, payload_mounts=(replace(fore, mass=0.6),), links={"upper": link})
    made = export_robot(heavy.with_table(Table(height=-0.5)), "json", tmp_path)
    notes = " ".join(made.notes)
    assert "0.6 kg at fore" in notes
    assert "height -0.500 m" in notes
    assert "inertias of upper" in notes


@pytest.mark.parametrize("to", ["isaaclab", "newton"])
def test_a_scene_without_the_table_says_so(robot, tmp_path, to):
    made = export_robot(robot.with_table(Table(height=-0.5)), to, tmp_path)
    assert f"the scene for {to} does not get the table" in " ".join(made.notes)


def test_facts_hold_both_forms(robot, lawful):
    facts = simulator_facts(lawful, 0.02, plain=robot.with_servo(kp=robot.servo.kp + 1))
    assert facts["law"] == ["stribeck", "stribeck_speed", "friction_motor"]
    assert (facts["joints"]["elbow"]["kp"], facts["plain"]["elbow"]["kp"]) == (24.0, 25.0)
    assert replay(own_motions(robot, count=1), robot)[0].qpos.shape[1] == 2


def test_an_export_takes_the_fit_without_terms_that_identify_kept(lawful, tmp_path, monkeypatch):
    folder = tmp_path / "identified"
    save_robot(lawful, folder)
    motions = own_motions(lawful, count=2)
    without = lawful.with_identified(
        {j: dict.fromkeys(SERVO_TERMS, 0.0) | {"kp": 23.0} for j in FOUND}
    )
    keep_plain_servos(folder, without, motions)
    monkeypatch.delattr(plain_servos, "identify")  # no fit is possible
    plain = fit_plain_servos(load_robot(folder), motions[::-1])
    assert not plain.servo.has_terms
    assert plain.servo.kp[plain.operated_index].tolist() == [23.0] * len(plain.operated)


@pytest.mark.skipif(not hasattr(mujoco.MjsActuator, "set_to_pid"), reason="needs MuJoCo 4")
def test_the_mjcf_limits_the_speed_of_targets_by_itself(tmp_path):
    """gaponet moves a target once per period of 20 ms, MuJoCo in each step of 5 ms: up to 0.5 ·
    0.02 rad apart.
    """
    speed = 0.5
    slow = {joint: {"target_speed": speed} for joint in FOUND}
    robot = write_arm(tmp_path / "arm").with_identified(slow)

    exported = export_robot(robot, "mjcf", tmp_path / "out")

    assert exported.file is not None
    model = mujoco.MjModel.from_xml_path(str(exported.file))
    check = Check(tmp_path / "out")
    targets = check.motions[0]["ctrl"]
    assert np.abs(np.diff(targets, axis=0)).max() > 2 * speed * robot.dt
    for motion in check.motions:
        played = play(model, check.facts, motion, form="plain")
        assert np.abs(played - motion["qpos"]).max() < speed * robot.dt
