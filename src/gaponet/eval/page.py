"""The pieces of an offline HTML page: style, tables, figures inside it."""

from __future__ import annotations

import base64
import io
from typing import TYPE_CHECKING

from markupsafe import Markup, escape

from gaponet.text import plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CSS = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1a1a1a; max-width: 1080px; margin: 2rem auto; padding: 0 1rem }
h1 { font-size: 1.7rem; margin-bottom: .2rem }
h2 { font-size: 1.2rem; margin-top: 2.2rem; border-bottom: 1px solid #ddd }
table { border-collapse: collapse; margin: .6rem 0 }
th, td { padding: .25rem .7rem; text-align: right; border-bottom: 1px solid #eee }
th { background: #fafafa }
th:first-child, td:first-child, .facts td { text-align: left; vertical-align: top }
td + td { white-space: nowrap }
.facts td + td { white-space: normal }
.facts td:first-child { color: #666; white-space: nowrap }
tr.best td { font-weight: 600 }
.tag { display: inline-block; padding: .1rem .6rem; border-radius: 1rem; color: #fff; font: 600 .85rem system-ui }
.real { background: #1b7f3b }
.virtual { background: #7b3fa0 }
.warn { background: #fff4e0; border-left: 4px solid #d99000; padding: .4rem .8rem; margin: .3rem 0 }
.lead { font-size: 1.1rem }
.row { display: flex; flex-wrap: wrap; gap: 1rem }
figure { margin: 1rem 0 }
figcaption { color: #666; font-size: .88rem }
svg, img { max-width: 100%; height: auto }
code { background: #f4f4f4; padding: 0 .25rem }
"""


def element(name: str, *content: str, css: str = "") -> Markup:
    """One element of a page. Content that is not Markup is text, whatever it holds: this is where it is escaped."""
    inside = Markup("").join(c if isinstance(c, Markup) else escape(plain(c)) for c in content)
    kind = Markup(' class="{}"').format(css) if css else ""
    return Markup("<{0}{1}>{2}</{0}>").format(name, kind, inside)


def page(title: str, body: Markup) -> str:
    """A whole document."""
    head = Markup('<meta charset="utf-8">') + element("title", title) + element("style", Markup(CSS))
    inside = element("head", head) + element("body", body)
    return Markup('<!doctype html><html lang="en">{}</html>\n').format(inside)


def facts_table(rows: list[list[str]]) -> Markup:
    """Name and value in each row."""
    return element("table", *(element("tr", *(element("td", c) for c in row)) for row in rows), css="facts")


def table(head: list[str], rows: list[list[str]], best: int | None = None) -> Markup:
    """The first column is text, the others are numbers; the row of the best in bold."""
    body = (
        element("tr", *(element("td", c) for c in row), css="best" if i == best else "") for i, row in enumerate(rows)
    )
    return element("table", element("tr", *(element("th", h) for h in head)), *body)


def tag(virtual: bool) -> Markup:
    """Whose numbers these are."""
    name = "virtual" if virtual else "real"
    return element("span", "VIRTUAL robot" if virtual else "real robot", css=f"tag {name}")


def figure(fig: Figure, *caption: str) -> Markup:
    """Inline SVG where it is small, PNG where a plot has many points."""
    buffer = io.BytesIO()
    fig.savefig(buffer, format="svg")
    data = buffer.getvalue().decode()
    if len(data) > 400_000:
        buffer = io.BytesIO()
        fig.savefig(buffer, format="png", dpi=150)
        image = picture(buffer.getvalue(), "image/png")
    else:
        image = Markup(data[data.index("<svg") :])
    return element("figure", image, element("figcaption", *caption))


def picture(data: bytes, kind: str) -> Markup:
    """A picture inside the page; a script in somebody's SVG does not run there."""
    return Markup('<img src="data:{};base64,{}">').format(kind, base64.b64encode(data).decode())
