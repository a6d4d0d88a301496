"""Nothing that learns, corrects, deploys or measures may look at the hidden physics."""

import ast
from pathlib import Path

import gaponet

SOURCE = Path(gaponet.__file__).parent
ROBOTS = ("virtual.py", "so101_virtual.py", "unitree_virtual.py")  # deploy/drivers: the robots themselves, on a bus
BLIND = ("train", "model", "eval", "deploy", "data", "sim", "motion", "gap.py", "robot.py")


def files():
    for name in BLIND:
        path = SOURCE / name
        found = [path] if path.suffix == ".py" and path.is_file() else path.rglob("*.py")
        yield from (f for f in found if not (f.parent == SOURCE / "deploy" / "drivers" and f.name in ROBOTS))


def imported(tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (a.name for a in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{a.name}" for a in node.names)


def test_no_learning_or_measuring_module_imports_the_virtual_robots():
    seen = 0
    for file in files():
        seen += 1
        for name in imported(ast.parse(file.read_text(encoding="utf-8"))):
            assert not name.startswith("gaponet.virtual"), f"{file} imports {name}"
    assert seen > 20


def test_only_what_opens_a_driver_knows_the_virtual_ones():
    for file in files():
        known = [n for n in imported(ast.parse(file.read_text(encoding="utf-8"))) if "drivers" in n and "virtual" in n]
        assert not known or file == SOURCE / "deploy" / "drivers" / "open.py", f"{file} imports {known}"


def test_no_learning_or_measuring_module_names_the_fleet_files():
    for file in files():
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and "\n" not in node.value:
                assert "fleets" not in node.value, file
                assert "gaponet.virtual" not in node.value, file
