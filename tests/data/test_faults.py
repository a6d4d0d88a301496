"""Faults that need gravity or several recordings, put into good logs of a virtual arm, are found or
refused.
"""

import numpy as np
import pytest
from faulty import FAULTS, all_of, examine, recordings

from gaponet.base.errors import GAPONetError
from gaponet.data.store import Dataset
from gaponet.report.figures.dataset_figures import draw_findings
from gaponet.robot.finding import Finding
from gaponet.robot.spec import load_robot

# Check, level and words of the finding that names it.
NAMED = {
    "sign of command and state": ("gravity", "warning", "with its angle mirrored at elbow_flex"),
    "offset of 20 mrad": ("offset", "note", "elbow_flex rests +2"),
    "offset of 150 mrad": ("offset", "warning", "more than assembly leaves"),
    "lag of 100 ms more": ("lag", "warning", "As a dead time this is very long"),
    "lag of one joint": ("lag", "warning", "elbow_flex lags 1"),
    "scale of 1.2": ("scale", "warning", "elbow_flex goes 1.2"),
    "spike of a state": ("jumps", "warning", "elbow_flex jumps and comes back"),
    "frozen channel": ("stuck", "warning", "elbow_flex repeats one number"),
    "command and state swapped in one": (
        "copied",
        "error",
        "before their commands in m2, not in other recordings",
    ),
    "two robots in one": ("unit_id", "warning", "m2 rests +10"),
    "wrong gains": ("gains", "warning", "times as far as the stated kp says"),
    "wrong payload label": ("payload", "warning", "m2 rests as with 0"),
    "joint order": ("order", "warning", "the order of joints one place back"),
    "zero of command and state": (
        "gravity",
        "warning",
        "with its zero turned by +0.60 rad at elbow_flex",
    ),
    "torque of the other sign": ("gravity", "warning", "with its torque negated at elbow_flex"),
    "quantised": ("resolution", "warning", "come in steps of up to 10.0 mrad"),
    "saturated torque": ("saturation", "warning", "torque of elbow_flex is cut off flat at"),
    "saturated command": ("unit", "warning", "elbow_flex goes 1."),
}
# Words of the error with which the import refuses it.
REFUSED = {"truncated at a row's end": "its states end"}
# By lines for logs.toml.
MENDED = ("sign of command and state", "zero of command and state", "joint order")
# Checks that may warn of what follows from another fault.
CONSEQUENCES = {"jitter", "blocked", "jumps", "unit", "stuck", "range"}


@pytest.fixture(scope="module")
def robot():
    return load_robot("so101")


@pytest.fixture(scope="module")
def logs(robot):
    return recordings(robot)


@pytest.mark.parametrize("kp", [0.7, 1.2])
def test_good_logs_of_soft_and_stiff_motors_are_good(robot, tmp_path, kp):
    diagnosis = examine(robot, recordings(robot, kp), tmp_path)
    assert diagnosis.verdict == "Good: no error and no warning."
    checks = {finding.check for finding in diagnosis.findings}
    assert not checks & {"offset", "scale", "gains", "payload", "unit_id"}
    assert Finding.proposal(diagnosis.findings) == "# gaponet doctor --fix: nothing to mend.\n"


def test_encoder_steps_of_12_bits_are_no_fault(robot, logs, tmp_path):
    step = 2 * np.pi / 4096
    coarse = all_of(
        logs, lambda log: log.change(slice(None), qpos=lambda x: np.round(x / step) * step)
    )
    assert examine(robot, coarse, tmp_path).verdict.startswith("Good")


def examine_fault(robot, logs, fault, folder, **how):
    change, options = FAULTS[fault]
    return examine(robot, change(logs), folder, **options, **how)


def warnings_of(diagnosis):
    """The findings that are warnings or errors."""
    return [f for f in diagnosis.findings if f.level in ("warning", "error")]


def test_every_fault_is_named_or_refused():
    assert FAULTS.keys() == NAMED.keys() | REFUSED.keys()


@pytest.fixture(scope="module", params=NAMED)
def fault(request):
    return request.param


@pytest.fixture(scope="module")
def diagnosis(robot, logs, fault, tmp_path_factory):
    """The doctor's, of logs with the fault."""
    return examine_fault(robot, logs, fault, tmp_path_factory.mktemp("fault"))


def test_a_fault_is_found_and_named(diagnosis, fault):
    check, level, words = NAMED[fault]
    messages = [f.message for f in diagnosis.findings if (f.check, f.level) == (check, level)]
    assert any(words in message for message in messages)


def test_beside_a_fault_only_its_consequences_are_warned_of(diagnosis, fault):
    check, _, _ = NAMED[fault]
    assert {f.check for f in warnings_of(diagnosis)} <= {check} | CONSEQUENCES


@pytest.mark.parametrize("fault", MENDED, scope="module")
def test_a_fault_of_all_logs_is_mended_by_the_lines_that_are_proposed(
    diagnosis, robot, logs, fault, tmp_path
):
    proposed = Finding.proposal(diagnosis.findings)
    assert "applied to nothing" in proposed
    mended = examine_fault(robot, logs, fault, tmp_path, logs_toml=proposed)
    assert [f.message for f in warnings_of(mended)] == []


@pytest.mark.parametrize("fault", REFUSED)
def test_a_fault_is_refused(robot, logs, fault, tmp_path):
    error = examine_fault(robot, logs, fault, tmp_path)
    assert isinstance(error, GAPONetError)
    assert REFUSED[fault] in str(error)


def test_each_finding_has_a_picture(robot, logs, tmp_path):
    findings = examine_fault(robot, logs, "spike of a state", tmp_path).findings
    written = draw_findings(Dataset(tmp_path / "data"), robot, findings, tmp_path)
    assert (tmp_path / "01-jumps.png") in written
    pictured = 0
    for finding in findings:
        is_of_joints = finding.level == "note" and finding.joints
        if finding.level in ("warning", "error") or is_of_joints:
            pictured += 1
    assert len(written) == 2 * pictured
