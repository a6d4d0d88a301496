"""Servos in somebody else's scene: by joint name, as our own replay, refused where they
contradict.
"""

import mujoco
import numpy as np
import pytest
from arm import TOML, XML, commands, write_arm

import gaponet as gp
from gaponet.base.errors import RobotError
from gaponet.export.shipped.mujoco_servos import fill_delays
from gaponet.sim.batch import BatchSim

PREFIX = "left/"
LAW = {"stribeck": 0.1, "stribeck_speed": 0.05, "friction_motor": 0.1, "no_load_speed": 6.0}
SERVO = {"kp": 14.0, "damping": 0.8, "frictionloss": 0.2, "armature": 0.04, "offset": 0.03}
SERVO |= {"effort_limit": 4.0, "zero": 0.02, "delay": 0.012}
PERIOD_STEPS = 4


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("arm"))


def identified(arm, **other):
    return arm.with_identified(dict.fromkeys(arm.joint_names, SERVO | other))


def scene(arm, xml=None):
    """Somebody's scene: the arm on a turned pedestal, with a ball that falls onto the floor beside
    it.
    """
    spec = mujoco.MjSpec()
    spec.option.timestep = 0.005
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(5, 5, 0.1))
    ball = spec.worldbody.add_body(name="ball", pos=(2.0, 0.0, 0.3))
    ball.add_freejoint()
    ball.add_geom(size=(0.05, 0.0, 0.0), mass=0.2)
    pedestal = spec.worldbody.add_frame(pos=(0.0, 0.0, 1.0), quat=(0.6, 0.0, 0.0, 0.8))
    child = mujoco.MjSpec.from_string(xml) if xml else mujoco.MjSpec.from_file(str(arm.mjcf))
    spec.attach(child, frame=pedestal, prefix=PREFIX)
    return spec


def play_scene(model, targets, servos=None):
    """Return positions of the arm after each control period, (T, 2) rad; it starts at rest at the
    first target.
    """
    data = mujoco.MjData(model)
    joints = [model.joint(f"{PREFIX}{name}") for name in ("shoulder", "elbow")]
    at = [joint.qposadr[0] for joint in joints]
    servo = [int(np.flatnonzero(model.actuator_trnid[:, 0] == joint.id)[0]) for joint in joints]
    data.qpos[at] = targets[0]
    data.ctrl[servo] = targets[0]
    fill_delays(model, data)
    mujoco.mj_forward(model, data)
    positions = []
    for target in targets:
        data.ctrl[servo] = target
        for _ in range(PERIOD_STEPS):
            if servos is not None:
                servos.before(data)
            mujoco.mj_step(model, data)
        positions.append(data.qpos[at].copy())
    return np.array(positions), data


def play_gaponet(robot, targets):
    sim = BatchSim(robot, [(0.0, "both", robot.dt)], 1)
    sim.reset(slice(None), targets[:1], np.zeros((1, 2)), past=targets[None, :1])
    positions = []
    for target in targets:
        sim.step(target[None])
        positions.append(sim.qpos[0].copy())
    return np.array(positions)


@pytest.mark.parametrize("law", [{}, LAW])
def test_a_scene_moves_as_gaponet_replays_the_robot(arm, law):
    robot = identified(arm, **law)
    targets = commands(200, 3)
    spec = scene(arm)

    applied = gp.apply(robot, spec, prefix=PREFIX)
    model = spec.compile()
    played, data = play_scene(model, targets, applied.servos(model))

    np.testing.assert_allclose(played, play_gaponet(robot, targets), atol=2e-5)
    assert data.body("ball").xpos[2] == pytest.approx(0.05, abs=0.005)


def test_without_the_servo_model_only_the_stiffness_of_friction_is_left_out(arm):
    robot = identified(arm)
    targets = commands(200, 3)
    spec = scene(arm)

    assert gp.apply(robot, spec, prefix=PREFIX).servo_model == ()
    played, _ = play_scene(spec.compile(), targets)

    assert np.abs(played - play_gaponet(robot, targets)).max() < 2e-3


def test_the_servo_model_that_no_scene_holds_is_named(arm):
    applied = gp.apply(identified(arm, **LAW), scene(arm), prefix=PREFIX)
    assert set(applied.servo_model) == set(LAW)


@pytest.mark.skipif(
    not hasattr(mujoco.MjsActuator, "set_to_pid"), reason="MuJoCo without <pid slewmax>"
)
def test_a_scene_limits_the_speed_of_targets_within_the_way_of_a_period(arm):
    """gaponet moves a target once per period of 20 ms, the scene in each step: 0.8 rad/s make 16
    mrad.
    """
    speed = 0.8
    robot = identified(arm, target_speed=speed)
    targets = np.repeat([[0.3, -0.2], [-0.5, 0.6], [0.3, -0.2]], 80, axis=0)
    spec = scene(arm)

    gp.apply(robot, spec, prefix=PREFIX)
    played, _ = play_scene(spec.compile(), targets)

    expected = play_gaponet(robot, targets)
    without_limit = play_gaponet(identified(arm), targets)
    assert np.abs(played - expected).max() < speed * robot.dt
    assert np.abs(without_limit - expected).max() > 0.2


