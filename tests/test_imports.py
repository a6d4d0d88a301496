"""The house: what is loaded when, and which way imports go."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import gaponet

SOURCE = Path(gaponet.__file__).parents[1]
# Part → the parts that it may import from. The core knows no other by name: it asks gaponet.parts.
PARTS = {
    "gaponet": {"gaponet"}, "gaponet_robots": {"gaponet", "gaponet_robots"},
    "gaponet_interop": {"gaponet", "gaponet_interop"}, "gaponet_lab": {"gaponet", "gaponet_robots", "gaponet_lab"},
}  # fmt: skip
# Within a part a module may import from its own rank or a lower one, also inside functions. The ground floor: all
# modules of the part's top folder that are not named here, and process/.
RANKS = {
    "gaponet": [
        {"data"}, {"metrics"}, {"sim"}, {"model"}, {"training", "deploy"}, {"eval"}, {"api"}, {"cli"},
    ],
    "gaponet_robots": [{"motion"}, {"control", "drivers", "targets", "virtual"}, {"cli"}],
    "gaponet_interop": [{"formats", "writers", "engine", "setup"}, {"share"}, {"cli"}],
    "gaponet_lab": [{"plot"}, {"view", "report", "bench", "real", "known"}, {"study"}, {"cli"}],
}  # fmt: skip
HEAVY = ("mujoco", "torch", "pyarrow", "scipy", "rich", "tyro", "matplotlib", "onnxruntime", "rsl_rl", "pydantic")
MODULES = {
    ".".join(file.relative_to(SOURCE).with_suffix("").parts).removesuffix(".__init__"): file
    for part in PARTS
    for file in (SOURCE / part).rglob("*.py")
}
MOST = {"gaponet": 19, "sim": 17}  # files in a folder; 16 in all others


def rank(module: str) -> int:
    part, name = module.split(".")[:2]
    ranks = RANKS[part]
    assert (SOURCE / part / f"{name}.py").is_file() or name in {"process"}.union(*ranks), f"{module} has no rank"
    return next((i for i, names in enumerate(ranks, 1) if name in names), 0)


def top_level_imports(tree: ast.Module) -> list[str]:
    return [n.module for n in tree.body if isinstance(n, ast.ImportFrom) and n.module]


def imported(file: Path) -> set[str]:
    """Modules of gaponet that a file imports anywhere, in functions and for types too."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {f"{node.module}.{a.name}" for a in node.names} & MODULES.keys() or {node.module}
    return found & MODULES.keys()


def circle(edges: dict[str, set[str]]) -> list[str]:
    """A circle of imports, or nothing."""
    done, way = set(), []

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
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.strip() == "[]"


def test_imports_go_one_way():
    for name, file in MODULES.items():
        if name.split(".")[1:2] in ([], ["__main__"]):
            continue
        part = name.split(".")[0]
        for other in imported(file) - PARTS.keys():
            of = other.split(".")[0]
            assert of in PARTS[part], f"{file} imports {other} of a part that may be missing"
            assert of != part or rank(other) <= rank(name), f"{file} imports {other}"


def test_what_the_parts_offer_is_there():
    for part in sorted(PARTS.keys() - {"gaponet"}):
        tables = {k: v for k, v in vars(importlib.import_module(part)).items() if k.isupper()}
        assert tables
        for where in (where for table in tables.values() for where in table.values()):
            module, _, name = where.partition(":")
            tree = ast.parse(MODULES[module].read_text(encoding="utf-8"))
            assert not name or name in {n.name for n in tree.body if isinstance(n, ast.FunctionDef | ast.ClassDef)}, (
                where
            )


def test_no_module_imports_one_that_imports_it_not_even_in_a_function():
    assert circle({name: imported(file) for name, file in MODULES.items()}) == []


def test_a_circle_is_found_and_a_diamond_is_none():
    assert circle({"a": {"b", "c"}, "b": {"d"}, "c": {"d"}, "d": set()}) == []
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c"]


def test_no_folder_is_more_than_a_newcomer_can_hold():
    for folder in {file.parent for file in MODULES.values()}:
        files = [f for f in folder.glob("*.py") if f.name != "__init__.py"]
        assert len(files) <= MOST.get(folder.name, 16), f"{folder}: {len(files)} files"


def test_torch_is_imported_only_where_networks_live():
    allowed = {f"gaponet/model/{name}.py" for name in ("deeponet", "export", "fuse", "layers", "paper")}
    allowed |= {"gaponet/sim/warp.py"}  # steps on a GPU
    allowed |= {f"gaponet/model/baselines/{name}.py" for name in ("mlp", "transformer")}
    free = ("gaponet/training/", "gaponet_interop/engine/", "gaponet_lab/bench/", "gaponet_lab/study/pool.py")
    for file in MODULES.values():
        place = file.relative_to(SOURCE).as_posix()
        names = top_level_imports(ast.parse(file.read_text(encoding="utf-8")))
        uses = "import torch" in file.read_text(encoding="utf-8") or any(n.split(".")[0] == "rsl_rl" for n in names)
        assert not uses or place in allowed or place.startswith(free), place


def test_what_may_run_on_a_robot_never_imports_training():
    for folder in (
        "gaponet/model",
        "gaponet/deploy",
        "gaponet/eval",
        "gaponet_robots",
        "gaponet_interop",
        "gaponet_lab/view",
    ):
        for file in (SOURCE / folder).rglob("*.py"):
            assert "gaponet.training" not in file.read_text(encoding="utf-8"), file
