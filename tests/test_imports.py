"""The house: what is loaded when, and which way imports go."""

import ast
import functools
import subprocess
import sys
from pathlib import Path

import pytest

import gaponet
from gaponet.cli.main import COMMANDS
from gaponet.data.formats import FORMATS

PACKAGE = Path(gaponet.__file__).parent
# Sub-packages and modules of gaponet. Each may import from itself and from those before it, also
# inside functions.
RANKS = (
    "base", "robot", "data", "sim", "motion", "sysid", "nn", "deploy", "evaluation", "hw",
    "virtual", "report", "share", "export", "experiments", "api", "cli", "__main__",
)  # fmt: skip
# The same within sub-packages: these folders may be imported by those after them, never by what
# lies beside them.
INNER = {
    "nn": ("training",),
    "sysid": ("steps", "evidence"),
    "report": ("figures", "view"),
    "experiments": ("paper",),
}
BESIDE = {"report": {"report"}, "sysid": {"identify"}}  # modules above the folders beside them
HEAVY = (
    "mujoco",
    "torch",
    "pyarrow",
    "scipy",
    "rich",
    "tyro",
    "matplotlib",
    "onnxruntime",
    "rsl_rl",
    "pydantic",
    "numba",
)
MODULES = {
    ".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__"): file
    for file in PACKAGE.rglob("*.py")
}
# files in a folder; 16 in all others. Folders with a module for each command or format may grow.
MOST = {"api": 19, "cli": 31, "data": 17, "export": 17, "formats": 20, "robot": 18}


def rank(module: str) -> int:
    return RANKS.index(module.split(".")[1])


def inner_rank(module: str) -> int:
    """Place of a module in its sub-package: 0 beside the folders of INNER, then in their order,
    then BESIDE.
    """
    _, package, *rest = module.split(".")
    folders = INNER.get(package, ())
    if rest and rest[0] in BESIDE.get(package, ()):
        return len(folders) + 1
    return folders.index(rest[0]) + 1 if rest and rest[0] in folders else 0


def top_level_imports(tree: ast.Module) -> list[str]:
    return [n.module for n in tree.body if isinstance(n, ast.ImportFrom) and n.module]


@functools.cache
def imported(file: Path) -> set[str]:
    """Modules of gaponet that a file imports anywhere, in functions and for types too."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {f"{node.module}.{a.name}" for a in node.names} & MODULES.keys() or {
                node.module
            }
    return found & MODULES.keys()


def circle(edges: dict[str, set[str]]) -> list[str]:
    """A circle of imports, or nothing."""
    done: set[str] = set()
    way: list[str] = []

    def visit(name: str) -> list[str]:
        if name in way:
            return way[way.index(name) :]
        if name in done:
            return []
        way.append(name)
        found = next((c for c in map(visit, sorted(edges.get(name, ()))) if c), [])
        way.pop()
        done.add(name)
        return found

    return next((c for c in map(visit, sorted(edges)) if c), [])


def test_import_gaponet_loads_numpy_alone():
    code = f"import sys, gaponet; print([m for m in {HEAVY!r} if m in sys.modules])"
    out = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout
    assert out.strip() == "[]"


@pytest.mark.parametrize("package", RANKS)
def test_a_sub_package_imports_only_from_itself_and_from_lower_ones(package):
    names = [name for name in MODULES if name.split(".")[1:2] == [package]]
    assert names
    for name in names:
        for other in imported(MODULES[name]) - {"gaponet"}:
            assert rank(other) <= rank(name), f"{name} imports {other}"
            if rank(other) == rank(name):
                assert inner_rank(other) <= inner_rank(name), f"{name} imports {other}"


def test_commands_know_public_functions_and_the_words_for_people_alone():
    for name, file in MODULES.items():
        if name.startswith("gaponet.cli"):
            packages = {other.split(".")[1] for other in imported(file) - {"gaponet"}}
            assert packages <= {"api", "base", "cli", "evaluation", "robot"}, name


def test_every_sub_package_has_a_rank():
    assert {name.split(".")[1] for name in MODULES if "." in name} == set(RANKS)


def test_what_the_tables_of_commands_and_formats_name_is_there():
    homes = {PACKAGE / "data" / "formats" / f"{name}.py" for name in ("npz", "lerobot")}
    assert homes <= {MODULES[where] for where in FORMATS.values()}
    for where in (*COMMANDS.values(), *FORMATS.values()):
        module, _, name = where.partition(":")
        tree = ast.parse(MODULES[module].read_text(encoding="utf-8"))
        functions = {n.name for n in tree.body if isinstance(n, ast.FunctionDef)}
        assert not name or name in functions, where


def test_no_module_imports_one_that_imports_it_not_even_in_a_function():
    edges = {name: imported(file) for name, file in MODULES.items()}
    # It names its public functions for type checkers, and imports them at their first use.
    del edges["gaponet"]
    assert circle(edges) == []


def test_no_folder_is_more_than_a_newcomer_can_hold():
    for folder in {file.parent for file in MODULES.values()}:
        files = [f for f in folder.glob("*.py") if f.name != "__init__.py"]
        assert len(files) <= MOST.get(folder.name, 16), f"{folder}: {len(files)} files"


def test_torch_is_imported_only_where_networks_live():
    allowed = {f"nn/{name}.py" for name in ("layers", "networks", "onnx_export", "paper", "trees")}
    allowed |= {"sim/warp.py"}  # steps on a GPU
    free = ("nn/training/", "export/", "experiments/paper/jobs.py")
    for file in MODULES.values():
        place = file.relative_to(PACKAGE).as_posix()
        text = file.read_text(encoding="utf-8")
        roots = {name.split(".")[0] for name in top_level_imports(ast.parse(text))}
        uses = "import torch" in text or "rsl_rl" in roots
        assert not uses or place in allowed or place.startswith(free), place


def test_what_may_run_on_a_robot_never_imports_training():
    for name, file in MODULES.items():
        part = name.split(".")[1:]
        if part and part[0] not in ("experiments", "api", "cli") and part[:2] != ["nn", "training"]:
            assert "gaponet.nn.training" not in file.read_text(encoding="utf-8"), file


@functools.cache
def names(file: Path) -> set[str]:
    """Names that a module binds at any depth, and its submodules."""
    bound = {inner.stem for inner in file.parent.iterdir()} if file.name == "__init__.py" else set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            bound.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            bound.add(node.id)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            bound |= {(alias.asname or alias.name) for alias in node.names}
    return bound


@pytest.mark.parametrize("folder", ["benchmarks", "examples", "plugins"])
def test_scripts_import_names_that_exist(folder):
    absent = []
    for file in (PACKAGE.parents[1] / folder).rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("gaponet."):
                there = names(MODULES[node.module]) if node.module in MODULES else set()
                absent += [
                    f"{file.name}: {node.module}.{a.name}"
                    for a in node.names
                    if a.name not in there
                ]
    assert absent == []
