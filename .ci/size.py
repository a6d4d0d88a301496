"""How large gaponet and each sub-package is, and a ratchet: what .ci/size.toml allows may fall, and rises only with
that file.

    python .ci/size.py           a table; exit code 1 where one is larger than allowed
    python .ci/size.py --write   allow what is there now; say in the commit why something rose

Lines: all .py files. Public names: functions and classes of modules, without an underscore; with their
methods and with modules' constants: all names. Floors: modules on the longest way down the imports (of a sub-package:
inside it). Longest: lines of the longest function.
"""

from __future__ import annotations

import ast
import functools
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
LIMITS = ROOT / ".ci" / "size.toml"
COLUMNS = ("lines", "files", "public names", "all names", "floors", "longest")
Function = ast.FunctionDef | ast.AsyncFunctionDef


def imports(tree: ast.AST, modules: set[str]) -> set[str]:
    """Modules among these that a file imports anywhere."""
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {f"{node.module}.{a.name}" for a in node.names} & modules or {node.module}
    return found & modules


def names(body: list[ast.stmt]) -> tuple[int, int]:
    """Functions and classes that a module or class defines for others, and constants."""
    defined = [node.name for node in body if isinstance(node, Function | ast.ClassDef)]
    targets = [t for node in body if isinstance(node, ast.Assign) for t in node.targets]
    targets += [node.target for node in body if isinstance(node, ast.AnnAssign)]
    set_to = [t.id for t in targets if isinstance(t, ast.Name)]
    public, constants = (sum(not name.startswith("_") for name in found) for found in (defined, set_to))
    return public, constants


def measure(part: Path) -> dict[str, int]:
    """The columns of a package."""
    texts = {f: f.read_text(encoding="utf-8") for f in part.rglob("*.py")}
    trees = {
        ".".join(f.relative_to(ROOT / "src").with_suffix("").parts).removesuffix(".__init__"): ast.parse(text)
        for f, text in texts.items()
    }
    edges = {name: imports(tree, trees.keys() - {name, "gaponet"}) for name, tree in trees.items()}

    @functools.cache
    def floor(name: str) -> int:
        return 1 + max(map(floor, edges[name]), default=0)

    functions = [n for tree in trees.values() for n in ast.walk(tree) if isinstance(n, Function)]
    classes = [c for tree in trees.values() for c in tree.body if isinstance(c, ast.ClassDef) and c.name[0] != "_"]
    public, constants = (sum(found) for found in zip(*(names(tree.body) for tree in trees.values()), strict=True))
    methods = sum(names(c.body)[0] for c in classes)
    return {
        "lines": sum(len(text.splitlines()) for text in texts.values()),
        "files": len(texts),
        "public names": public,
        "all names": public + constants + methods,
        "floors": max(map(floor, edges)),
        "longest": max((n.end_lineno or n.lineno) - n.lineno + 1 for n in functions),
    }


def main(write: bool) -> int:
    package = ROOT / "src" / "gaponet"
    parts = sorted(p for p in package.iterdir() if (p / "__init__.py").is_file())
    found = {p.name: measure(p) for p in (package, *parts)}
    allowed = tomllib.loads(LIMITS.read_text()) if LIMITS.is_file() else {}
    print(f"{'':<16}" + "".join(f"{c:>16}" for c in COLUMNS))
    worse = []
    for name, sizes in found.items():
        print(f"{name:<16}" + "".join(f"{sizes[c]:>16,}" for c in COLUMNS))
        limits = allowed.get(name, {})
        worse += [
            f"{name}: {c} {sizes[c]:,}, allowed {limits.get(c, 0):,}" for c in COLUMNS if sizes[c] > limits.get(c, 0)
        ]
    if write:
        text = "# What .ci/size.py allows; a number that rises needs a sentence in its commit.\n"
        for name, sizes in found.items():
            text += f"\n[{name}]\n" + "".join(f'"{c}" = {sizes[c]}\n' for c in COLUMNS)
        LIMITS.write_text(text)
        return 0
    for line in worse:
        print(f"larger than allowed: {line}")
    return bool(worse)


if __name__ == "__main__":
    sys.exit(main("--write" in sys.argv[1:]))
