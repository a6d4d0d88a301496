"""One name and one colour per method, in every figure, table and scene.

A method is a key of NAMES or COLOURS, or a word of study.variant: [identified+]KIND[:FIELD=VALUE]…
"""

from __future__ import annotations

from collections.abc import Iterable

NAMES = {
    "target": "target",
    "command": "command",
    "recorded": "recorded",
    "nominal": "nominal simulator",
    "delay_offset": "delay + offset",
    "identified": "identification",
    "inverse": "inverse labels",
    "mlp": "MLP",
    "transformer": "Transformer",
    "fno": "FNO",
    "gaponet": "GAPONet",
    "calibrated": "calibrated to the unit",
    "delay": "delay",
    "offset": "offset",
    "gain": "gains, inertia, delay",
    "friction": "friction",
    "stribeck": "friction at rest",
    "load": "friction by load",
    "servo": "least torque, encoder",
    "contact": "table, stops, zeros",
    "raw": "raw targets",
    "feedforward": "nominal model's feed-forward alone",
    "identified feedforward": "identified model's feed-forward alone",
}
COLOURS = {
    "target": "#00838f",
    "command": "#00838f",
    "recorded": "#111111",
    "nominal": "#8c8c8c",
    "delay_offset": "#d99000",
    "identified": "#2a9d6f",
    "inverse": "#12465b",
    "mlp": "#3b7dd8",
    "transformer": "#56c1e8",
    "fno": "#ded06a",
    "gaponet": "#c8102e",
    "calibrated": "#6a1b9a",
    "delay": "#d99000",
    "offset": "#b36b00",
    "gain": "#2a9d6f",
    "friction": "#24845d",
    "stribeck": "#1d6b4c",
    "load": "#17543c",
    "servo": "#113f2d",
    "contact": "#6b4f2a",
    "raw": "#5c5c5c",
    "feedforward": "#c9b28f",
    "identified feedforward": "#2a9d6f",
}
OTHER = "#777777"
SAID = {"mlp_match=on": "as many weights", "payload_input=off": "mass not told"}
IDENTIFIED = "identified+"  # in front of the kind of a model that corrects an identified simulator


def title(method: str) -> str:
    """The method's name for people: identification + MLP, as many weights (history 8)."""
    kind, *changes = method.removeprefix(IDENTIFIED).split(":")
    start = f"{NAMES['identified']} + " if method.startswith(IDENTIFIED) else ""
    name = ", ".join([start + NAMES.get(kind, kind), *(SAID[c] for c in changes if c in SAID)])
    others = ", ".join(c.replace("=", " ") for c in changes if c not in SAID)
    return f"{name} ({others})" if others else name


def colour(method: str) -> str:
    """The colour of the method's kind, #rrggbb, darker where it corrects an identified simulator."""
    base = COLOURS.get(method.removeprefix(IDENTIFIED).split(":")[0], OTHER)
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
