"""The one helper file of an export: modules of gaponet joined into one that needs no gaponet."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gaponet.base.arrays import array_module
from gaponet.robot.servo_fields import SERVO_TERMS
from gaponet.sim import servo

SHIPPED = Path(__file__).parent / "shipped"
MUJOCO_HELPER = "mujoco_servos"
TORCH_HELPER = "gaponet_action"
# Helper → modules of SHIPPED that it consists of, beside the servo model; the last one gives its
# docstring.
MODULES: dict[str, tuple[str, ...]] = {
    MUJOCO_HELPER: ("mujoco_servos",),
    TORCH_HELPER: (
        "mujoco_servos",
        "scene_facts",
        "unit_events",
        "mjlab_servos",
        "gaponet_action",
    ),
}
SERVO_MODEL: tuple[Callable[..., Any], ...] = (
    array_module,
    servo.present,
    servo.exp,
    servo.torque_range,
    servo.passing_friction,
    servo.resting_friction,
    servo.friction_limit,
    servo.servo_torque,
    servo.servo_bias,
    servo.crossed,
    servo.Play,
)
SERVO_MODEL_IMPORTS = {
    "from importlib import import_module",
    "from typing import Any",
    "import numpy as np",
}
SECTION = "\n\n# ---- {}\n\n\n"


def helper_text(helper: str) -> str:
    """Return the text of a helper, one of MODULES."""
    imports = set(SERVO_MODEL_IMPORTS)
    sections = [SECTION.format("servo model, numpy or torch") + _servo_model()]
    docstring = ""
    for name in MODULES[helper]:
        text = (SHIPPED / f"{name}.py").read_text(encoding="utf-8")
        docstring, own_imports, body = _parts(text)
        imports |= own_imports
        sections.append(SECTION.format(name.replace("_", " ")) + body)
    head = f'"""{docstring}"""\n\nfrom __future__ import annotations\n\n'
    return head + "\n".join(sorted(imports)) + "\n" + "".join(sections)


def without_gaponet(text: str, helper: str) -> str:
    """Return the text of a module whose imports from gaponet are imports from the helper."""
    lines = text.splitlines(keepends=True)
    for node in ast.parse(text).body:
        if isinstance(node, ast.ImportFrom) and _is_own(node):
            old = f"from {node.module} import"
            lines[node.lineno - 1] = lines[node.lineno - 1].replace(old, f"from {helper} import")
    return "".join(lines)


def _is_own(node: ast.ImportFrom) -> bool:
    return (node.module or "").split(".")[0] == "gaponet"


def _servo_model() -> str:
    """Return constants and functions of the servo model."""
    constants = [
        f"SERVO_TERMS = {SERVO_TERMS}",
        "ServoTerms = dict[str, Any]  # name of a term → values that broadcast to the joints",
        f"SLOWEST = {servo.SLOWEST}  # rad/s, of stribeck_speed",
        f"FINEST = {servo.FINEST}  # rad, of encoder_step",
        f"DEADBAND_STEPS = {servo.DEADBAND_STEPS}",
        f"OPENED = {servo.OPENED}",
    ]
    functions = [inspect.getsource(function) for function in SERVO_MODEL]
    return "\n".join(constants) + "\n\n\n" + "\n\n".join(functions)


def _parts(text: str) -> tuple[str, set[str], str]:
    """Return docstring, imports from elsewhere, and what follows the imports."""
    tree = ast.parse(text)
    imports = set()
    last_line = 0
    for node in tree.body:
        if not isinstance(node, ast.Import | ast.ImportFrom):
            continue
        last_line = node.end_lineno or node.lineno
        if isinstance(node, ast.ImportFrom) and (_is_own(node) or node.module == "__future__"):
            continue
        imports.add(ast.unparse(node))
    body = "".join(text.splitlines(keepends=True)[last_line:]).strip("\n") + "\n"
    return ast.get_docstring(tree, clean=False) or "", imports, body
