"""docs/ten-minutes.md: its commands, on a vendor's model and ROS bags that the test writes."""

import re
import shlex
from pathlib import Path

import pytest
from arm import XML

pytest.importorskip("rosbags")
from strange_logs import write_bag

from gaponet.cli.main import main

PAGE = Path(__file__).parents[2] / "docs" / "ten-minutes.md"
ACTUATORS = "".join(
    f'<position joint="{joint}" kp="20" forcerange="-5 5"/>' for joint in ("shoulder", "elbow")
)  # fmt: skip


def test_from_a_model_and_bags_to_a_gap_without_a_line_of_code(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("arm.xml").write_text(XML.replace("</mujoco>", f"<actuator>{ACTUATORS}</actuator></mujoco>"))
    for name in ("wave", "sway"):
        write_bag(tmp_path / "bags" / name, rows=400 if name == "wave" else 300)
    blocks = re.findall(r"```console\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    commands = [shlex.split(line)[1:] for block in blocks for line in block.splitlines()]
    assert [c[0] for c in commands] == ["robot", "import", "import", "doctor", "robot", "gap", "identify"]
    for command in commands[:-1]:  # identification takes a minute, and has tests of its own
        assert main(command) == 0, command
    told = " ".join(capsys.readouterr().out.split())
    assert "ok: arm compiles, holds its home and is stable" in told
    assert "2 sequences" in told
    assert "MPJAE" in told
