"""The nominal simulator: joints that hold still, payloads that weigh, robots a user brings
along.
"""

import re
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from arm import TOML, XML, commands, record, write_arm, write_dataset
from files_arm import COMMON, write_files_arm
from files_arm import XML as FILES_XML

from gaponet.base.errors import RobotError, UsageError
from gaponet.robot.fingerprint import model_fingerprint
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import RobotSpec, Scene, Table, load_robot
from gaponet.sim.batch import BatchSim
from gaponet.sim.dataset_robot import dataset_robot
from gaponet.sim.dynamics import inverse_dynamics
from gaponet.sim.model import build_model, idle_joints, model_hash, write_table


def hold(model: mujoco.MjModel, ctrl: np.ndarray, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions 10 s after a start at the targets, when the swing has died away, and `seconds`
    later, (n,) rad.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = data.ctrl[:] = ctrl
    mujoco.mj_step(model, data, round(10 / model.opt.timestep))
    early = data.qpos.copy()
    mujoco.mj_step(model, data, round(seconds / model.opt.timestep))
    return early, data.qpos.copy()


def raised(robot: RobotSpec) -> np.ndarray:
    """Home and 0.3 rad, but no joint at its stop, (n,) rad."""
    low, high = robot.qpos_range.T
    return np.clip(robot.qpos_home + 0.3, low + 0.05, high - 0.05)


def test_a_robot_can_be_built_with_all_joints_locked():
    robot = load_robot("so101")
    assert build_model(robot, locked=robot.joint_names).nq == 0


@pytest.mark.parametrize(("name", "mass"), [("so101", 0.0), ("so101", 0.3), ("h1_2", 3.0)])
def test_a_loaded_joint_held_for_a_minute_does_not_creep(name, mass):
    robot = load_robot(name)
    posture = raised(robot)
    early, late = hold(build_model(robot, mass), posture, 60.0)
    assert np.abs(late - early).max() < 0.5e-3
    assert np.abs(early - posture).max() > 2e-3  # and it does carry a load


@pytest.mark.parametrize(
    ("name", "armature"), [("so101", 0.0028), ("h1_2", 0.0028), ("h1_2", None)]
)
def test_friction_holds_half_its_limit_for_two_minutes_with_the_smallest_armature(name, armature):
    robot = load_robot(name)
    if armature is not None:
        robot = robot.with_identified(
            {joint: {"armature": armature} for joint in robot.joint_names}
        )
    model = build_model(robot)
    model.actuator_gainprm[:] = model.actuator_biasprm[:] = 0.0
    data = mujoco.MjData(model)
    data.qpos[:] = raised(robot)
    mujoco.mj_forward(model, data)
    load = data.qfrc_bias.copy()
    model.dof_frictionloss[:] = 2 * np.abs(load) + 0.02
    data.qfrc_applied[:] = -0.01 * np.sign(load)  # beside gravity: half of the limit
    mujoco.mj_step(model, data, round(1 / model.opt.timestep))
    early = data.qpos.copy()
    # A sixth of the time, a sixth of the way.
    mujoco.mj_step(model, data, round(20 / model.opt.timestep))
    assert np.abs(data.qpos - early).max() < 0.6e-3 / 6


def test_a_payload_in_one_hand_leaves_the_other_arm_alone():
    robot = load_robot("h1_2")
    torque = {}
    for side in ("left", "right", "both"):
        data = mujoco.MjData(build_model(robot, 3.0, side))
        mujoco.mj_forward(data.model, data)
        torque[side] = data.qfrc_bias.copy()
    right = robot.index(["right_shoulder_pitch_joint", "right_elbow_joint"])
    left = robot.index(["left_shoulder_pitch_joint", "left_elbow_joint"])
    assert torque["left"][left] == pytest.approx(torque["both"][left])
    assert torque["right"][right] == pytest.approx(torque["both"][right])
    assert np.abs(torque["left"][right] - torque["both"][right]).max() > 1.0


def test_an_actuator_pulls_with_kp_times_error_up_to_the_torque_limit(arm):
    data = mujoco.MjData(build_model(arm))
    data.ctrl[:] = [0.1, 1.0]
    mujoco.mj_forward(data.model, data)
    assert data.actuator_force == pytest.approx([2.0, 5.0])  # 20 · 0.1; 20 · 1.0 limited to 5


def test_the_physics_step_is_nearly_the_same_at_any_rate(arm):
    assert build_model(arm).opt.timestep == pytest.approx(0.005)
    assert build_model(arm, dt=0.02006).opt.timestep == pytest.approx(0.005015)
    assert build_model(arm, dt=0.01).opt.timestep == pytest.approx(0.005)
    assert build_model(arm, dt=0.002).opt.timestep == pytest.approx(0.002)


def test_a_timestep_that_does_not_divide_the_control_period_is_refused(tmp_path):
    with pytest.raises(RobotError, match="timestep"):
        write_arm(tmp_path / "arm", toml=TOML.replace("timestep = 0.005", "timestep = 0.007"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"payload_mass": -1.0}, "payload_mass"),
        ({"payload_mass": float("nan")}, "nan"),
        ({"payload_side": "foot"}, "'foot'"),
        ({"dt": 50.0}, "dt"),
        ({"dt": 0.0}, "dt"),
    ],
)
def test_invalid_payload_side_and_period_are_refused(arm, options, message):
    with pytest.raises(UsageError, match=message):
        build_model(arm, **options)


