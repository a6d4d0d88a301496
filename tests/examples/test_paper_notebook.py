"""The notebook of the paper runs from its first cell to its last, on a smaller robot and with tiny trainings."""

import gc
import re
import warnings
from pathlib import Path

import nbformat
import pytest

pytest.importorskip("ipykernel")
from jupyter_client import AsyncKernelManager
from nbclient import NotebookClient

FILE = Path(__file__).parents[2] / "examples" / "paper.ipynb"
RECIPE = """
motions = ["tour-all-*", "multisine-shoulder_pan", "multisine-elbow_flex"]
payloads = [0.0, 0.2]
units = ["virtual-1"]
rates = [50]
variants = 2
"""
BEFORE = f"""
import sys
from concurrent.futures import ThreadPoolExecutor

sys.path.insert(0, {str(Path(__file__).parents[1])!r})
from short_experiment import shorten

shorten()
"""


def test_the_notebook_goes_from_recordings_to_figure_3(tmp_path, tmp_path_factory, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    kernel = AsyncKernelManager(
        kernel_name="python3", transport="ipc", ip=str(tmp_path_factory.mktemp("k") / "s")
    )
    recipe = tmp_path / "recipe.toml"
    recipe.write_text(RECIPE)
    smaller = {
        'robot="h1_2"': 'robot="so101"',
        'recipe="demo"': f'recipe="{recipe}"',
        "seeds=1": 'quick=True, methods=("GAPONet",), executor=ThreadPoolExecutor(1)',
    }
    notebook = nbformat.read(FILE, 4)
    for cell in notebook.cells:
        for text, replacement in smaller.items():
            cell.source = cell.source.replace(text, replacement)
    notebook.cells.insert(0, nbformat.v4.new_code_cell(BEFORE))
    NotebookClient(notebook, timeout=600, km=kernel).execute()
    with warnings.catch_warnings(action="ignore", category=ResourceWarning):
        gc.collect()  # jupyter_client leaves sockets open
    outputs = [out for cell in notebook.cells for out in cell.get("outputs", ())]
    assert any("image/svg+xml" in out.get("data", {}) for out in outputs)


def test_the_notebook_as_it_is_kept_names_no_place_of_the_machine_that_made_it():
    assert not re.search(r"/(tmp|home|work|root)/", FILE.read_text(encoding="utf-8"))
