"""Offline HTML pages from the Jinja2 templates in report/templates.

Figures are part of the page.
"""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from gaponet.base.text import escape

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# inches; a wider figure scrolls on a phone, so that its letters stay readable
MAX_FITTING_WIDTH = 6.0
MAX_SVG_CHARACTERS = 400_000  # a figure with more becomes a PNG


@dataclass(frozen=True)
class PageFigure:
    """A figure of a page: image, classes of its box, caption, title in bold before the caption."""

    image: Markup
    css: str
    caption: str
    title: str = ""


def render(template: str, **values: Any) -> str:
    """Render a template of report/templates. Values are escaped unless they are Markup."""
    return _environment().get_template(template).render(**values)


@cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("gaponet.report"),
        autoescape=True,
        finalize=_printable,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def _printable(value: Any) -> Any:
    """Escape control characters of texts."""
    return escape(value) if isinstance(value, str) and not isinstance(value, Markup) else value


def page_figure(fig: Figure, caption: str, title: str = "") -> PageFigure:
    """Return a figure as inline SVG, or as PNG where the SVG is large."""
    buffer = io.BytesIO()
    fig.savefig(buffer, format="svg")
    svg = buffer.getvalue().decode()
    if len(svg) > MAX_SVG_CHARACTERS:
        buffer = io.BytesIO()
        fig.savefig(buffer, format="png", dpi=150)
        image = inline_image(buffer.getvalue(), "image/png")
    else:
        image = Markup(svg[svg.index("<svg") :])
    css = "plot scroll wide" if fig.get_figwidth() > MAX_FITTING_WIDTH else "plot"
    return PageFigure(image, css, caption, title)


def inline_image(data: bytes, mime_type: str) -> Markup:
    """Return an img element that contains the image. Scripts of an SVG do not run in it."""
    return Markup('<img src="data:{};base64,{}">').format(
        mime_type, base64.b64encode(data).decode()
    )
