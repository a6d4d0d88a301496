"""Nothing that learns, corrects, commands or measures may look at the hidden physics."""

import ast
from pathlib import Path

import pytest

import gaponet

PACKAGE = Path(gaponet.__file__).parent
# __init__.py only names what users import
OPEN = ("virtual", "experiments", "api", "cli", "__init__.py", "__pycache__")
BLIND = [p for p in PACKAGE.iterdir() if p.name not in OPEN]


@pytest.fixture(scope="module")
def files():
    """Every module that must not see the hidden physics."""
    found = []
    for place in BLIND:
        found += [place] if place.suffix == ".py" else place.rglob("*.py")
    return found


def nodes(file, word):
    """What a module is made of; nothing if a word is nowhere in its text."""
    text = file.read_text(encoding="utf-8")
    return ast.walk(ast.parse(text)) if word in text else ()


def imported(file):
    """Names that a module imports from somewhere that has `virtual` in its name."""
    for node in nodes(file, "virtual"):
        if isinstance(node, ast.Import):
            yield from (a.name for a in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{a.name}" for a in node.names)


def named(file, word):
    """Texts of one line in a module that hold a word."""
    for node in nodes(file, word):
        text = node.value if isinstance(node, ast.Constant) else None
        if isinstance(text, str) and word in text and "\n" not in text:
            yield text


def test_no_blind_module_imports_the_virtual_robots(files):
    assert len(files) > 150
    for file in files:
        for name in imported(file):
            assert not name.startswith("gaponet.virtual"), f"{file} imports {name}"


@pytest.mark.parametrize("word", ["fleets", "gaponet.virtual"])
def test_no_blind_module_names_the_fleet_files(files, word):
    assert {str(file) for file in files if list(named(file, word))} == set()
