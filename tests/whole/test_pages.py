"""Three people, a section each: what the pages tell a lab, an RL engineer and a researcher to run,
in this order.
"""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from arm import XML, commands, record, write_arm

from gaponet.cli.main import main
from gaponet.robot.spec import load_robot

DOCS = Path(__file__).parents[2] / "docs"
SERVOS = "".join(
    f'<position joint="{joint}" kp="20" forcerange="-5 5"/>' for joint in ("shoulder", "elbow")
)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A model file, logs of an arm with weaker and later servos, logs of another day, and a rollout
    of a simulator.
    """
    folder = tmp_path_factory.mktemp("pages")
    (folder / "arm.xml").write_text(
        XML.replace("</mujoco>", f"<actuator>{SERVOS}</actuator></mujoco>")
    )
    robot = write_arm(folder / "nominal")
    for name, seeds, how in (
        ("logs", range(5), {"kp": 0.7, "delay": 2}),
        ("new_logs", [11], {"kp": 0.65, "delay": 2}),
        ("rollouts", [12], {}),
    ):
        (folder / name).mkdir()
        rows = 160 if name == "logs" else 300  # an adaptation needs windows that it does not see
        for seed in seeds:
            s = record(robot, commands(rows, seed), f"m{seed}", **how)
            table = np.concatenate([s.dt * np.arange(rows)[:, None], s.ctrl, s.qpos], axis=1)
            head = "time,ctrl.shoulder,ctrl.elbow,qpos.shoulder,qpos.elbow"
            np.savetxt(
                folder / name / f"m{seed}.csv",
                table,
                delimiter=",",
                header=head,
                comments="",
                fmt="%.6f",
            )
    return folder


def blocks(page, heading):
    """(language, text) of the blocks of a page's section."""
    section = (
        (DOCS / page).read_text(encoding="utf-8").split(f"\n## {heading}\n")[1].split("\n## ")[0]
    )
    return re.findall(r"```(console|python)\n(.*?)```", section, re.DOTALL)


def play(page, heading, capsys):
    """Run a section from top to bottom; what it printed."""
    capsys.readouterr()
    for language, text in blocks(page, heading):
        if language == "python":
            exec(compile(text, page, "exec"), {"__name__": page})
            continue
        for line in text.splitlines():
            words = shlex.split(line)
            if words[0] == "python":
                print(
                    subprocess.run(
                        [sys.executable, words[1]], capture_output=True, text=True, check=True
                    ).stdout
                )
            else:  # the pages' fits take a minute; here they take seconds
                quick = ["--budget", "3s"] if words[1] == "start" else []
                assert main([*words[1:], *quick]) == 0, line
    return " ".join(capsys.readouterr().out.split())


@pytest.fixture
def said(request, place, monkeypatch, capsys):
    """What a page's section printed; each goes on in the folder where the last ended."""
    monkeypatch.chdir(place)
    return play(*request.param, capsys)


def of_section(page, heading):
    return pytest.mark.parametrize("said", [(page, heading)], indirect=True, ids=[page])


@of_section("tutorial.md", "One command")
def test_one_command_identifies_the_servos_and_writes_reports_and_exports(place, said):
    assert (place / "started/identified/report.html").is_file()
    assert (place / "today/robot.toml").is_file()
    found = load_robot(place / "started/identified")
    assert found.servo.kp[found.operated_index] == pytest.approx([14.0, 14.0], rel=0.1)
    assert found.servo.delay[found.operated_index] == pytest.approx([0.04, 0.04], abs=0.008)
    errors = re.search(r"the MJCF alone: ([\d.]+) mrad; in gaponet ([\d.]+)", said)
    alone = float(errors[1])
    in_gaponet = float(errors[2])
    assert abs(alone - in_gaponet) <= 0.02 * in_gaponet + 0.01


@of_section("export.md", "A policy that fails on the robot")
def test_a_policy_that_fails_on_the_robot_is_explained_and_answered(place, said):
    assert "The robot would not do what the simulator did: " in said
    assert (place / "mine/arm.xml").is_file()
    assert len(np.load(place / "answer.npz")["joints"]) == 2


def error_of(method, said):
    return float(re.search(rf"{method}: ([\d.]+) mrad", said)[1])


@of_section("benchmark.md", "Your method on your recordings")
def test_your_own_method_stands_between_nominal_and_identified(said):
    assert error_of("identified", said) < error_of("mine", said) < error_of("nominal", said)
