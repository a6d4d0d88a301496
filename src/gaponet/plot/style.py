"""How every figure looks, and how it is written to a file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from gaponet.files import whole

STYLE = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.alpha": 0.25,
    "grid.linewidth": 0.5,
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "svg.fonttype": "none",
    "text.parse_math": False,  # a $ in a name is a $
    "svg.hashsalt": "gaponet",
    "figure.constrained_layout.use": True,
}


def figure(width: float, height: float) -> Figure:
    """An empty figure, inches; never touches pyplot's global state."""
    return Figure(figsize=(width, height))


def styled(draw: Any) -> Any:
    """Decorator: draw under STYLE."""

    def wrapped(*args: Any, **kwargs: Any) -> Figure:
        with mpl.rc_context(STYLE):  # type: ignore[arg-type]
            return draw(*args, **kwargs)

    wrapped.__doc__ = draw.__doc__
    return wrapped


def save(fig: Figure, path: Path) -> list[Path]:
    """SVG with letters as outlines, so that it looks the same everywhere, and PNG for screens and slides."""
    files = [path.with_suffix(".svg"), path.with_suffix(".png")]
    how: list[dict[str, Any]] = [{"metadata": {"Date": None}}, {"dpi": 200}]
    with mpl.rc_context(STYLE | {"svg.fonttype": "path"}):  # type: ignore[arg-type]
        for file, options in zip(files, how, strict=True):
            with whole(file) as temporary:
                fig.savefig(temporary, **options)
    return files