@pytest.mark.parametrize(
    ("toml", "xml", "message"),
    [
        (TOML, "<mujoco>", "MJCF"),
        (TOML.replace('"elbow"', '"knee"'), XML, "'knee'"),
        (TOML.replace('"fore"', '"hand"'), XML, "body 'hand'"),
        ("[[joint]]".join(TOML.split("[[joint]]")[:2]), XML, "freedom"),
        (
            TOML.replace("shoulder", "x").replace("elbow", "shoulder").replace('"x"', '"elbow"'),
            XML,
            "order",
        ),
        (TOML, XML.replace('mass="0.3"', 'mass="-1"'), "compile|MJCF"),
    ],
)
def test_a_broken_robot_folder_says_what_is_wrong(tmp_path, toml, xml, message):
    robot = write_arm(tmp_path / "arm", toml=toml, xml=xml)
    with pytest.raises(RobotError, match=message):
        build_model(robot)


def test_a_robot_without_a_mount_carries_nothing(tmp_path):
    robot = write_arm(tmp_path / "arm", toml=TOML.split("[[payload_mount]]")[0])
    assert build_model(robot).nv == 2
    with pytest.raises(
        RobotError,
        match="payload_mount",
    ):
        build_model(robot, 1.0)


def test_actuators_of_the_mjcf_are_replaced(tmp_path):
    motors = '<actuator><motor joint="elbow"/><motor joint="elbow" gear="9"/></actuator></mujoco>'
    model = build_model(write_arm(tmp_path / "arm", xml=XML.replace("</mujoco>", motors)))
    assert [model.actuator(i).name for i in range(model.nu)] == ["shoulder", "elbow"]


def test_a_payload_that_the_compiler_would_not_weigh_is_refused(tmp_path):
    xml = XML.replace("<compiler ", '<compiler settotalmass="2.5" ')
    robot = write_arm(tmp_path / "arm", xml=xml)
    with pytest.raises(RobotError, match="settotalmass"):
        build_model(robot, 0.2)


@pytest.mark.parametrize("setting", ['boundmass="0.001"', 'fusestatic="true"'])
def test_a_payload_weighs_whatever_the_compiler_does_with_light_or_fixed_bodies(tmp_path, setting):
    robot = write_arm(tmp_path / "arm", xml=XML.replace("<compiler ", f"<compiler {setting} "))
    assert build_model(robot).body("payload_hand").mass[0] <= 1e-3
    assert build_model(robot, 0.2).body("payload_hand").mass[0] == pytest.approx(0.2)


SECOND_LIMB = """<body name="second" pos="0 1 0"><joint name="wrist" axis="0 1 0"/>
  <geom size="0.1" mass="0.3" contype="0" conaffinity="0"/></body></worldbody>"""


@pytest.mark.parametrize(
    ("coupling", "idle"),
    [
        ("", ("wrist",)),
        ('<equality><joint joint1="wrist" joint2="shoulder"/></equality>', ()),
        ('<equality><weld body1="second" body2="fore"/></equality>', ()),
        ('<equality><weld body1="second"/></equality>', ("wrist",)),
        (
            '<tendon><fixed name="t"><joint joint="shoulder" coef="1"/>'
            '<joint joint="wrist" coef="1"/></fixed></tendon>',
            (),
        ),
    ],
)
def test_a_limb_that_is_coupled_to_one_that_moves_is_not_idle(tmp_path, coupling, idle):
    toml = TOML.replace(
        "[[payload_mount]]",
        '[[joint]]\nname = "wrist"\nkp = 20.0\neffort_limit = 5.0\n[[payload_mount]]',
    )
    robot = write_arm(tmp_path / "arm", toml, XML.replace("</worldbody>", SECOND_LIMB + coupling))
    assert idle_joints(robot, ("shoulder", "elbow")) == idle


