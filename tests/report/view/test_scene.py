"""Copies of a robot in one scene, and pictures of it."""

import dataclasses

import mujoco
import numpy as np
import pytest
from arm import XML, commands, record, write_arm

from gaponet.base.errors import UsageError
from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.evaluation.evaluate import ORDER
from gaponet.evaluation.methods import colour
from gaponet.report.view.picture import Camera, require_writable, write
from gaponet.report.view.player import page_colour
from gaponet.report.view.scene import GHOST_RGBA, Scene, View, rgb, visual_spec
from gaponet.report.view.side_by_side import Clip, Copy, SideBySide
from gaponet.robot.spec import Table, load_robot
from gaponet.sim.model import build_model

METHODS = ("target", "nominal", "gaponet", "recorded")


def shown(robot, payload=0.5, virtual=True):
    """Four motions that differ by known angles; gaponet is 0.1 rad off, nominal 0.3."""
    real = record(robot, commands(40, 0), "wave", payload)
    real = dataclasses.replace(real, meta=dataclasses.replace(real.meta, virtual=virtual))
    off = {"target": 0.5, "nominal": 0.3, "gaponet": 0.1, "recorded": 0.0}
    motions = tuple(Copy(m, real.qpos + off[m], np.full(len(real), off[m])) for m in METHODS)
    return SideBySide(real, robot, motions, False)


@pytest.fixture
def four(arm):
    return shown(arm)


@pytest.fixture(scope="module")
def camera(tmp_path_factory):
    """One camera for all pictures, or a skip that says why."""
    scene = Scene(shown(write_arm(tmp_path_factory.mktemp("arm"))), flat=True)
    try:
        opened = Camera(scene, Clip.from_start(scene.shown, 0.1, 0.2, speed=0.5, fps=10), width=320)
    except UsageError as error:
        pytest.skip(f"no OpenGL here: {error}")
    with opened:
        yield opened


def test_robots_have_the_angles_of_their_motions_and_ghosts_those_of_the_recording(four, arm):
    scene = Scene(four)
    assert scene.model.nq == 4 * 2 + 3 * 2
    scene.pose(0.2)
    for motion in four.motions:
        for j, joint in enumerate(arm.joint_names):
            angle = scene.data.qpos[scene.model.joint(f"{motion.method}/{joint}").qposadr[0]]
            assert angle == pytest.approx(motion.qpos[10, j])
    ghost = scene.data.qpos[scene.model.joint("nominal-ghost/shoulder").qposadr[0]]
    assert ghost == pytest.approx(four.real.qpos[10, 0])


def test_between_two_rows_a_robot_is_between_them(four):
    scene = Scene(four)
    scene.pose(0.21)
    angle = scene.data.qpos[scene.model.joint("recorded/elbow").qposadr[0]]
    assert angle == pytest.approx(four.real.qpos[10:12, 1].mean())


def test_hands_are_where_the_simulator_puts_them(four, arm):
    """Dressing changes looks, not kinematics; copies stand in a row, a spacing apart."""
    scene = Scene(four)
    scene.pose(0.4)
    model = build_model(arm, 0.5)
    data = mujoco.MjData(model)
    for i, motion in enumerate(four.motions):
        data.qpos[:] = motion.qpos[20]
        mujoco.mj_kinematics(model, data)
        hand = scene.data.body(f"{motion.method}/payload_hand").xpos
        np.testing.assert_allclose(hand - scene.base[i], data.body("payload_hand").xpos, atol=1e-6)
    steps = np.linalg.norm(np.diff(scene.base, axis=0), axis=1)
    np.testing.assert_allclose(steps, scene.spacing)


