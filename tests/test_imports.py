"""The house: what is loaded when, and which way imports go."""

import ast
import subprocess
import sys
from pathlib import Path

import gaponet

SOURCE = Path(gaponet.__file__).parent
# A module may import from its own rank or a lower one.
RANKS = [
    {"errors", "packaged", "robot", "robot_folder", "robot_table", "structure", "mjcf"}, {"data"}, {"gap"}, {"sim"},
    {"motion"}, {"virtual", "collect"}, {"model"}, {"train", "deploy"}, {"eval"}, {"experiment"}, {"cli"},
]  # fmt: skip
HEAVY = ("mujoco", "torch", "pyarrow", "scipy", "rich", "tyro", "matplotlib", "onnxruntime", "rsl_rl", "pydantic")


def rank(module: str) -> int:
    return next(i for i, names in enumerate(RANKS) if module in names)


def top_level_imports(tree: ast.Module) -> list[str]:
    return [n.module for n in tree.body if isinstance(n, ast.ImportFrom) and n.module]


def test_import_gaponet_loads_numpy_alone():
    code = f"import sys, gaponet; print([m for m in {HEAVY!r} if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.strip() == "[]"


def test_imports_go_one_way():
    for file in SOURCE.rglob("*.py"):
        parts = file.relative_to(SOURCE).with_suffix("").parts
        if parts[0] in ("__init__", "__main__"):
            continue
        for name in top_level_imports(ast.parse(file.read_text(encoding="utf-8"))):
            if name.startswith("gaponet.") and name.split(".")[1] in set().union(*RANKS):
                assert rank(name.split(".")[1]) <= rank(parts[0]), f"{file} imports {name}"


def test_nothing_below_the_command_line_imports_it_not_even_in_a_function():
    for file in SOURCE.rglob("*.py"):
        if file.relative_to(SOURCE).parts[0] == "cli":
            continue
        tree = ast.parse(file.read_text(encoding="utf-8"))
        found = [n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and n.module]
        assert not [m for m in found if m.startswith("gaponet.cli")], file


def test_torch_is_imported_only_where_networks_live():
    allowed = {f"model/{name}.py" for name in ("deeponet", "export", "fuse", "layers", "points", "torchscript")}
    allowed |= {f"model/baselines/{name}.py" for name in ("fno", "mlp", "tokens", "transformer")}
    for file in SOURCE.rglob("*.py"):
        place = file.relative_to(SOURCE).as_posix()
        names = top_level_imports(ast.parse(file.read_text(encoding="utf-8")))
        uses = "import torch" in file.read_text(encoding="utf-8") or any(n.split(".")[0] == "rsl_rl" for n in names)
        assert not uses or place in allowed or place.startswith("train/"), place


def test_deploy_and_model_never_import_train():
    for folder in ("model", "deploy", "eval"):
        for file in (SOURCE / folder).rglob("*.py"):
            assert "gaponet.train" not in file.read_text(encoding="utf-8"), file
