"""One colour per method, in every figure and scene."""

from __future__ import annotations

from collections.abc import Iterable

from gaponet.report.methods import IDENTIFIED, METHODS

OTHER = "#777777"


def colour(method: str) -> str:
    """The colour of the method's kind, #rrggbb, darker where it corrects an identified simulator."""
    base = METHODS.get(method.removeprefix(IDENTIFIED).split(":")[0], ("", OTHER))[1]
    return shade(base, -0.4) if method.startswith(IDENTIFIED) else base


def palette(methods: Iterable[str]) -> dict[str, str]:
    """A colour for each method; several models of one kind are shades of its colour."""
    out: dict[str, str] = {}
    for method in methods:
        base = colour(method)
        before = sum(colour(other) == base for other in out)
        out[method] = shade(base, 1 - 0.62**before)
    return out


def shade(base: str, light: float) -> str:
    """A colour, #rrggbb, brought nearer to white by this share, or nearer to black where it is negative."""
    end = 255 if light > 0 else 0
    parts = (int(base[i : i + 2], 16) for i in (1, 3, 5))
    return "#" + "".join(f"{round(p + (end - p) * abs(light)):02x}" for p in parts)
