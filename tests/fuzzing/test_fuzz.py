"""A slice of make fuzz: changed files end in one clear error, or in data that a robot can have
recorded.
"""

import json
import os
import subprocess
import sys

import pytest

from fuzzing.__main__ import GROUPS, replay
from fuzzing.harness import WHY
from fuzzing.readers import TARGETS

MUTANTS = 5  # of each reader


@pytest.mark.parametrize("group", GROUPS)
def test_changed_files_end_in_one_clear_error_or_in_sane_data(group, tmp_path):
    """In a process of its own: its workers are forks, which must not inherit threads of what was
    tested before.
    """
    mutants = MUTANTS * len(GROUPS[group])
    command = [
        sys.executable,
        "-m",
        "fuzzing",
        "--only",
        group,
        "--mutants",
        str(mutants),
        "--seed",
        "7",
    ]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [*command, "--keep", str(tmp_path)], capture_output=True, text=True, env=environment
    )
    assert done.stdout, done.stderr
    found = json.loads(done.stdout)
    assert (done.returncode, found["failures"]) == (0, {}), done.stderr
    assert found["mutants"] > 0.9 * mutants
    assert found["refused"] > found["mutants"] / 3


@pytest.mark.parametrize(
    ("content", "printed"), [(None, "taken"), (b"time,ctrl.elbow\n0,x\n", "refused: ")]
)
def test_a_stored_mutant_is_read_again_without_the_file_that_explains_it(
    tmp_path, capsys, content, printed
):
    table = next(t for t in TARGETS if t.name == "table")
    case = tmp_path / "traceback-table-7"
    case.mkdir()
    for name, untouched in table.files().items():
        (case / name).write_bytes(content or untouched)
    (case / WHY).write_text("no table")
    assert replay(case) == 0
    assert capsys.readouterr().out.startswith(printed)
