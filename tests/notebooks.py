"""Notebooks of examples/, run in this process: their kernel would import everything again."""

from __future__ import annotations

import atexit
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

from IPython.core.interactiveshell import InteractiveShell
from IPython.utils.capture import capture_output
from traitlets.config import Config


@dataclass
class Shown:
    """What the cells of a notebook showed.

    Attributes:
        text: What was printed, and the last value of each cell.
        kinds: MIME types of what was displayed.
    """

    text: str = ""
    kinds: set[str] = field(default_factory=set)


def code_cells(file: Path) -> list[dict[str, Any]]:
    """Code cells of a notebook, as its file has them."""
    cells = json.loads(file.read_text(encoding="utf-8"))["cells"]
    return [cell for cell in cells if cell["cell_type"] == "code"]


def run_notebook(file: Path, replacements: dict[str, str]) -> Shown:
    """Run the code cells of a notebook from the first to the last.

    Args:
        replacements: Text in a cell → what stands there instead, for a quicker run.

    Raises:
        AssertionError: A text to be replaced is in no cell.
        Exception: What a cell raised.
    """
    cells = ["".join(cell["source"]) for cell in code_cells(file)]
    for text, replacement in replacements.items():
        assert any(text in cell for cell in cells), text
        cells = [cell.replace(text, replacement) for cell in cells]
    shown = Shown()
    with _shell() as shell:
        for cell in cells:
            with capture_output() as captured:
                result = shell.run_cell(cell)
            result.raise_error()
            shown.text += captured.stdout + f"{result.result}\n"
            for output in captured.outputs:
                shown.kinds |= output.data.keys()
    return shown


@contextmanager
def _shell() -> Iterator[Any]:
    """A shell of IPython without history, whose names are its own."""
    config = Config()
    config.HistoryManager.enabled = False
    shell = InteractiveShell.instance(config=config, user_module=ModuleType("notebook"))
    try:
        yield shell
    finally:
        atexit.unregister(shell.atexit_operations)
        InteractiveShell.clear_instance()
