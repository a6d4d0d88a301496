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

# Check, level and words of the finding that names it; no level: the import refuses with these
# words.
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
    "truncated at a row's end": ("", "", "its states end"),
}
MENDED = (
    "sign of command and state",
    "zero of command and state",
    "joint order",
)  # by lines for logs.toml


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
    assert not {f.check for f in diagnosis.findings} & {
        "offset",
        "scale",
        "gains",
        "payload",
        "unit_id",
    }
    assert Finding.proposal(diagnosis.findings) == "# gaponet doctor --fix: nothing to mend.\n"


def test_encoder_steps_of_12_bits_are_no_fault(robot, logs, tmp_path):
    step = 2 * np.pi / 4096
    coarse = all_of(
        logs, lambda log: log.change(slice(None), qpos=lambda x: np.round(x / step) * step)
    )
    assert examine(robot, coarse, tmp_path).verdict.startswith("Good")


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_found_and_named_or_refused(robot, logs, tmp_path, fault):
    change, how = FAULTS[fault]
    check, level, words = NAMED[fault]
    answer = examine(robot, change(logs), tmp_path, **how)
    if not check:
        assert isinstance(answer, GAPONetError)
        assert words in str(answer)
        return
    assert [
        f for f in answer.findings if (f.check, f.level) == (check, level) and words in f.message
    ]
    others = {f.check for f in answer.findings if f.level in ("warning", "error")} - {check}
    assert others <= {
        "jitter",
        "blocked",
        "jumps",
        "unit",
        "stuck",
        "range",
    }  # what follows from it
    if fault in MENDED:
        proposed = Finding.proposal(answer.findings)
        assert "applied to nothing" in proposed
        mended = examine(robot, change(logs), tmp_path / "mended", logs_toml=proposed)
        assert [f.message for f in mended.findings if f.level in ("warning", "error")] == []


def test_each_finding_has_a_picture(robot, logs, tmp_path):
    change, _ = FAULTS["spike of a state"]
    findings = examine(robot, change(logs), tmp_path).findings
    written = draw_findings(Dataset(tmp_path / "data"), robot, findings, tmp_path)
    assert (tmp_path / "01-jumps.png") in written
    assert len(written) == 2 * sum(
        f.level != "ok" and (f.level != "note" or bool(f.joints)) for f in findings
    )