def test_a_joint_is_locked_with_what_refers_to_it(tmp_path):
    more = """
      <equality><joint joint1="elbow" joint2="shoulder"/></equality>
      <tendon><fixed name="both"><joint joint="elbow" coef="1"/></fixed></tendon>
      <sensor><jointpos joint="elbow"/><tendonpos tendon="both"/></sensor>
      <keyframe><key name="home" qpos="0 0.1"/></keyframe></mujoco>"""
    robot = write_arm(tmp_path / "arm", xml=XML.replace("</mujoco>", more))
    assert build_model(robot, locked=("elbow",)).nq == 1
    assert build_model(robot).neq == 1


def test_a_joint_is_locked_with_equalities_of_its_tendons_and_no_others(tmp_path):
    more = """
      <tendon><fixed name="moved"><joint joint="shoulder" coef="1"/></fixed>
        <fixed name="locked"><joint joint="elbow" coef="1"/></fixed></tendon>
      <equality><tendon tendon1="moved" tendon2="locked"/>
        <weld body1="elbow" body2="upper" active="false"/></equality></mujoco>"""
    xml = XML.replace("</mujoco>", more).replace('<body name="fore"', '<body name="elbow"')
    toml = TOML.replace('body = "fore"', 'body = "elbow"')
    robot = write_arm(tmp_path / "arm", toml, xml)
    assert build_model(robot).neq == 2
    model = build_model(robot, locked=("elbow",))
    assert [mujoco.mjtEq(kind) for kind in model.eq_type] == [mujoco.mjtEq.mjEQ_WELD]
    assert model.ntendon == 1


HOME = TOML.replace('name = "elbow"', 'name = "elbow"\nhome = 0.7')
ELBOW = '<joint name="elbow" axis="0 1 0" range="-1.5 1.5"/>'


def hand(robot: RobotSpec, locked: tuple[str, ...] = ()) -> np.ndarray:
    """Place of the hand at home, (3,) m."""
    model = build_model(robot, locked=locked)
    data = mujoco.MjData(model)
    data.qpos[:] = robot.qpos_home[: model.nq]
    mujoco.mj_kinematics(model, data)
    return data.body("payload_hand").xpos.copy()


@pytest.mark.parametrize("frame", ['euler="0 0 0.5"', 'pos="0.05 0 0"'])
def test_a_joint_in_a_frame_of_its_body_is_locked_where_it_is(tmp_path, frame):
    xml = XML.replace(ELBOW, f"<frame {frame}>{ELBOW}</frame>")
    robot = write_arm(tmp_path / "arm", HOME, xml)
    np.testing.assert_allclose(hand(robot, ("elbow",)), hand(robot), atol=1e-9)


def test_an_attached_model_has_units_of_its_own(tmp_path):
    """The child is in degrees, the parent in radians."""
    child = XML.replace('angle="radian" ', "").replace('range="-1.5 1.5"', 'range="-86 86"')
    turned = child.replace('<body name="fore"', '<body name="fore" euler="10 20 30"')
    main = """<mujoco><compiler angle="radian"/><asset><model name="c" file="child.xml"/></asset>
      <worldbody><body name="stand"><attach model="c" body="upper" prefix="my_"/></body></worldbody>
    </mujoco>"""
    toml = HOME
    for name in ("shoulder", "elbow", "fore"):
        toml = toml.replace(f'"{name}"', f'"my_{name}"')
    (tmp_path / "arm").mkdir()
    (tmp_path / "arm" / "child.xml").write_text(turned)
    robot = write_arm(tmp_path / "arm", toml, main)
    np.testing.assert_allclose(hand(robot, ("my_elbow",)), hand(robot), atol=1e-9)
    stops = robot.with_servo(zero=np.array([0.1, 0.1]), stop_high=np.array([1.0, np.nan]))
    model = build_model(stops)
    np.testing.assert_allclose(model.qpos0, [-0.1, -0.1])
    np.testing.assert_allclose(model.jnt_range[0, 1], 1.0)


