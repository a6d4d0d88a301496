"""An MJCF with includes, meshes and frames in one file has the same dynamics."""

import mujoco
import numpy as np
import pytest
from arm import TOML
from arm import XML as PLAIN
from files_arm import XML, write_files_arm

from gaponet.base.errors import RobotError
from gaponet.robot.folder import save_robot
from gaponet.robot.self_contained import self_contained_mjcf
from gaponet.robot.spec import load_robot
from gaponet.sim.model import build_model, model_hash

FLOATING = """<mujoco><worldbody>
  <body pos="0 0 1"><freejoint/><geom size="0.1"/>
    <body pos="0.3 0 0"><joint name="hip" range="-1 1" margin="0.05"/><geom size="0.1"/>
      <body pos="0.3 0 0"><joint name="knee" range="-1 1" margin="0.02"/><geom size="0.1"/></body>
    </body>
  </body>
</worldbody></mujoco>"""


def fall(robot, payload):
    """Positions of a motion of one second, (steps, n)."""
    model = build_model(robot, payload)
    data = mujoco.MjData(model)
    data.qpos[:] = [0.3, -0.2]
    out = []
    for step in range(200):
        data.ctrl[:] = 0.5 * np.sin(step * 0.05), 0.3 * np.cos(step * 0.03)
        mujoco.mj_step(model, data)
        out.append(data.qpos.copy())
    return np.array(out)


@pytest.mark.parametrize("contacts", [False, True])
def test_the_copy_needs_no_other_file_and_has_the_same_hash_and_motion(tmp_path, contacts):
    robot = write_files_arm(tmp_path / "arm", contacts=contacts)
    save_robot(robot, tmp_path / "kept")
    moved = (tmp_path / "kept").rename(tmp_path / "moved")
    before = [fall(robot, payload) for payload in (0.0, 0.7)], model_hash(robot)
    for file in sorted((tmp_path / "arm").rglob("*.*")):
        file.unlink()
    copy = load_robot(moved)
    text = copy.mjcf.read_text(encoding="utf-8")
    assert sorted(p.name for p in moved.glob("[!.]*")) == ["robot.toml", "robot.xml"]
    assert str(tmp_path) not in text + (moved / "robot.toml").read_text(encoding="utf-8")
    assert model_hash(copy) == before[1]
    for payload, qpos in zip((0.0, 0.7), before[0], strict=True):
        assert np.abs(fall(copy, payload) - qpos).max() < (1e-6 if contacts else 1e-12)


def test_a_copy_of_the_copy_is_identical(tmp_path):
    save_robot(write_files_arm(tmp_path / "arm"), tmp_path / "once")
    save_robot(load_robot(tmp_path / "once"), tmp_path / "twice")
    for name in ("robot.toml", "robot.xml"):
        assert (tmp_path / "twice" / name).read_bytes() == (tmp_path / "once" / name).read_bytes()


def test_numbers_beyond_the_precision_of_one_file_are_refused(tmp_path):
    tendon = (
        '<tendon><fixed name="t" stiffness="1.23456789">'
        '<joint joint="elbow" coef="1"/></fixed></tendon></mujoco>'
    )
    robot = write_files_arm(tmp_path / "arm", xml=XML.replace("</mujoco>", tendon))
    with pytest.raises(RobotError, match="fit"):
        save_robot(robot, tmp_path / "kept")
    assert [p.name for p in tmp_path.iterdir()] == ["arm"]


def test_a_visual_mesh_becomes_its_bounding_box(tmp_path):
    robot = write_files_arm(tmp_path / "arm")
    save_robot(robot, tmp_path / "kept")
    model = build_model(load_robot(tmp_path / "kept"))
    assert model.nmesh == 0
    box = mujoco.mjtGeom.mjGEOM_BOX
    assert (model.geom_type == box).any()
    assert model.geom_size[model.geom_type == box].max() == pytest.approx(0.1, rel=0.1)


def test_the_copy_of_a_floating_base_keeps_each_joints_margin(tmp_path):
    """Joints and degrees of freedom have different numbers here: the base has six of them."""
    file = tmp_path / "floating.xml"
    file.write_text(FLOATING)
    copy = mujoco.MjModel.from_xml_string(self_contained_mjcf(file))
    assert copy.jnt_margin.tolist() == [0.0, 0.05, 0.02]


def test_the_mjcf_may_be_in_a_subfolder(tmp_path):
    (tmp_path / "arm" / "model").mkdir(parents=True)
    (tmp_path / "arm" / "model" / "arm.xml").write_text(PLAIN)
    (tmp_path / "arm" / "robot.toml").write_text('mjcf = "model/arm.xml"\n' + TOML)
    robot = load_robot(tmp_path / "arm")
    save_robot(robot, tmp_path / "kept")
    assert (tmp_path / "kept" / "robot.xml").read_text() == PLAIN
    assert model_hash(load_robot(tmp_path / "kept")) == model_hash(robot)
