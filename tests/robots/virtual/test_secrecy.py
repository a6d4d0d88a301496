"""Nothing that learns, corrects, commands or measures may look at the hidden physics."""

import ast
from pathlib import Path

import gaponet

SOURCE = Path(gaponet.__file__).parents[1]
BLIND = ("gaponet", "gaponet_interop", "gaponet_robots/control", "gaponet_robots/drivers", "gaponet_robots/motion",
         "gaponet_robots/targets")  # fmt: skip
ROBOTS = ("virtual.py", "so101_virtual.py", "unitree_virtual.py")  # in drivers/: the robots themselves, on a bus
OPENER = SOURCE / "gaponet_robots/drivers/open.py"


def trees():
    for file in (f for place in BLIND for f in (SOURCE / place).rglob("*.py")):
        if not (file.parent.name == "drivers" and file.name in ROBOTS):
            yield file, list(ast.walk(ast.parse(file.read_text(encoding="utf-8"))))


def imported(nodes):
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (a.name for a in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{a.name}" for a in node.names)


def test_no_blind_module_imports_the_virtual_robots_and_only_what_opens_a_driver_knows_theirs():
    seen = 0
    for file, nodes in trees():
        seen += 1
        for name in imported(nodes):
            assert not name.startswith("gaponet_robots.virtual"), f"{file} imports {name}"
            assert file == OPENER or not ("drivers" in name and "virtual" in name), f"{file} imports {name}"
    assert seen > 150


def test_no_blind_module_names_the_fleet_files():
    for file, nodes in trees():
        for node in nodes:
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and "\n" not in node.value:
                assert "fleets" not in node.value, file
                assert "gaponet_robots.virtual" not in node.value, file