@pytest.mark.parametrize("turned", ['euler="0.3 0.2 0.1"', 'axisangle="0 0.6 0.8 0.4"'])
def test_a_joint_is_locked_in_a_body_that_is_turned_in_any_form(tmp_path, turned):
    home = TOML.replace('name = "elbow"', 'name = "elbow"\nhome = 0.7')
    xml = XML.replace('<body name="fore"', f'<body name="fore" {turned}')
    models = []
    for name, text in (("turned", xml), ("quaternion", None)):
        if text is None:
            (w, x, y, z) = models[0].body("fore").quat
            text = XML.replace('<body name="fore"', f'<body name="fore" quat="{w} {x} {y} {z}"')
        robot = write_arm(tmp_path / name, home, text)
        models += [build_model(robot), build_model(robot, locked=("elbow",))]
    assert np.ptp(models[1].body("fore").quat - models[0].body("fore").quat) > 0.1
    np.testing.assert_allclose(models[1].body("fore").quat, models[3].body("fore").quat, atol=1e-9)
    np.testing.assert_allclose(models[1].body("fore").pos, models[3].body("fore").pos, atol=1e-9)


def vendor_hash(folder, **change):
    return model_hash(write_files_arm(folder, **change))


@pytest.mark.parametrize(
    "change",
    [
        {"common": COMMON.replace('damping="0.51', 'damping="5.1')},  # in an included file
        {"common": COMMON.replace("0.02", "0.020001")},
        {"toml": TOML.replace("pos = [0.2, 0.0, 0.0]", "pos = [2.9, 0.0, 0.0]")},  # of the mount
        {"toml": TOML.replace('body = "fore"', 'body = "tool"')},
        {"toml": TOML.replace("kp = 20.0", "kp = 20.001", 1)},
        {"toml": TOML.replace("effort_limit = 5.0", "effort_limit = 5.5", 1)},
        {"toml": TOML.replace("timestep = 0.005", "timestep = 0.004")},
        {"scale": 1.01},  # of the mesh that gives the inertia
        {"xml": FILES_XML.replace('density="1500"', 'density="1510"')},
        {"xml": FILES_XML.replace("-9.80665", "-9.81")},
        {"xml": FILES_XML.replace("implicitfast", "Euler")},
        {"xml": FILES_XML.replace('springref="4"', 'springref="5"')},
        {"xml": FILES_XML.replace('range="-80 80"', 'range="-80 70"')},
        {
            "xml": FILES_XML.replace(
                '<body name="fore" pos="0.2 0 0">', '<body name="fore" pos="0.20001 0 0">'
            )
        },
        {"contacts": True},
    ],
)
def test_the_hash_changes_with_anything_that_changes_the_motion(tmp_path, change):
    assert vendor_hash(tmp_path / "changed", **change) != vendor_hash(tmp_path / "arm")


@pytest.mark.parametrize(
    "xml",
    [
        FILES_XML.replace("<light", "<!-- a word --><light"),
        FILES_XML.replace(
            '<geom class="look"/>', '<geom class="look" pos="1 2 3"/><site name="s"/>'
        ),
        FILES_XML.replace('<geom class="look"/>', '<body name="cover"><geom class="look"/></body>'),
        FILES_XML.replace('rgba="0.5', 'rgba="0.1'),
        FILES_XML.replace('<light pos="0 0 1"/>', '<camera name="c"/>'),
        FILES_XML.replace("<sensor>", "<sensor><jointvel joint='elbow'/>"),
        FILES_XML.replace(
            'pos="0 0 0.21234567" euler="0 20 30"', 'euler="0 20 30" pos="0 0 0.21234567"'
        ),
        FILES_XML.replace('quat="1 0.1 0.2 0.3"', 'quat="-2 -0.2 -0.4 -0.6"'),
        FILES_XML.replace('name="tool"', 'name="gripper"'),
    ],
)
def test_the_hash_ignores_looks_and_names(tmp_path, xml):
    assert xml != FILES_XML
    assert vendor_hash(tmp_path / "arm", xml=xml) == vendor_hash(
        tmp_path / "elsewhere" / "with a space"
    )


