"""The tutorial on policies: recorded, identified, learnt three times and played on a VIRTUAL
robot.
"""

import re
import subprocess
import sys
from pathlib import Path

import pytest

FILE = Path(__file__).parents[2] / "examples" / "policy_transfer.py"


@pytest.mark.slow  # tests/cli/test_replay.py has what replay says
def test_the_tutorial_ends_in_a_table_and_in_what_replay_had_forecast(tmp_path):
    said = subprocess.run(
        [sys.executable, FILE, tmp_path, "--quick"], capture_output=True, text=True, check=True
    )
    assert "WARNING" not in said.stderr + said.stdout  # of MuJoCo about a state that is no number
    rows = re.findall(r"^\| (\S.*?) \| ([\d.]+) ± [\d.]+ \| ([\d.]+) ±", said.stdout, re.MULTILINE)
    assert [name for name, *_ in rows] == [
        "reference as target",
        "nominal",
        "identified",
        "identified + units",
    ]
    own, real = ({name: float(x[i]) for name, *x in rows} for i in (0, 1))
    assert own["nominal"] < 0.7 * real["nominal"]  # the nominal simulator flatters
    assert 0.7 < own["identified"] / real["identified"] < 1.4  # the identified one does not
    apart, forecast, inside = re.search(
        r"is ([\d.]+) mrad from the rollout; gaponet replay said so to ([\d.]+) mrad, (\d+)%",
        said.stdout,
    ).groups()
    assert float(forecast) < 0.3 * float(apart)
    assert int(inside) > 80
