"""gaponet robot new: a robot folder has the dynamics of the vendor's model."""

import tomllib
from pathlib import Path

import mujoco
import numpy as np
import pytest
from vendors import BOX, MJCF, URDF, write_mjcf, write_urdf

from gaponet.base.errors import RobotError, UsageError
from gaponet.data.log import Channel, Log
from gaponet.data.sequence import SequenceMeta, to_sequence
from gaponet.robot.mjcf import read_mjcf
from gaponet.robot.new import NewRobot, new_robot
from gaponet.robot.spec import servo_type
from gaponet.robot.toml_file import RobotOptions
from gaponet.sim.model import build_model
from gaponet.sim.robot_check import check_robot

GAINS = {"kp": ("20",), "kd": ("1",)}
ARM = ("shoulder", "elbow", "roll")


def make(tmp_path: Path, model: Path | None = None, **wanted) -> NewRobot:
    return new_robot(
        model or write_mjcf(tmp_path / "repo"), tmp_path / "out", RobotOptions(**(GAINS | wanted))
    )


def written(made: NewRobot) -> dict[str, dict]:
    table = tomllib.loads((made.robot.folder / "robot.toml").read_text(encoding="utf-8"))
    return {joint["name"]: joint for joint in table["joint"]}


def inertia(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    columns = np.zeros((model.nv, model.nv))
    for column, unit in zip(columns, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, column, unit)
    return columns


def furthest(made: NewRobot) -> tuple[float, float]:
    """Largest difference of gravity (N·m) and inertia (kg·m²) at kept joints over 50 postures,
    other joints at home.
    """
    ours = build_model(made.robot)
    theirs = made.vendor
    a = mujoco.MjData(ours)
    b = mujoco.MjData(theirs)
    places = np.array([theirs.joint(name).qposadr[0] for name in made.robot.joint_names])
    dofs = np.array([theirs.joint(name).dofadr[0] for name in made.robot.joint_names])
    rng = np.random.default_rng(0)
    worst = np.zeros(2)
    for _ in range(50):
        a.qpos[:] = rng.uniform(*np.clip(made.robot.qpos_range.T, -3, 3))
        b.qpos[:] = made.pose
        b.qpos[places] = a.qpos
        mujoco.mj_forward(ours, a)
        mujoco.mj_forward(theirs, b)
        gravity = np.abs(a.qfrc_bias - b.qfrc_bias[dofs]).max()
        worst = np.maximum(
            worst,
            [gravity, np.abs(inertia(ours, a) - inertia(theirs, b)[np.ix_(dofs, dofs)]).max()],
        )
    return float(worst[0]), float(worst[1])


def test_unlogged_joints_are_fixed_and_gravity_and_inertia_are_unchanged(tmp_path):
    made = make(tmp_path, joints=ARM)
    assert made.robot.joint_names == ("shoulder", "elbow", "roll")
    assert max(furthest(made)) < 1e-9
    made.vendor.body_mass[made.vendor.body("left_finger").id] *= 1.1
    assert max(furthest(made)) > 1e-3  # and 5 g of a finger are seen
    assert any("left_slide at 0.03 m" in note and "hip at -0.4 rad" in note for note in made.notes)


def test_notes_name_coupled_joints_and_a_free_base(tmp_path):
    body = (
        '<body><joint name="{0}" axis="1 0 0" range="-1 1"/>'
        '<geom type="sphere" size=".02" pos="0 0 .1"/>{1}</body>'
    )
    thumb = body.format("thumb", body.format("tip", ""))
    file = tmp_path / "fingers.xml"
    file.write_text(
        f'<mujoco><worldbody><body><freejoint/><geom size=".1"/>{thumb}</body></worldbody>'
        '<equality><joint joint1="tip" joint2="thumb" polycoef="0 1 0.3 0 0"/></equality>'
        '<actuator><position joint="thumb" kp="2"/></actuator></mujoco>'
    )
    notes = make(tmp_path, file).notes
    assert any(note.startswith("tip moves with thumb and is fixed here") for note in notes)
    assert any("the base is fixed here" in note for note in notes)


def test_fixed_joints_have_the_position_of_the_keyframe(tmp_path):
    made = make(tmp_path, joints=ARM, keyframe="low")
    assert max(furthest(made)) < 1e-9
    np.testing.assert_allclose(made.robot.qpos_home, [0.0, 0.5, 0.0])


def test_the_folder_names_no_file_and_no_dropped_element(tmp_path):
    made = make(tmp_path, joints=ARM)
    text = made.robot.mjcf.read_text(encoding="utf-8")
    assert not any(
        word in text for word in ("slide", "file=", "<sensor", "<keyframe", "<tendon", "<equality")
    )
    spec = read_mjcf(made.robot.mjcf)
    assert not any(g.contype or g.conaffinity for g in spec.geoms)


OF_TWO_JOINTS = {"kp": ("hip=200", "roll=3"), "kd": ("hip=9", "roll=0.2")}


def test_gains_and_limits_come_from_actuators_with_their_gears(tmp_path):
    joints = written(make(tmp_path, **OF_TWO_JOINTS))
    assert joints["shoulder"]["kp"] == 60.0
    assert joints["shoulder"]["kd"] > 1.0  # dampratio
    assert joints["shoulder"]["effort_limit"] == 9.0
    assert joints["elbow"]["kp"] == 40.0  # gear 2, twice
    assert joints["elbow"]["kd"] == 2.0
    # actuatorfrcrange, its smaller side, before forcerange times gear, 8
    assert joints["elbow"]["effort_limit"] == 6.0
    assert joints["roll"]["effort_limit"] == 1.5  # ctrlrange of a motor, times gear
    assert joints["shoulder"]["aliases"] == ["shoulder_servo"]


@pytest.mark.parametrize(
    "source",
    [
        "its actuator in vendor.xml",
        "actuatorfrcrange (in a URDF, effort) in vendor.xml",
        "# N·m/rad: --kp",
        'keyframe "home"',
        "a guess: tcp",
        "vendor.xml has 0.004",
    ],
)
def test_robot_toml_names_the_source_of_a_number(tmp_path, source):
    made = make(tmp_path, **OF_TWO_JOINTS)
    assert source in (made.robot.folder / "robot.toml").read_text(encoding="utf-8")


def test_made_robots_pass_the_check_at_the_model_s_own_step(tmp_path):
    made = make(tmp_path, kp=("20", "hip=200"))
    assert made.robot.timestep == 0.004
    assert [
        f.message for f in check_robot(made.robot, (0.0, 0.2)) if f.level in ("warning", "error")
    ] == []


def test_the_payload_hangs_at_the_tool_s_site(tmp_path):
    (mount,) = make(tmp_path, joints=ARM).robot.payload_mounts
    assert (mount.side, mount.body, mount.pos) == ("hand", "wrist", (0.12, 0.0, 0.01))


def test_contacts_are_an_option(tmp_path):
    made = make(tmp_path, contacts=True)
    assert made.robot.scene.contacts
    assert any(g.contype for g in read_mjcf(made.robot.mjcf).geoms)


def test_missing_meshes_are_omitted_with_a_note(tmp_path):
    made = make(tmp_path, write_mjcf(tmp_path / "repo", mesh=False))
    assert any("1 mesh(es) are not in" in note and note.endswith("link") for note in made.notes)


def test_names_with_a_slash_and_classes_with_a_material_are_accepted(tmp_path):
    model = write_mjcf(tmp_path / "repo")
    text = (
        model.read_text()
        .replace('"elbow"', '"left/elbow"')
        .replace("<asset>", '<asset><material name="dark"/>')
    )
    text = text.replace(
        "<default>\n", '<default>\n<default class="dark"><geom material="dark"/></default>\n', 1
    )
    model.write_text(text.replace('<body name="wrist"', '<body name="wrist" childclass="dark"'))
    robot = make(tmp_path, model, joints=("*shoulder", "*elbow", "*roll")).robot
    assert robot.joint_names == ("shoulder", "left_elbow", "roll")
    assert build_model(robot, 1.0).nv == 3
    assert robot.resolve("left/elbow", "a.csv") == "left_elbow"


def test_a_urdf_in_its_package_becomes_a_robot(tmp_path):
    made = make(tmp_path, write_urdf(tmp_path), kp=("50",))
    assert made.robot.joint_names == ("lift", "bend")
    assert made.robot.servo.effort_limit.tolist() == [30.0, 12.0]
    assert max(furthest(made)) < 1e-9
    assert made.robot.payload_mounts[0].body == "tool0"
    assert made.vendor.nmesh == 1  # of package://
    assert any(
        note.startswith("1 mesh(es) were not found") and "link.dae" in note for note in made.notes
    )
    spec = read_mjcf(made.robot.mjcf)
    assert (float(spec.joint("lift").damping[0]), float(spec.joint("lift").frictionloss)) == (
        0.3,
        0.2,
    )


LINK = """<link name="{0}"><inertial><mass value="{1}"/>
<inertia ixx="{2}" iyy="{2}" izz="{2}" ixy="0" ixz="0" iyz="0"/>
</inertial>{3}</link>"""
TURN = """<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/>
<axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="5" velocity="1"/></joint>"""


def hand(*links: str) -> str:
    """A URDF: base, left_arm, left_palm, and two fingers on it; what `links` say of arm, palm and
    fingers.
    """
    chain = (
        ("base", "left_arm"),
        ("left_arm", "left_palm"),
        ("left_palm", "left_hand_a"),
        ("left_palm", "left_hand_b"),
    )
    turns = [TURN.format(f"turn_{child}", parent, child) for parent, child in chain]
    return "".join(['<robot name="r"><link name="base"/>', *links, *turns, "</robot>"])


def test_impossible_inertias_are_replaced_with_a_note(tmp_path):
    links = [
        LINK.format("left_arm", 1.0, 0.01, ""),
        LINK.format("left_palm", 0.5, 0, ""),
        LINK.format("left_hand_a", 0, 0, ""),
        LINK.format("left_hand_b", 0.1, 1e-4, ""),
    ]
    (tmp_path / "r.urdf").write_text(hand(*links))
    made = make(tmp_path, tmp_path / "r.urdf")
    told = " ".join(made.notes)
    assert "inertia that no body has, taken as a ball's of the link's mass: left_palm" in told
    assert "links without mass behind a joint, taken as 1 mg: left_hand_a" in told
    palm, tip = (made.vendor.body(name) for name in ("left_palm", "left_hand_a"))
    radius = (3 * 0.5 / (4 * np.pi * 1000)) ** (1 / 3)
    assert palm.mass[0] == 0.5
    assert palm.inertia == pytest.approx(np.full(3, 0.4 * 0.5 * radius**2))
    assert tip.mass[0] == pytest.approx(1e-6)
    assert [(m.side, m.body) for m in made.robot.payload_mounts] == [
        ("left", "left_palm")
    ]  # not a finger, and not twice


def test_an_unreadable_mesh_is_omitted_with_a_note(tmp_path):
    (tmp_path / "bad.stl").write_bytes(b"solid nothing of the kind" * 10)
    shape = '<visual><geometry><mesh filename="bad.stl"/></geometry></visual>'
    links = [
        LINK.format(name, 0.5, 0.01, shape)
        for name in ("left_arm", "left_palm", "left_hand_a", "left_hand_b")
    ]
    (tmp_path / "r.urdf").write_text(hand(*links))
    made = make(tmp_path, tmp_path / "r.urdf")
    assert any(note.startswith("mesh left out:") for note in made.notes)
    assert made.vendor.nmesh == 0


def test_the_folder_of_a_package_is_an_option(tmp_path):
    urdf = write_urdf(tmp_path / "a", URDF.replace("bar_description", "other"))
    assert (
        make(
            tmp_path / "b", urdf, kp=("50",), packages=(f"other={tmp_path}/a/bar_description",)
        ).vendor.nmesh
        == 1
    )


@pytest.mark.parametrize(
    ("wanted", "words"),
    [
        ({"joints": ("left_slide",)}, "is a slide joint, and gaponet supports angles only"),
        ({"joints": ("base",)}, "is a free joint"),
        ({"joints": ("*knee*",)}, "no such joint; there are: shoulder, elbow, roll, hip"),
        (
            {"kp": ("hip=1",)},
            "has no position gain for roll: give those of the controller that recorded",
        ),
        ({"kp": ("20", "hip=much")}, "--kp hip=much: give a number from 0"),
        ({"kd": ("toe=2",)}, "--kd toe=2: no such joint"),
        (
            {"kp": ("80", "120")},
            "--kp 80 120: give one value for all joints first, then shoulder=NUMBER",
        ),
        (
            {"kp": ("hip=80", "120")},
            "--kp hip=80 120: give one value for all joints first, then shoulder=NUMBER",
        ),
        ({"effort_limit": ("-3",)}, "--effort-limit -3"),
        ({"keyframe": "high"}, "vendor.xml has home, low"),
        ({"rate": 0.0}, "--rate 0.0"),
    ],
)
def test_options_that_do_not_fit_the_model_are_refused(tmp_path, wanted, words):
    with pytest.raises(UsageError) as error:
        make(tmp_path, **wanted)
    assert words in str(error.value)
    assert not (tmp_path / "out").exists()


def test_a_folder_that_holds_a_robot_is_left_alone(tmp_path):
    made = make(tmp_path)
    before = (made.robot.folder / "robot.toml").read_bytes()
    with pytest.raises(UsageError, match="robot"):
        make(tmp_path, kp=("5",))
    assert (made.robot.folder / "robot.toml").read_bytes() == before


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("arm.urdf.xacro", URDF, "expand"),
        ("arm.urdf", URDF.replace('<mass value="0.7"/>', ""), "arm.urdf"),
        ("arm.urdf", "<robot", "valid"),
        ("arm.urdf", URDF.replace('iyy="0.006"', 'iyy="1e308"'), "inertia"),
        (
            "arm.xml",
            MJCF.replace('"hinge"', "")
            .replace('type="slide"', 'type="ball"')
            .replace("range", "user"),
            "arm.xml",
        ),
    ],
)
def test_broken_models_are_refused_with_their_file(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    with pytest.raises(RobotError, match=words):
        make(tmp_path, tmp_path / name)
    with pytest.raises(RobotError, match="folder"):
        make(tmp_path, tmp_path)


def test_a_named_servo_type_fills_damping_friction_armature_and_torque_limit(tmp_path):
    made = make(
        tmp_path, joints=ARM, servo=("STS3215", "roll=XL330-M288-T"), effort_limit=("elbow=1",)
    )
    for joint, name in (("shoulder", "STS3215"), ("elbow", "STS3215"), ("roll", "XL330-M288-T")):
        servo = servo_type(name, "")
        spec = read_mjcf(made.robot.mjcf).joint(joint)
        for field in ("damping", "frictionloss", "armature"):
            assert np.ravel(getattr(spec, field))[0] == pytest.approx(servo.measured[field].value)
        assert written(made)[joint]["servo"] == name
        assert written(made)[joint]["effort_limit"] == (
            1.0 if joint == "elbow" else servo.effort_limit
        )
    assert made.drives[0].passive_source.startswith(
        "servo STS3215 (armature, damping, frictionloss: isaac-sim2real"
    )
    with pytest.raises(RobotError, match="STS3215"):
        make(tmp_path / "other", servo=("STS3216",))


MIMIC = """<robot name="hand"><link name="base"><inertial><mass value="1"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
{joints}</robot>"""
FINGER = """<link name="{name}_link"><inertial><origin xyz="0.05 0 0"/><mass value="0.05"/>
<inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="{name}" type="revolute"><parent link="base"/><child link="{name}_link"/>
<axis xyz="0 0 1"/>
<limit lower="-1.5" upper="1.5" effort="5" velocity="2"/>{mimic}</joint>"""


@pytest.mark.parametrize(("ratio", "at_zero"), [(1.0, 0.0), (-0.5, 0.2)])
def test_a_mimic_joint_follows_without_a_motor(tmp_path, ratio, at_zero):
    mimic = f'<mimic joint="drive" multiplier="{ratio}" offset="{at_zero}"/>'
    joints = FINGER.format(name="drive", mimic="") + FINGER.format(name="led", mimic=mimic)
    (tmp_path / "hand.urdf").write_text(MIMIC.format(joints=joints))
    robot = make(tmp_path, tmp_path / "hand.urdf").robot
    assert robot.operated == ("drive",)
    led = robot.index(["led"])[0]
    drive = robot.index(["drive"])[0]
    assert robot.servo.kp[led] == 0
    model = build_model(robot)
    data = mujoco.MjData(model)
    data.ctrl[drive] = 0.6
    mujoco.mj_step(model, data, 2000)
    assert data.qpos[led] == pytest.approx(ratio * data.qpos[drive] + at_zero, abs=5e-3)
    time = 0.02 * np.arange(50)
    angle = np.sin(time)[:, None]
    channels = {"ctrl": Channel(time, angle + 0.1), "qpos": Channel(time, angle)}
    log = Log(robot.name, ("drive",), channels, "m.csv")
    sequence = to_sequence(log, robot, SequenceMeta(robot.name, "u", "m", 0.0))
    assert np.allclose(sequence.qpos[:, led], ratio * angle[:, 0] + at_zero, atol=1e-6)


def test_a_mimic_joint_of_a_joint_that_does_not_exist_has_a_motor(tmp_path):
    joints = FINGER.format(name="drive", mimic="") + FINGER.format(
        name="led", mimic='<mimic joint="elsewhere"/>'
    )
    (tmp_path / "hand.urdf").write_text(MIMIC.format(joints=joints))

    robot = make(tmp_path, tmp_path / "hand.urdf").robot

    assert robot.operated == ("drive", "led")


def test_a_mimic_joint_of_a_mimic_joint_follows_the_motor(tmp_path):
    first = '<mimic joint="drive" multiplier="-0.5" offset="0.2"/>'
    second = '<mimic joint="led" multiplier="2" offset="0.1"/>'
    joints = "".join(
        FINGER.format(name=name, mimic=mimic)
        for name, mimic in (("drive", ""), ("led", first), ("tip", second))
    )
    (tmp_path / "hand.urdf").write_text(MIMIC.format(joints=joints))
    robot = make(tmp_path, tmp_path / "hand.urdf").robot
    assert robot.operated == ("drive",)
    assert robot.log_joints.followers["tip"] == ("drive", -1.0, pytest.approx(0.5))


LINK_OF_LOOP = """<body name="{crank}" pos="{at} 0 0"><joint name="{motor}" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 .2" size=".01" mass=".2"/>
<body name="{rod}" pos="0 0 .2"><joint name="{hinge}" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 {reach} 0 .2" size=".01" mass=".1"/></body></body>"""


def five_bar(equality: str) -> str:
    """An MJCF: two cranks with motors, each with a rod on a passive hinge, and an equality."""
    left = LINK_OF_LOOP.format(
        crank="crankA", motor="motorA", rod="rodA", hinge="passiveA", at=-0.1, reach=0.1
    )
    right = LINK_OF_LOOP.format(
        crank="crankB", motor="motorB", rod="rodB", hinge="passiveB", at=0.1, reach=-0.1
    )
    return (
        f"<mujoco><worldbody>{left}{right}<body name='target' mocap='true'/></worldbody>"
        f"<equality>{equality}</equality><actuator><position joint='motorA' kp='20'/>"
        "<position joint='motorB' kp='20'/></actuator></mujoco>"
    )


CONNECTED = '<connect body1="rodA" body2="rodB" anchor=".1 0 .2"/>'


def test_a_closed_loop_through_a_passive_hinge_is_refused(tmp_path):
    (tmp_path / "loop.xml").write_text(five_bar(CONNECTED))
    with pytest.raises(RobotError, match="closed loop through passiveA, passiveB"):
        make(tmp_path, tmp_path / "loop.xml")


@pytest.mark.parametrize(
    "equality",
    [
        CONNECTED.replace("/>", ' active="false"/>'),
        '<weld body1="crankA" body2="rodA"/>',  # one frozen body with another
    ],
)
def test_an_equality_that_locks_no_logged_joint_is_accepted(tmp_path, equality):
    (tmp_path / "open.xml").write_text(five_bar(equality))
    robot = make(tmp_path, tmp_path / "open.xml").robot
    assert robot.joint_names == ("motorA", "motorB")


def test_a_closed_loop_of_logged_joints_alone_is_kept(tmp_path):
    (tmp_path / "loop.xml").write_text(five_bar(CONNECTED))
    names = ("motorA", "passiveA", "motorB", "passiveB")
    robot = make(tmp_path, tmp_path / "loop.xml", joints=names).robot
    assert build_model(robot).neq == 1


def test_a_weld_to_a_mocap_body_is_left_out_with_a_note(tmp_path):
    (tmp_path / "teleoperated.xml").write_text(five_bar('<weld body1="target" body2="crankA"/>'))
    made = make(tmp_path, tmp_path / "teleoperated.xml")
    assert build_model(made.robot).neq == 0
    assert any("crankA to the mocap body target" in note for note in made.notes)


def write_attached(folder: Path, mesh: bool = True) -> Path:
    """An arm that attaches a hand, which has a mesh of 0.4 kg in a folder of its own."""
    (folder / "hand" / "shapes").mkdir(parents=True)
    if mesh:
        (folder / "hand" / "shapes" / "link.obj").write_text(BOX)
    (folder / "hand" / "hand.xml").write_text(
        '<mujoco model="hand"><compiler meshdir="shapes"/>'
        '<asset><mesh name="palm" file="link.obj"/></asset><worldbody><body name="palm">'
        '<geom type="sphere" size=".01" mass=".02"/><geom type="mesh" mesh="palm" mass=".4"/>'
        "</body></worldbody></mujoco>"
    )
    (folder / "arm.xml").write_text(
        '<mujoco><asset><model name="hand" file="hand/hand.xml"/></asset><worldbody>'
        '<body name="upper"><joint name="shoulder" axis="0 1 0"/>'
        '<geom type="sphere" size=".02" mass=".6"/>'
        '<frame><attach model="hand" body="palm" prefix="h_"/></frame></body></worldbody></mujoco>'
    )
    return folder / "arm.xml"


def test_the_meshes_of_an_attached_model_are_found_in_its_own_folder(tmp_path):
    made = make(tmp_path, write_attached(tmp_path / "repo"))
    assert build_model(made.robot).body_mass.sum() == pytest.approx(0.6 + 0.42)


def test_the_mass_that_goes_with_a_missing_mesh_is_told(tmp_path):
    made = make(tmp_path, write_attached(tmp_path / "repo", mesh=False))
    assert any("bodies are lighter: h_palm by 0.4 kg" in note for note in made.notes)


def test_a_missing_mesh_beside_an_attached_model_leaves_the_others(tmp_path):
    model = write_attached(tmp_path / "repo")
    lost = '<asset><mesh name="lost" file="lost.obj"/>'
    text = model.read_text().replace("<asset>", lost)
    model.write_text(text.replace("<frame>", '<geom type="mesh" mesh="lost"/><frame>'))
    made = make(tmp_path, model)
    assert made.vendor.body("h_palm").mass[0] == pytest.approx(0.42)
    assert any("bodies are lighter: upper by an unknown mass" in note for note in made.notes)


def test_a_body_without_an_inertia_has_the_mass_of_its_mesh(tmp_path):
    (tmp_path / "link.obj").write_text(BOX)  # 0.25 m by 0.06 m by 0.06 m
    (tmp_path / "arm.xml").write_text(
        '<mujoco><asset><mesh name="link" file="link.obj"/></asset><worldbody><body name="upper">'
        '<joint name="shoulder"/><geom type="mesh" mesh="link"/></body></worldbody></mujoco>'
    )
    made = make(tmp_path, tmp_path / "arm.xml")
    volume = 0.25 * 0.06 * 0.06  # m³; 1000 kg/m³ is MuJoCo's density
    assert made.vendor.body("upper").mass[0] == pytest.approx(1000 * volume)


def test_a_mesh_with_a_wrong_face_has_the_mass_of_its_convex_hull(tmp_path):
    with_a_face_inside_out = BOX.replace("f 2 8 4", "f 2 4 8")
    (tmp_path / "link.obj").write_text(with_a_face_inside_out)
    (tmp_path / "arm.xml").write_text(
        '<mujoco><asset><mesh name="link" file="link.obj" inertia="exact"/></asset><worldbody>'
        '<body name="upper"><joint name="shoulder"/><geom type="mesh" mesh="link"/></body>'
        "</worldbody></mujoco>"
    )
    made = make(tmp_path, tmp_path / "arm.xml")
    volume = 0.25 * 0.06 * 0.06  # m³
    assert made.vendor.body("upper").mass[0] == pytest.approx(1000 * volume)
    assert any("mesh link has no volume" in note for note in made.notes)


def test_the_base_is_frozen_where_the_keyframe_has_it(tmp_path):
    upside_down = MJCF.replace('qpos="0 0 1 1 0 0 0  0 0.5', 'qpos="0 0 1 0 1 0 0  0 0.5')
    model = write_mjcf(tmp_path / "repo", upside_down)
    made = make(tmp_path, model, joints=ARM, keyframe="low")
    assert max(furthest(made)) < 1e-9


def test_a_base_in_a_frame_is_frozen_where_the_keyframe_has_it(tmp_path):
    framed = MJCF.replace('<body name="torso"', '<frame euler="0 90 0"><body name="torso"')
    framed = framed.replace("  </worldbody>", "  </frame></worldbody>")
    made = make(tmp_path, write_mjcf(tmp_path / "repo", framed), joints=ARM)
    assert max(furthest(made)) < 1e-9


def test_a_ball_joint_is_frozen_where_the_keyframe_has_it(tmp_path):
    (tmp_path / "ball.xml").write_text(
        '<mujoco><worldbody><body name="torso"><joint type="ball" pos=".1 0 .2" limited="true" '
        'range="0 1"/><geom type="sphere" size=".05" mass="1"/><body name="upper" pos="0 .1 0" '
        'euler="10 20 30"><joint name="shoulder" axis="0 1 0"/>'
        '<geom type="capsule" fromto="0 0 0 .2 0 .1" size=".02" mass=".5"/></body></body>'
        '</worldbody><keyframe><key qpos=".8 .36 .48 0  .3"/></keyframe></mujoco>'
    )
    made = make(tmp_path, tmp_path / "ball.xml")
    torso = build_model(made.robot).body("torso")
    data = mujoco.MjData(made.vendor)
    data.qpos[:] = made.pose
    mujoco.mj_kinematics(made.vendor, data)
    assert max(furthest(made)) < 1e-9
    np.testing.assert_allclose(torso.pos, data.body("torso").xpos, atol=1e-9)


def test_two_free_bodies_are_frozen_each_at_its_own_place(tmp_path):
    (tmp_path / "two.xml").write_text(
        '<mujoco><worldbody><body name="torso"><freejoint/><geom size=".1"/>'
        '<body><joint name="shoulder" axis="0 1 0"/><geom size=".1"/></body></body>'
        '<body name="cube"><freejoint/><geom size=".1"/></body></worldbody>'
        '<keyframe><key qpos="0 0 1 1 0 0 0  .3  2 3 4 1 0 0 0"/></keyframe></mujoco>'
    )
    model = build_model(make(tmp_path, tmp_path / "two.xml").robot)
    np.testing.assert_allclose(model.body("torso").pos, [0, 0, 1])
    np.testing.assert_allclose(model.body("cube").pos, [2, 3, 4])


PAIR = """<mujoco><worldbody>
<body><joint name="left" axis="0 1 0"/><geom type="sphere" size=".05" pos=".1 0 0"/></body>
<body><joint name="right" axis="0 1 0"/><geom type="sphere" size=".05" pos=".1 0 0"/></body>
</worldbody><equality><joint joint1="right" joint2="left" polycoef="0 1 0 0 0" {active}/></equality>
<actuator>{actuators}</actuator></mujoco>"""
LEFT_MOTOR = '<position joint="left" kp="30"/>'
RIGHT_MOTOR = '<position joint="right" kp="30"/>'


@pytest.mark.parametrize("active", ['active="false"', 'active="true"'])
def test_a_coupled_joint_with_an_actuator_keeps_its_motor(tmp_path, active):
    text = PAIR.format(active=active, actuators=LEFT_MOTOR + RIGHT_MOTOR)
    (tmp_path / "pair.xml").write_text(text)
    assert make(tmp_path, tmp_path / "pair.xml").robot.operated == ("left", "right")


def test_an_equality_that_is_not_active_couples_nothing(tmp_path):
    (tmp_path / "pair.xml").write_text(PAIR.format(active='active="false"', actuators=LEFT_MOTOR))
    made = make(tmp_path, tmp_path / "pair.xml")
    assert made.robot.joint_names == ("left",)
    assert not any("moves with" in note for note in made.notes)


FINGERS = """<body name="{palm}" pos=".2 0 0"><geom type="box" size=".02 .03 .02" mass=".1"/>
<body name="gripper_left_finger" pos="0 .03 0"><joint name="{palm}_left" axis="0 0 1"/>
<geom type="box" size=".03 .005 .01" mass=".03"/></body>
<body name="gripper_right_finger" pos="0 -.03 0"><joint name="{palm}_right" axis="0 0 1"/>
<geom type="box" size=".03 .005 .01" mass=".03"/></body></body>"""
UPPER = """<body name="{name}"><joint name="{name}" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" mass=".6"/>{content}</body>"""


def mounts_of(folder: Path, bodies: str) -> list[tuple[str, str]]:
    """Side and body of each payload mount that is guessed for an MJCF of these bodies."""
    (folder / "hand.xml").write_text(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    mounts = make(folder, folder / "hand.xml").robot.payload_mounts
    return [(mount.side, mount.body) for mount in mounts]


@pytest.mark.parametrize("palm", ["gripper_base", "link6"])
def test_two_fingers_of_one_palm_are_one_payload_mount(tmp_path, palm):
    arm = UPPER.format(name="upper", content=FINGERS.format(palm=palm))
    assert mounts_of(tmp_path, arm) == [("hand", palm)]


def test_the_arms_of_a_torso_that_turns_are_two_payload_mounts(tmp_path):
    arms = ""
    for side in ("left", "right"):
        hand = UPPER.format(name=f"{side}_wrist", content="")
        arms += UPPER.format(name=f"{side}_shoulder", content=hand)
    torso = UPPER.format(name="torso", content=arms)
    assert mounts_of(tmp_path, torso) == [("left", "left_wrist"), ("right", "right_wrist")]


def test_the_side_of_a_payload_is_that_of_the_palm(tmp_path):
    arms = ""
    for side in ("left", "right"):
        fingers = FINGERS.format(palm=f"{side}_palm").replace("gripper_", f"{side[0]}_gripper_")
        hand = UPPER.format(name=f"{side}_wrist", content=fingers)
        arms += UPPER.format(name=f"{side}_shoulder", content=hand)
    torso = UPPER.format(name="torso", content=arms)
    assert mounts_of(tmp_path, torso) == [("left", "left_palm"), ("right", "right_palm")]


def test_a_motor_that_pulls_one_way_has_the_limit_of_that_way(tmp_path):
    one_way = MJCF.replace('forcerange="-9 9"', 'forcerange="0 9"')
    made = make(tmp_path, write_mjcf(tmp_path / "repo", one_way), joints=ARM)
    assert written(made)["shoulder"]["effort_limit"] == 9.0
