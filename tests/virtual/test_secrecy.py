"""Nothing that learns, corrects, commands or measures may look at the hidden physics."""

import ast
from pathlib import Path

import pytest

import gaponet

PACKAGE = Path(gaponet.__file__).parent
# __init__.py only names what users import
OPEN = (
    "virtual",
    "experiments",
    "api",
    "cli",
    "__init__.py",
    "__pycache__",
)
BLIND = [p for p in PACKAGE.iterdir() if p.name not in OPEN]


@pytest.fixture(scope="module")
def trees():
    """Nodes of every module that must not see the hidden physics, by file."""
    files = [
        f
        for place in BLIND
        for f in ([place] if place.is_file() else place.rglob("*.py"))
        if f.suffix == ".py"
    ]
    return {file: list(ast.walk(ast.parse(file.read_text(encoding="utf-8")))) for file in files}


def imported(nodes):
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (a.name for a in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{a.name}" for a in node.names)


def test_no_blind_module_imports_the_virtual_robots(trees):
    assert len(trees) > 150
    for file, nodes in trees.items():
        for name in imported(nodes):
            assert not name.startswith("gaponet.virtual"), f"{file} imports {name}"


def test_no_blind_module_names_the_fleet_files(trees):
    for file, nodes in trees.items():
        for node in nodes:
            if (
                isinstance(node, ast.Constant)
                and isinstance(node.value, str)
                and "\n" not in node.value
            ):
                assert "fleets" not in node.value, file
                assert "gaponet.virtual" not in node.value, file
