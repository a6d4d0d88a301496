"""The pieces of an offline HTML page: style, tables, figures inside it."""

from __future__ import annotations

import base64
import html
import io
from typing import TYPE_CHECKING

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


def page(title: str, body: str) -> str:
    """A whole document."""
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{CSS}</style></head><body>{body}</body></html>\n"
    )


def facts_table(rows: list[list[str]]) -> str:
    """Name and value in each row."""
    body = "".join(f"<tr><td>{html.escape(k)}</td><td>{html.escape(v)}</td></tr>" for k, v in rows)
    return f'<table class="facts">{body}</table>'


def table(head: list[str], rows: list[list[str]], best: int | None = None) -> str:
    """The first column is text, the others are numbers; the row of the best in bold."""
    cells = "".join(f"<th>{html.escape(h)}</th>" for h in head)
    body = "".join(
        f"<tr{' class=best' if i == best else ''}>" + "".join(f"<td>{html.escape(c)}</td>" for c in row) + "</tr>"
        for i, row in enumerate(rows)
    )
    return f"<table><tr>{cells}</tr>{body}</table>"


def figure(fig: Figure, caption: str) -> str:
    """Inline SVG where it is small, PNG where a plot has many points."""
    buffer = io.BytesIO()
    fig.savefig(buffer, format="svg")
    data = buffer.getvalue().decode()
    if len(data) > 400_000:
        buffer = io.BytesIO()
        fig.savefig(buffer, format="png", dpi=150)
        image = f'<img src="data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}">'
    else:
        image = data[data.index("<svg") :]
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"
