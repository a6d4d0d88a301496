"""A slice of make fuzz: changed files end in one clear error, or in data that a robot can have recorded."""

import pytest

from fuzzing import readers, structures
from fuzzing.harness import run


@pytest.mark.parametrize("target", [*readers.TARGETS, *structures.TARGETS], ids=lambda t: t.name)
def test_changed_files_end_in_one_clear_error_or_in_sane_data(target, tmp_path):
    result = run([target], 60, seed=7, keep=tmp_path)
    assert [f"{f.target} {f.number} {f.kind}: {f.text[-300:]}" for f in result.failures] == []
    assert result.mutants == 60
    assert result.refused > 20
