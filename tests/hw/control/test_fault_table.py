"""The table of faults: every fault that the code names has a rule, and the pages have the same
rows.
"""

from __future__ import annotations

import re
from pathlib import Path

import gaponet.hw
from gaponet.hw.control.safety import FAULTS, lowers, spoils_data

DOCS = Path(__file__).parents[3] / "docs"
SAFETY = DOCS / "deploy-safety.md"
CONTROLLER = DOCS / "reference" / "controller.md"
SOURCES = Path(gaponet.hw.__file__).parent


def section(file: Path, title: str) -> list[str]:
    page = file.read_text(encoding="utf-8")
    return page.split(f"{title}\n", 1)[1].split("\n#", 1)[0].splitlines()


def test_the_page_has_the_same_table():
    lines = section(CONTROLLER, "## What is still used after a fault")
    rows = [line for line in lines if line.startswith("| ")]

    expected = []
    for kind, rule in FAULTS.items():
        expected.append(f"| {kind} | {rule.doubted} | {rule.usable} | {rule.ending} |")
    assert rows[1:] == expected


def test_the_page_says_when_each_fault_is_detected():
    lines = section(SAFETY, "## Faults that stop the robot")
    detected = set()
    for line in lines:
        if line.startswith("| "):
            detected.update(re.split(", ", line.split("|")[1].strip()))

    assert set(FAULTS) - {"stop"} <= detected


def test_the_page_says_which_faults_let_an_so101_go_at_once():
    for line in section(SAFETY, "## Faults that stop the robot"):
        cells = [cell.strip() for cell in line.split("|")[1:-1]]
        if line.startswith("| ") and cells[-1] in ("lowered", "let go"):
            for kind in cells[0].split(", "):
                assert lowers(kind) == (cells[-1] == "lowered"), kind


def test_every_fault_in_the_code_has_a_rule():
    named = set()
    for file in SOURCES.rglob("*.py"):
        named.update(re.findall(r"(?:Fault|_said)\(\s*\"(\w+)\"", file.read_text(encoding="utf-8")))

    assert named
    assert named <= set(FAULTS)


def test_after_a_fault_of_the_arm_itself_it_is_let_go_at_once():
    let_go = {kind for kind in FAULTS if not lowers(kind)} - {"plan"}

    readings = {"frozen", "nan", "jump", "temperature", "tracking", "torque", "robot", "tilt"}
    assert let_go == readings | {"goal", "source"}


def test_a_recording_in_which_a_joint_did_not_go_where_it_was_sent_is_no_data():
    spoilt = {kind for kind in FAULTS if spoils_data(kind)}

    assert spoilt == {"obedience", "goal", "source", "frozen", "jump", "tracking"}


def test_the_end_of_a_run_without_fault_lowers_nothing():
    assert not lowers("end")
    assert not spoils_data("end")
