"""How every figure looks, where its legend stands, and how it is written to a file."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec

from gaponet.base.files import atomic_write
from gaponet.base.text import escape

if TYPE_CHECKING:
    from matplotlib.figure import Figure

P = ParamSpec("P")

STYLE: dict[Any, Any] = {
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
DASHED = (0, (4, 1.5))
DOTTED = (0, (1, 1))
ENTRY, LETTER = 1.9, 0.09  # inches that a legend's entry takes at most, and a letter of it
LONGEST, LABEL = 120, 40  # letters of a line, and of one beside an axis or in a legend


def figure(width: float, height: float) -> Figure:
    """An empty figure, inches; never touches pyplot's global state."""
    from matplotlib.figure import Figure  # here and below: imported when something is drawn

    return Figure(figsize=(width, height))


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Decorator: draw under STYLE, whatever names hold."""

    @wraps(draw)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> Figure:
        import matplotlib as mpl

        with mpl.rc_context(STYLE):
            return _printable(draw(*args, **kwargs))

    return wrapped


def _printable(fig: Figure) -> Figure:
    """The same figure with words that can be drawn: controls are escapes, which no font has nor an SVG may hold, and of
    a line longer than there is room for, the middle is left out."""
    from matplotlib.legend import Legend
    from matplotlib.text import Text
    from matplotlib.ticker import FixedFormatter, FuncFormatter

    def lines(text: str, most: int) -> str:
        every = map(escape, text.split("\n"))
        return "\n".join(s if len(s) <= most else f"{s[: most // 2]}…{s[-most // 2 :]}" for s in every)

    for axis in (axis for ax in fig.axes for axis in (ax.xaxis, ax.yaxis)):
        ticks = axis.get_major_formatter()
        if isinstance(ticks, (FixedFormatter, FuncFormatter)):
            axis.set_major_formatter(FuncFormatter(lambda at, i, ticks=ticks: lines(ticks(at, i), LABEL)))
    entries = {text for legend in fig.findobj(Legend) for text in legend.get_texts()}
    for text in fig.findobj(Text):
        text.set_text(lines(text.get_text(), LABEL if text in entries else LONGEST))
    return fig


def legend(fig: Figure, title: str = "") -> None:
    """Each label of all axes once, in as many columns as fit, never over the data; with a title, one for the figure."""
    found: dict[str, Any] = {}
    for ax in fig.axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    wide = min(ENTRY, 0.5 + LETTER * max(map(len, found), default=0))
    fig.legend(
        list(found.values()), list(found), loc="outside upper left",
        ncols=max(1, min(len(found), int(fig.get_figwidth() / wide))), columnspacing=1.1, handlelength=1.4,
        title=title or None, alignment="left", title_fontproperties={"weight": "bold", "size": 9},
    )  # fmt: skip


def joint_label(joint: str, wrapped: bool = True) -> str:
    """left_shoulder_pitch_joint → left shoulder pitch, wrapped: a word a line, since tick labels stand side by side."""
    words = joint.removesuffix("_joint").replace("_", " ")
    return words.replace(" ", "\n") if wrapped else words


def save(fig: Figure, path: Path) -> list[Path]:
    """SVG with letters as outlines, so that it looks the same everywhere, and PNG for screens and slides."""
    import matplotlib as mpl

    files = [path.with_suffix(".svg"), path.with_suffix(".png")]
    how: list[dict[str, Any]] = [{"metadata": {"Date": None}}, {"dpi": 200}]
    with mpl.rc_context(STYLE | {"svg.fonttype": "path"}):
        for file, options in zip(files, how, strict=True):
            with atomic_write(file) as temporary:
                fig.savefig(temporary, **options)
    return files
