"""Draw which sub-package imports which, from the code, into docs/architecture.md.

    python benchmarks/architecture_map.py

An arrow leads from a sub-package to one that it imports. Arrows that follow from others are left
out.
"""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "gaponet"
PAGE = ROOT / "docs" / "architecture.md"
BEGIN = "<!-- map: python benchmarks/architecture_map.py -->\n"
END = "<!-- end of the map -->\n"

Imports = dict[str, set[str]]  # sub-package → sub-packages that it imports


def imports_of(file: Path) -> set[str]:
    """Return the sub-packages of gaponet that a file imports, in functions too."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        for name in _imported(node):
            package, _, rest = name.partition(".")
            if package == "gaponet" and rest:
                found.add(rest.split(".")[0])
    return found


def _imported(node: ast.AST) -> list[str]:
    """Return the modules, or names of modules, that a statement imports."""
    if isinstance(node, ast.ImportFrom):
        return [f"{node.module}.{alias.name}" for alias in node.names]
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    return []


def read_imports(package: Path = PACKAGE) -> Imports:
    """Return the imports between the sub-packages of a package."""
    folders = {folder.name: folder for folder in package.iterdir() if any(folder.glob("*.py"))}
    imports: Imports = {}
    for name, folder in folders.items():
        imported: set[str] = set()
        for file in folder.rglob("*.py"):
            imported |= imports_of(file)
        imports[name] = (imported & folders.keys()) - {name}
    return imports


def reachable(imports: Imports, start: str) -> set[str]:
    """Return what a sub-package imports, directly or through others."""
    found: set[str] = set()
    waiting = list(imports[start])
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting += imports[name]
    return found


def without_shortcuts(imports: Imports) -> Imports:
    """Return the imports that do not follow from others."""
    needed: Imports = {}
    for name, imported in imports.items():
        through_others: set[str] = set()
        for other in imported:
            through_others |= reachable(imports, other)
        needed[name] = imported - through_others
    return needed


def draw(imports: Imports) -> str:
    """Return the drawing as a block of Mermaid, the top of the house first."""
    height = {name: len(reachable(imports, name)) for name in imports}
    lines = ["```mermaid", "graph TD"]
    for name in sorted(imports, key=lambda n: (-height[n], n)):
        for other in sorted(without_shortcuts(imports)[name]):
            lines.append(f"    {name} --> {other}")
    return "\n".join([*lines, "```", ""])


def write_map(page: Path = PAGE) -> None:
    """Put the drawing between its marks on the page."""
    text = page.read_text(encoding="utf-8")
    before, _, rest = text.partition(BEGIN)
    after = rest.partition(END)[2]
    page.write_text(before + BEGIN + draw(read_imports()) + END + after, encoding="utf-8")


if __name__ == "__main__":
    write_map()