def test_geoms_that_touch_count_where_contacts_are_on_and_only_there(tmp_path):
    wider = FILES_XML.replace('size="0.02" mass', 'size="0.021" mass')
    for contacts in (False, True):
        thin = write_files_arm(tmp_path / f"thin {contacts}", contacts=contacts, xml=FILES_XML)
        wide = write_files_arm(tmp_path / f"wide {contacts}", contacts=contacts, xml=wider)
        one = build_model(thin)
        other = build_model(wide)
        # The capsule's mass is given; its inertia follows from its size.
        other.body_inertia[:] = one.body_inertia
        other.body_ipos[:] = one.body_ipos
        other.body_iquat[:] = one.body_iquat
        same = list(model_fingerprint(one)) == list(model_fingerprint(other))
        assert same is not contacts


def test_a_model_in_degrees_moves_as_the_same_one_in_radians(tmp_path):

    def degrees(match):
        low, high = np.degrees([float(word) for word in match[1].split()])
        return f'range="{low:.12g} {high:.12g}"'

    xml = re.sub(r'range="([^"]*)"', degrees, XML.replace('angle="radian"', 'angle="degree"'))
    assert xml != XML
    models = []
    for name, text in (("radians", XML), ("degrees", xml)):
        robot = write_arm(tmp_path / name, TOML, text)
        stops = {"stop_low": -0.3, "stop_high": 0.4}
        known = robot.with_identified({"shoulder": {"zero": 0.1} | stops, "elbow": {"zero": -0.2}})
        models += [build_model(known), build_model(known, locked=("elbow",))]
    for ours, theirs in zip(models[:2], models[2:], strict=True):
        for field in ("jnt_range", "qpos0", "body_quat", "body_pos"):
            np.testing.assert_allclose(getattr(ours, field), getattr(theirs, field), atol=1e-9)


def pinocchio_model(pin, robot, payload):
    """Pinocchio's model of the same MJCF, with the payload as an extra body and no armature."""
    other = pin.buildModelFromMJCF(str(robot.mjcf))
    other.armature[:] = 0.0  # versions differ in whether rnea counts it
    for mount in robot.payload_mounts:
        frame = other.frames[other.getFrameId(mount.body)]
        place = frame.placement * pin.SE3(np.eye(3), np.array(mount.pos))
        radius = max((3 * payload / (4 * np.pi * 7850.0)) ** (1 / 3), 1e-3)  # a solid steel ball
        ball = pin.Inertia.FromSphere(payload, radius)
        other.appendBodyToJoint(frame.parentJoint, ball, place)
    return other


@pytest.mark.parametrize("payload", [0.0, 3.0])
def test_h1_2_agrees_with_pinocchio(payload):
    """An independent rigid-body library reads the same MJCF and gets the payload as an extra
    body.
    """
    pin = pytest.importorskip("pinocchio", reason="pinocchio (package pin) is not installed")
    robot = load_robot("h1_2")
    other = pinocchio_model(pin, robot, payload)
    order = [other.joints[other.getJointId(name)].idx_v for name in robot.joint_names]
    rng = np.random.default_rng(0)
    model = build_model(robot, payload)
    low, high = robot.qpos_range.T
    qpos = rng.uniform(low, high, (50, 27))
    qvel = rng.normal(size=(50, 27))
    qacc = 5 * rng.normal(size=(50, 27))
    ours = inverse_dynamics(model, qpos, qvel, qacc)
    theirs = np.empty_like(ours)
    data = other.createData()
    for t in range(50):
        q = np.zeros(27)
        v = np.zeros(27)
        a = np.zeros(27)
        q[order] = qpos[t]
        v[order] = qvel[t]
        a[order] = qacc[t]
        theirs[t] = pin.rnea(other, data, q, v, a)[order]
    theirs += model.dof_armature * qacc + model.dof_damping * qvel
    assert np.abs(ours - theirs).max() < 1e-6 * np.abs(ours).max()


TIP = '[[tip]]\nbody = "fore"\npos = [0.2, 0.0, 0.0]\n'


@pytest.fixture
def tipped(tmp_path):
    return write_arm(tmp_path / "arm", toml=TOML + TIP)


def test_nothing_touches_without_a_table(tipped):
    assert build_model(tipped).npair == 0
    bare = build_model(replace(tipped, scene=Scene()))
    assert build_model(tipped).opt.disableflags == bare.opt.disableflags


