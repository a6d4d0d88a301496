"""The helper file of an export: one file, which needs no gaponet and defines every name once."""

import ast
import subprocess
import sys

import pytest

from gaponet.export.helper_file import MODULES, SHIPPED, helper_text


def defined_names(text: str) -> list[str]:
    """Return the names that a module binds at its top level, in order, as often as it does."""
    names = []
    for node in ast.parse(text).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.append(node.name)
        if isinstance(node, ast.Assign):
            for part in ast.walk(node):
                if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store):
                    names.append(part.id)
    return names


@pytest.mark.parametrize("helper", MODULES)
def test_a_helper_defines_every_name_once(helper):
    names = defined_names(helper_text(helper))
    assert len(names) > 20
    assert sorted(names) == sorted(set(names))


@pytest.mark.parametrize("helper", MODULES)
def test_a_helper_imports_where_there_is_no_gaponet(helper, tmp_path):
    if helper == "gaponet_action":
        pytest.importorskip("torch")
    (tmp_path / f"{helper}.py").write_text(helper_text(helper), encoding="utf-8")
    forbid = "import sys; sys.modules['gaponet'] = None; "
    names = "Servos, Check, fill_delays, friction_limit, servo_bias"
    code = f"{forbid}from {helper} import {names}; print(Servos.__module__)"

    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )

    assert done.stdout.strip() == helper


@pytest.mark.parametrize("file", sorted(SHIPPED.glob("*.py")), ids=lambda file: file.stem)
def test_each_command_and_statement_to_copy_has_a_line_of_its_own(file):
    docstring = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or ""
    for line in docstring.splitlines():
        if "python check.py" in line or "--out" in line:
            assert line.lstrip().startswith(("python", "gaponet"))
