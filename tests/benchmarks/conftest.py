"""Scripts of the folder benchmarks as modules."""

import importlib
from pathlib import Path

import pytest


@pytest.fixture
def load(monkeypatch):
    """load(name): import a script."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    return importlib.import_module
