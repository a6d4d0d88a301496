"""A slice of make fuzz: changed files end in one clear error, or in data that a robot can have recorded."""

import json
import os
import subprocess
import sys

import pytest

from fuzzing.__main__ import GROUPS


@pytest.mark.parametrize("group", GROUPS)
def test_changed_files_end_in_one_clear_error_or_in_sane_data(group, tmp_path):
    """In a process of its own: its workers are forks, which must not inherit threads of what was tested before."""
    mutants = 25 * len(GROUPS[group])
    command = [sys.executable, "-m", "fuzzing", "--only", group, "--mutants", str(mutants), "--seed", "7"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    done = subprocess.run([*command, "--keep", str(tmp_path)], capture_output=True, text=True, env=environment)
    assert done.stdout, done.stderr
    found = json.loads(done.stdout)
    assert (done.returncode, found["failures"]) == (0, {}), done.stderr
    assert found["mutants"] > 0.9 * mutants
    assert found["refused"] > found["mutants"] / 3
