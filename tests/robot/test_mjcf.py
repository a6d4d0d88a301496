"""An untrusted MJCF is refused in one line, before it needs memory or time."""

import os

import pytest
from arm import XML, write_arm

from gaponet.base.errors import RobotError
from gaponet.sim.model import build_model

BIG = '<worldbody><replicate count="200000"><body><geom size="1"/></body></replicate>'


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("<worldbody>", BIG, "larger"),
        ("<worldbody>", BIG.replace("200000", "1e9"), "larger"),
        ("<worldbody>", BIG.replace("200000", "0x7fffffff"), "larger"),
        ("<worldbody>", '<worldbody><composite count="3000 3000 1"/>', "larger"),
        (
            "<worldbody>",
            '<asset><texture builtin="flat" width="100000" height="100000"/></asset><worldbody>',
            "larger",
        ),
        ("<worldbody>", '<size memory="900G"/><worldbody>', "memory"),
        ("<worldbody>", '<include file="robot.xml"/><worldbody>', "twice"),
        ("<worldbody>", '<include file="/dev/zero"/><worldbody>', "file"),
        ("<worldbody>", '<asset><mesh name="m" file="/dev/zero"/></asset><worldbody>', "file"),
        ("<worldbody>", "<worldbody", "MJCF"),
        ("<worldbody>", "<wordbody></wordbody><worldbody>", "MJCF"),
        ('name="elbow"', 'name="wing"', "elbow"),
    ],
)
def test_an_oversized_or_invalid_mjcf_is_refused(tmp_path, old, new, said):
    robot = write_arm(tmp_path / "arm", xml=XML.replace(old, new))
    with pytest.raises(RobotError, match=said) as error:
        build_model(robot)
    assert "\n" not in str(error.value)


def test_a_pipe_as_a_mesh_is_refused_at_once(tmp_path):
    mesh = '<asset><mesh file="m.obj"/></asset><worldbody>'
    robot = write_arm(tmp_path / "arm", xml=XML.replace("<worldbody>", mesh))
    os.mkfifo(tmp_path / "arm" / "m.obj")
    with pytest.raises(RobotError, match=r"m\.obj"):
        build_model(robot)