def test_the_tip_presses_into_the_table_by_force_over_stiffness(tipped):
    model = build_model(tipped.with_table(Table(-0.05, 0.3, 3000.0)), physics_only=True)
    model.dof_frictionloss[:] = 0.0
    data = mujoco.MjData(model)
    data.ctrl[:] = [0.3, 0.3]  # far below the table
    mujoco.mj_step(model, data, 2000)
    force = np.zeros(6)
    mujoco.mj_contactForce(model, data, 0, force)
    depth = -0.05 - (
        data.body("fore").xpos[2] + data.body("fore").xmat.reshape(3, 3)[2] @ [0.2, 0, 0] - 0.001
    )
    assert force[0] > 5
    assert force[0] / depth == pytest.approx(3000.0, rel=0.1)


def test_a_batch_has_tables_of_its_own(tipped):
    sim = BatchSim(tipped.with_table(Table(-0.05, 0.3, 3000.0)), [(0.0, "both", 0.02)] * 3, 1)
    heights = np.array([-0.05, -0.03, -9.0])
    write_table(
        sim.batch, next(iter(sim.models.values())), heights, np.full(3, 0.3), np.full(3, 3000.0)
    )
    sim.reset(slice(None), np.zeros((3, 2)), np.zeros((3, 2)))
    for _ in range(200):
        sim.step(np.full((3, 2), 0.3))
    tip = [-0.2 * (np.sin(q[0]) + np.sin(q[0] + q[1])) for q in sim.qpos]
    assert tip[0] == pytest.approx(-0.05, abs=0.006)
    assert tip[1] == pytest.approx(-0.03, abs=0.006)
    assert tip[2] < -0.12


def test_an_identified_table_is_saved_and_changes_the_simulator(tipped, tmp_path):
    found = tipped.with_identified({"elbow": {"stribeck": 0.1, "zero": 0.02}}).with_table(
        Table(-0.05, 0.3, 3000.0),
    )
    save_robot(found, tmp_path / "found")
    again = load_robot(tmp_path / "found")
    assert again.scene.table == found.scene.table
    assert (again.servo.stribeck[1], again.servo.zero[1]) == (0.1, 0.02)
    assert again.nominal.scene.table is None
    assert model_hash(again) == model_hash(found) != model_hash(tipped)
    assert model_hash(found.with_table(None)) != model_hash(found)


def test_a_table_that_nothing_may_touch_is_refused(tmp_path):
    with pytest.raises(RobotError, match="tip"):
        write_arm(tmp_path / "arm", toml=TOML + "[table]\nheight = -0.05\n")
    stranger = write_arm(
        tmp_path / "b", toml=TOML + TIP.replace("fore", "jaw") + "[table]\nheight = -0.05\n"
    )
    with pytest.raises(RobotError, match="jaw"):
        build_model(stranger)


def test_a_datasets_robot_has_the_gains_that_all_recordings_state(tmp_path):
    robot = write_arm(tmp_path / "arm")
    soft = robot.with_gains((15.0, 15.0), None)
    recorded = record(soft, commands(100, 1), "m")
    meta = replace(recorded.meta, kp=(15.0, 15.0), notes={"gains": "as recorded"})
    recorded = replace(recorded, meta=meta)
    data = write_dataset(tmp_path / "data", robot, [recorded])
    assert dataset_robot(data).servo.kp.tolist() == [15.0, 15.0]
    # Fitted with these gains, or without.
    for name, nominal, kp in (("with", soft, 15.0), ("before", robot, 20.0)):
        save_robot(nominal.with_identified({"elbow": {"delay": 0.01}}), tmp_path / name)
        assert dataset_robot(data, tmp_path / name).servo.kp.tolist() == [kp, kp]
    softer = replace(recorded.meta, motion="n", kp=(9.0, 9.0))
    data.append(replace(recorded.rows(slice(50)), meta=softer))
    assert dataset_robot(data).servo.kp.tolist() == [20.0, 20.0]


def test_an_operated_joint_that_slides_is_refused(tmp_path):
    sliding = XML.replace('name="elbow" axis', 'name="elbow" type="slide" axis')
    robot = write_arm(tmp_path / "arm", TOML, sliding)
    with pytest.raises(RobotError, match=r"'elbow' is a slide joint.*operated = false"):
        build_model(robot)


def test_a_joint_that_slides_and_is_not_operated_is_simulated(tmp_path):
    sliding = XML.replace('name="elbow" axis', 'name="elbow" type="slide" axis')
    toml = TOML.replace('name = "elbow"', 'name = "elbow"\noperated = false')
    assert build_model(write_arm(tmp_path / "arm", toml, sliding)).nv == 2