def test_an_actuator_of_the_scene_keeps_its_name(arm):
    spec = scene(arm)
    own = spec.add_actuator(name="motor 7", target="left/elbow", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    own.set_to_position(kp=300.0)

    gp.apply(identified(arm), spec, prefix=PREFIX)

    model = spec.compile()
    assert model.nu == 2
    assert model.actuator("motor 7").gainprm[0] == SERVO["kp"]


def motor(spec):
    actuator = spec.add_actuator(name="m", target="left/elbow", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    actuator.set_to_motor()


def two_servos(spec):
    for name in ("a", "b"):
        joint = mujoco.mjtTrn.mjTRN_JOINT
        actuator = spec.add_actuator(name=name, target="left/elbow", trntype=joint)
        actuator.set_to_position(kp=10.0)


def in_degrees(spec):
    two_servos(spec)
    spec.delete(spec.actuator("b"))
    spec.actuator("a").gainprm[0] = np.deg2rad(10.0)


@pytest.mark.parametrize(
    ("spoil", "word"),
    [(motor, "targets"), (two_servos, "2"), (in_degrees, "rad")],
)
def test_actuators_that_contradict_are_refused(arm, spoil, word):
    spec = scene(arm)
    spoil(spec)
    with pytest.raises(RobotError, match=word):
        gp.apply(identified(arm), spec, prefix=PREFIX)


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ('name="elbow" axis="0 1 0"', 'name="elbow" axis="0 0 1"', "90°"),
        ('name="elbow" axis="0 1 0"', 'name="elbow" axis="0 -1 0"', "180°"),
        ('axis="0 1 0" range="-1.5 1.5"', 'axis="0 1 0" range="-0.5 2.5"', "range"),
        ('name="elbow"', 'name="ellbow"', "left/elbow"),
        ('name="elbow" axis="0 1 0"', 'name="elbow" type="slide" axis="0 1 0"', "hinge"),
    ],
)
def test_joints_that_contradict_are_refused_and_nothing_is_changed(arm, old, new, word):
    assert old in XML
    spec = scene(arm, XML.replace(old, new))
    before = spec.copy().to_xml() if spec.copy().compile() else ""

    with pytest.raises(RobotError, match=word):
        gp.apply(identified(arm), spec, prefix=PREFIX)

    after = spec.copy()
    after.compile()
    assert after.to_xml() == before


def test_identified_inertias_of_links_are_written(arm, tmp_path):
    link = "[identified_link.fore]\nmass = 0.35\npos = [0.11, 0.0, 0.01]\n"
    link += "inertia = [2e-4, 9e-4, 9e-4, 0.0, 0.0, 0.0]\n"
    robot = write_arm(tmp_path, TOML + link)
    spec = scene(robot)

    gp.apply(robot, spec, prefix=PREFIX)

    body = spec.compile().body("left/fore")
    assert body.mass[0] == pytest.approx(0.35)
    np.testing.assert_allclose(body.ipos, [0.11, 0.0, 0.01])


def test_a_scene_carries_the_mass_that_the_robot_always_carries(tmp_path):
    hand_kg = 0.6
    robot = write_arm(tmp_path, f"{TOML}mass = {hand_kg}\n")
    spec = scene(robot)
    before = spec.copy().compile().body_mass.sum()

    gp.apply(robot, spec, prefix=PREFIX)

    model = spec.compile()
    assert model.body_mass.sum() == pytest.approx(before + hand_kg)
    hand = model.body("left/payload_hand")
    assert model.body(hand.parentid[0]).name == "left/fore"
    assert hand.pos == pytest.approx([0.2, 0.0, 0.0])


def test_a_mount_whose_body_is_missing_is_refused(tmp_path):
    robot = write_arm(tmp_path, f"{TOML}mass = 0.6\n")
    spec = scene(robot, XML.replace('<body name="fore"', '<body name="hand"'))
    with pytest.raises(RobotError, match="left/fore"):
        gp.apply(robot, spec, prefix=PREFIX)


@pytest.mark.parametrize(("mass", "word"), [(0.0, "zero"), (0.6, "payload_hand")])
def test_a_scene_is_changed_once(tmp_path, mass, word):
    robot = identified(write_arm(tmp_path, f"{TOML}mass = {mass}\n"))
    spec = scene(robot)
    gp.apply(robot, spec, prefix=PREFIX)
    with pytest.raises(RobotError, match=word):
        gp.apply(robot, spec, prefix=PREFIX)


def test_a_servo_of_the_scene_adds_no_armature_or_damping_of_its_own(arm):
    spec = scene(arm)
    own = spec.add_actuator(name="m", target="left/elbow", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    own.set_to_position(kp=300.0)
    own.armature = 0.5
    own.damping[:] = 0.3, 0.1, 0.05

    gp.apply(identified(arm), spec, prefix=PREFIX)

    model = spec.compile()
    assert not model.actuator_armature.any()
    assert not model.actuator_damping.any()
    assert not model.actuator_dampingpoly.any()


def test_the_temperature_of_friction_is_said(arm):
    warm = identified(arm, friction_per_kelvin=-0.01, friction_temperature=45.0)
    notes = gp.apply(warm, scene(arm), prefix=PREFIX).notes
    assert any("45 °C" in note for note in notes)


def test_what_the_scene_lacks_is_said(arm):
    stopped = identified(arm).with_servo(stop_low=np.array([-1.0, np.nan]))
    spec = scene(arm)
    spec.option.timestep = 0.01
    notes = " ".join(gp.apply(stopped, spec, prefix=PREFIX).notes)
    assert "5 ms" in notes
    assert "stops of shoulder" in notes