def test_the_axes_of_the_picture_are_right_and_up():
    right, up = View(azimuth=90.0, elevation=0.0).axes  # looking along +y
    np.testing.assert_allclose(right, [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-12)


def test_the_box_holds_the_robot_in_every_frame(four):
    """0.4 m of stretched arm, seen from the side: not clipped, and not lost in an empty picture."""
    view = View(azimuth=90.0, elevation=0.0)
    scene = Scene(four, view)
    model = build_model(four.robot, 0.5)
    data = mujoco.MjData(model)
    left, right, bottom, top = scene.box
    for q in four.motions[1].qpos:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        x, _, z = data.body("payload_hand").xpos
        assert left < x < right
        assert bottom < z < top
    assert right - left < 0.6


def test_a_robot_with_a_table_can_be_drawn(arm):
    assert (
        visual_spec(arm.with_table(Table(-0.05, 0.3, 3000.0)), "#c8102e", 0.0).compile().npair == 0
    )


@pytest.mark.parametrize("name", ["h1_2", "so101"])
def test_the_robots_of_the_package_can_be_drawn(name):
    robot = load_robot(name)
    spec = visual_spec(robot, "#c8102e", 1.0)
    model = spec.compile()
    assert model.ngeom > build_model(robot).ngeom
    assert model.nu == 0
    ball = model.body(f"payload_{robot.payload_mounts[0].side}")
    rgba = model.geom_rgba[ball.geomadr[0]]
    assert not np.allclose(rgba, model.geom_rgba[0])


def test_a_closeup_may_cut_limbs_without_operated_joints():
    h1_2 = load_robot("h1_2")
    real = Sequence(
        SequenceMeta("h1_2", "a", "stand", 0.0), h1_2.joint_names, 0.02, *np.zeros((3, 2, 27))
    )
    standing = SideBySide(real, h1_2, (Copy("recorded", real.qpos, np.zeros(2)),), None)
    whole = Scene(standing)
    near = Scene(standing, closeup=True)
    assert whole.box.bottom < 0.1 < 0.6 < near.box.bottom  # feet, pelvis
    assert whole.box.top == near.box.top
    assert whole.floor == near.floor < 0.05


def test_a_ground_in_the_robots_own_file_is_not_drawn_four_times(tmp_path):
    own = XML.replace("<worldbody>", '<worldbody><geom name="ground" type="plane" size="1 1 1"/>')
    scene = Scene(shown(write_arm(tmp_path, xml=own)))
    assert (scene.model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE).sum() == 1


def test_a_picture_is_not_blank_and_shows_every_colour(camera):
    picture = np.asarray(camera.picture(0.4))
    assert picture.shape == (camera.height, 320, 3)
    assert camera.height % 2 == 0
    robots = picture[camera.head : camera.head + camera.robots].astype(int)
    for i, motion in enumerate(camera.scene.shown.motions):
        panel = robots[:, i * 80 : (i + 1) * 80]
        away = np.abs(panel - panel[0, 0]).max(axis=2) > 60
        assert 0.002 < away.mean() < 0.6, motion.method
    red = (robots[..., 0] > 2 * robots[..., 1]) & (robots[..., 0] > 100)
    assert red[:, 160:240].sum() > 20
    assert red[:, 160:240].sum() > 0.9 * red.sum()


def test_virtual_is_written_on_virtual_pictures_only(camera, monkeypatch):
    red = {}
    for virtual in (True, False):
        monkeypatch.setattr(camera.scene, "shown", shown(camera.scene.shown.robot, virtual=virtual))
        head = np.asarray(camera.picture(0.0))[: camera.head].astype(int)
        red[virtual] = int(((head[..., 0] - head[..., 1]) > 80).sum())
    assert red[True] > 50
    assert red[False] == 0


def test_films_have_the_length_asked_for(camera, tmp_path):
    from PIL import Image

    assert write(camera, tmp_path / "a.gif") == 4  # 0.2 s at half speed, 10 pictures/s
    assert write(camera, tmp_path / "a.png") == 1
    with Image.open(tmp_path / "a.gif") as film:
        assert film.n_frames == 4
        assert film.info["duration"] == 100
        assert film.info["loop"] == 0


def test_an_mp4_is_an_mp4(camera, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    write(camera, tmp_path / "a.mp4")
    assert (tmp_path / "a.mp4").read_bytes()[4:8] == b"ftyp"


def test_bad_clips_and_files_are_refused_with_what_to_do(four, tmp_path):
    with pytest.raises(UsageError, match="--start"):
        Clip.from_start(four, 9.0, 1.0)
    with pytest.raises(UsageError, match="--speed"):
        Clip.from_start(four, 0.0, 1.0, speed=0.0)
    with pytest.raises(UsageError, match=r"\.gif"):
        require_writable(tmp_path / "a.avi")
    with pytest.raises(UsageError, match="first"):
        require_writable(tmp_path / "nowhere" / "a.gif")


def test_the_browser_gets_a_mesh_for_every_body_where_it_is(four):
    pytest.importorskip("viser")
    from gaponet.report.view.player import Player
    from gaponet.report.view.server import open_server

    scene = Scene(four)
    server, _ = open_server("test", 0)
    object.__setattr__(four.real.meta, "motion", "![x](https:evil.example)")
    object.__setattr__(four.motions[1], "error", np.where(np.arange(40) == 20, 0.9, 0.3))
    try:
        player = Player(server, scene, Clip.from_start(four, 0.0, 0.6))
        assert r"!\[x\](https:evil.example)" in player.title.content
        player.speed.value = 1.0
        player.advance(0.2)
        body = scene.model.body("gaponet/fore").id
        scene.pose(0.2)
        np.testing.assert_allclose(
            player.bodies.frames[body].position, scene.data.xpos[body], atol=1e-5
        )
        assert "| nominal simulator | 300.0 | 315.4 |" in player.errors.text.content
        assert player.worst.label == "Worst moment: 0.40 s"
    finally:
        server.stop()


def test_every_copy_is_seen_on_a_light_and_a_dark_page():
    """Contrast as WCAG 2 defines it; only the dark recording and its ghosts have another colour
    than in pictures.
    """

    def luminance(colour):
        linear = np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)
        return linear @ (0.2126, 0.7152, 0.0722)

    own = {method: np.array(rgb(colour(method))[:3]) for method in ("target", *ORDER)}
    assert all(
        (page_colour(x) == (255 * x).astype(int)).all()
        for limb in own.values()
        for x in (limb, 0.55 * limb)
    )
    recorded = np.array(rgb(colour("recorded"))[:3])
    for x in (recorded, 0.55 * recorded, np.array(GHOST_RGBA[:3])):
        light = luminance(page_colour(x) / 255)
        assert 1.05 / (light + 0.05) > 3  # on white
        assert (light + 0.05) / (luminance(np.full(3, 0.1)) + 0.05) > 1.5
    light = luminance(page_colour(recorded) / 255)
    assert (light + 0.05) / (luminance(np.full(3, 0.1)) + 0.05) > 3
