"""Style, legend and files of all figures; lines and bars, which several figures use."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from collections.abc import Sequence as ListOf
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.files import atomic_write
from gaponet.base.result_table import MeanStd
from gaponet.base.text import escape

if TYPE_CHECKING:
    from matplotlib.figure import Figure

P = ParamSpec("P")
Bars = Mapping[str, tuple[str, ListOf[MeanStd]]]  # label → colour, value of each group

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
MAX_LEGEND_ENTRY_INCH = 1.9
LETTER_WIDTH_INCH = 0.09
MAX_LINE = 120  # letters
MAX_LABEL = 40  # letters of a label of an axis or a legend


def figure(width: float, height: float) -> Figure:
    """Return an empty figure, inches, without pyplot's global state."""
    from matplotlib.figure import Figure  # here and below: imported for drawing only

    return Figure(figsize=(width, height))


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Decorator: draw with STYLE, and make all texts printable."""

    @wraps(draw)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> Figure:
        import matplotlib as mpl

        with mpl.rc_context(STYLE):
            return _printable(draw(*args, **kwargs))

    return wrapped


def _printable(fig: Figure) -> Figure:
    """Escape control characters, which an SVG may not hold, and shorten long lines in the
    middle.
    """
    from matplotlib.legend import Legend
    from matplotlib.text import Text
    from matplotlib.ticker import FixedFormatter, FuncFormatter

    for ax in fig.axes:
        for axis in (ax.xaxis, ax.yaxis):
            ticks = axis.get_major_formatter()
            if isinstance(ticks, (FixedFormatter, FuncFormatter)):
                axis.set_major_formatter(
                    FuncFormatter(lambda at, i, ticks=ticks: _shortened(ticks(at, i), MAX_LABEL))
                )
    entries: set[Text] = set()
    for legend in fig.findobj(Legend):
        entries.update(legend.get_texts())
    for text in fig.findobj(Text):
        text.set_text(_shortened(text.get_text(), MAX_LABEL if text in entries else MAX_LINE))
    return fig


def _shortened(text: str, limit: int) -> str:
    """Return a text with its control characters escaped, and long lines cut in the middle."""
    lines = []
    for line in map(escape, text.split("\n")):
        if len(line) > limit:
            line = f"{line[: limit // 2]}…{line[-limit // 2 :]}"
        lines.append(line)
    return "\n".join(lines)


def legend(fig: Figure, title: str = "") -> None:
    """Add one legend for all axes above the figure, in as many columns as fit.

    title is that of the figure.
    """
    handles: dict[str, Any] = {}
    for ax in fig.axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    longest = max(map(len, handles), default=0)  # letters
    width = min(MAX_LEGEND_ENTRY_INCH, 0.5 + LETTER_WIDTH_INCH * longest)
    columns = min(len(handles), int(fig.get_figwidth() / width))
    fig.legend(
        list(handles.values()),
        list(handles),
        loc="outside upper left",
        ncols=max(1, columns),
        columnspacing=1.1,
        handlelength=1.4,
        title=title or None,
        alignment="left",
        title_fontproperties={"weight": "bold", "size": 9},
    )


@styled
def draw_curves(time: Array, curves: Mapping[str, tuple[Array, str]], label: str) -> Figure:
    """Draw values over time, s; curves: name → values and colour."""
    fig = figure(7.0, 3.2)
    ax = fig.subplots()
    for name, (values, colour) in curves.items():
        ax.plot(time, values, color=colour, label=name)
    ax.set_xlabel("time, s")
    ax.set_ylabel(label)
    legend(fig)
    return fig


@styled
def bars(groups: ListOf[str], methods: Bars, axis: str, title: str) -> Figure:
    """Draw bars with error bars, the methods of each group side by side."""
    words = " ".join(groups).split()
    longest = max(map(len, words), default=0)  # letters
    width_of_bars = 0.17 * len(groups) * len(methods) + 1.7
    width_of_labels = (LETTER_WIDTH_INCH * longest + 0.05) * len(groups) + 1.3
    fig = figure(max(5.2, width_of_bars, width_of_labels), 3.3)
    ax = fig.subplots()
    width = 0.84 / len(methods)
    for i, (label, (colour, values)) in enumerate(methods.items()):
        x = np.arange(len(groups)) + (i - (len(methods) - 1) / 2) * width
        std = np.nan_to_num([v.std for v in values])
        ax.bar(
            x,
            [v.mean for v in values],
            width * 0.92,
            yerr=std if std.any() else None,
            color=colour,
            label=label,
            error_kw={"lw": 0.7, "capsize": 1.2, "capthick": 0.6},
        )
    ax.set_xticks(np.arange(len(groups)), groups)
    ax.tick_params(axis="x", length=0)
    ax.grid(axis="x", visible=False)
    ax.set_ylabel(axis)
    ax.set_title(title)
    legend(fig)
    return fig


def joint_label(joint: str, wrapped: bool = True) -> str:
    """Return left_shoulder_pitch_joint as left shoulder pitch.

    wrapped: one word per line, for neighbouring ticks.
    """
    words = joint.removesuffix("_joint").replace("_", " ")
    return words.replace(" ", "\n") if wrapped else words


def save(fig: Figure, path: Path) -> list[Path]:
    """Write an SVG, with letters as outlines so that no font is needed, and a PNG.

    Return both files.
    """
    import matplotlib as mpl

    files = [path.with_suffix(".svg"), path.with_suffix(".png")]
    how: list[dict[str, Any]] = [{"metadata": {"Date": None}}, {"dpi": 200}]
    with mpl.rc_context(STYLE | {"svg.fonttype": "path"}):
        for file, options in zip(files, how, strict=True):
            with atomic_write(file) as temporary:
                fig.savefig(temporary, **options)
    return files
