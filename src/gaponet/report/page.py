"""The pieces of an offline HTML page: style, tables, figures inside it."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from typing import TYPE_CHECKING

from markupsafe import Markup, escape

from gaponet.base.text import escape as one_line

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDE = 6.0  # inches; a figure that is wider scrolls on a phone, since its letters could not be read

CSS = """
:root { color-scheme: light dark; --ink: #1a1a1a; --paper: #fff; --faint: #666; --line: #e3e3e3; --tint: #f5f5f5;
  --warn: #fff4e0 }
* { box-sizing: border-box }
body { font: 15px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper); max-width: 1080px;
  margin: 2rem auto; padding: 0 1rem; overflow-wrap: break-word }
h1 { font-size: 1.7rem; line-height: 1.25; margin-bottom: .4rem }
h2 { font-size: 1.2rem; margin-top: 2.4rem; border-bottom: 1px solid var(--line) }
table { border-collapse: collapse; margin: .6rem 0 }
th, td { padding: .25rem .7rem; text-align: right; border-bottom: 1px solid var(--line) }
th { background: var(--tint) }
th:first-child, td:first-child, .facts td { text-align: left; vertical-align: top }
td + td { white-space: nowrap }
.facts td + td { white-space: normal; overflow-wrap: anywhere }
.facts td:first-child { color: var(--faint); white-space: nowrap }
tr.best td { font-weight: 600 }
.tag { display: inline-block; padding: .1rem .6rem; border-radius: 1rem; color: #fff; font: 600 .85rem system-ui }
.real { background: #1b7f3b }
.virtual { background: #7b3fa0 }
.warn { background: var(--warn); border-left: 4px solid #d99000; padding: .4rem .8rem; margin: .3rem 0 }
.lead { font-size: 1.15rem }
.faint { color: var(--faint) }
.row { display: flex; flex-wrap: wrap; gap: 0 1.5rem; align-items: flex-start }
.row > * { max-width: 100% }
.scroll { overflow-x: auto }
figure { margin: 1rem 0; max-width: 100% }
figcaption, .small { color: var(--faint); font-size: .88rem }
svg, img { display: block; max-width: 100%; height: auto }
.wide > svg, .wide > img { min-width: 720px }
.photo img { border-radius: 6px; max-width: min(100%, 700px) }
code { background: var(--tint); padding: 0 .25rem; overflow-wrap: anywhere }
summary { cursor: pointer; color: var(--faint); margin: .6rem 0 }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e4e4e4; --paper: #171717; --faint: #9d9d9d; --line: #383838; --tint: #242424; --warn: #3a2c10 }
  .plot > * { filter: invert(.91) hue-rotate(180deg) }
}
@media (max-width: 600px) { body { margin: 1rem auto; font-size: 14px } th, td { padding: .2rem .45rem } }
"""


def element(name: str, *content: str, css: str = "") -> Markup:
    """Make one element of a page. Content that is not Markup is text, whatever it holds, and is escaped here."""
    inside = Markup("").join(c if isinstance(c, Markup) else escape(one_line(c)) for c in content)
    kind = Markup(' class="{}"').format(css) if css else ""
    return Markup("<{0}{1}>{2}</{0}>").format(name, kind, inside)


def page(title: str, body: Markup) -> str:
    head = (
        Markup('<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">')
        + element("title", title)
        + element("style", Markup(CSS))
    )
    inside = element("head", head) + element("body", body)
    return Markup('<!doctype html><html lang="en">{}</html>\n').format(inside)


def facts_table(rows: list[list[str]]) -> Markup:
    return element("table", *(element("tr", *(element("td", c) for c in row)) for row in rows), css="facts")


def table(head: Sequence[str], rows: list[list[str]], best: int | None = None) -> Markup:
    """The first column is text, the others are numbers; the row of the best in bold."""
    body = (
        element("tr", *(element("td", c) for c in row), css="best" if i == best else "") for i, row in enumerate(rows)
    )
    inside = element("table", element("tr", *(element("th", h) for h in head)), *body)
    return element("div", inside, css="scroll")


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
    css = "plot scroll wide" if fig.get_figwidth() > WIDE else "plot"
    return element("figure", element("div", image, css=css), element("figcaption", *caption))


def picture(data: bytes, kind: str) -> Markup:
    """A picture inside the page; a script in somebody's SVG does not run there."""
    return Markup('<img src="data:{};base64,{}">').format(kind, base64.b64encode(data).decode())
