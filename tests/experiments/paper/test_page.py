"""The page of the experiment."""

from __future__ import annotations

from pathlib import Path

from gaponet.experiments.paper import page

PACKAGE = Path(page.__file__).parent
ROOT = Path(__file__).parents[3]


def test_the_diagram_of_the_documentation_is_that_of_the_page() -> None:
    of_page = (PACKAGE / "figure1.svg").read_text("utf-8")
    of_documentation = (ROOT / "docs" / "assets" / "gaponet_diagram.svg").read_text("utf-8")

    assert of_page == of_documentation
