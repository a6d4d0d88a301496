"""One title and one colour per method, in every figure, table and scene.

A method is a key of METHODS, with identified+ in front where a network corrects an identified
simulator.
"""

from __future__ import annotations

from gaponet.robot.spec import RobotSpec

# Method → title and colour.
METHODS = {
    "target": ("target", "#00838f"),
    "command": ("command", "#00838f"),
    "recorded": ("recorded", "#111111"),
    "nominal": ("nominal simulator", "#8c8c8c"),
    "delay_offset": ("delay + offset", "#d99000"),
    "identified": ("identification", "#2a9d6f"),
    "shared_mlp": ("MLP", "#3b7dd8"),
    "mlp": ("MLP, full coupling", "#7a8fe0"),
    "trees": ("boosted trees", "#8a6d3b"),
    "gaponet": ("GAPONet", "#c8102e"),
    "paper": ("GAPONet, the paper's form", "#8e1b3a"),
    "adapted": ("adapted to the unit", "#6a1b9a"),
    "uncorrected": ("the other simulator, uncorrected", "#b0a18c"),
    "told": ("told the other simulator's answers", "#8a6fb3"),
    "transfer": ("transferred into the other simulator", "#e07a1f"),
    "delay": ("delay", "#d99000"),
    "offset": ("offset", "#b36b00"),
    "gain": ("gains, inertia, delay", "#2a9d6f"),
    "friction": ("friction", "#24845d"),
    "creep": ("creep", "#7fb8a0"),
    "stribeck": ("friction at rest", "#1d6b4c"),
    "load": ("friction by load", "#17543c"),
    "servo": ("least torque, encoder", "#113f2d"),
    "motor": ("torque by speed", "#0b2a1e"),
    "temperature": ("friction by temperature", "#b3402a"),
    "contact": ("table, stops, zeros", "#6b4f2a"),
    "hand": ("where payloads hang, the hand", "#8d6e44"),
    "links": ("masses of the links", "#7a9a4d"),
}
IDENTIFIED = "identified+"  # in front of the kind of a model that corrects an identified simulator
OTHER_COLOUR = "#777777"


def method(kind: str, simulator: RobotSpec) -> str:
    """Return the method of a model: its kind, with identified+ in front where it corrects an
    identified simulator.
    """
    return f"{IDENTIFIED}{kind}" if simulator.is_identified else kind


def title(method: str) -> str:
    """Return the method's name for people."""
    kind = method.removeprefix(IDENTIFIED)
    name, _ = METHODS.get(kind, (kind, OTHER_COLOUR))
    if method == kind:
        return name
    identification, _ = METHODS["identified"]
    return f"{identification} + {name}"


def colour(method: str) -> str:
    """Return the colour of the method, #rrggbb, darker where it corrects an identified
    simulator.
    """
    kind = method.removeprefix(IDENTIFIED)
    _, base = METHODS.get(kind, (kind, OTHER_COLOUR))
    return base if method == kind else shade(base, -0.4)


def shade(base: str, share: float) -> str:
    """Return a colour, #rrggbb, mixed with white by a share, or with black where the share is
    negative.
    """
    end = 255 if share > 0 else 0
    mixed = "#"
    for i in (1, 3, 5):  # red, green, blue
        part = int(base[i : i + 2], 16)
        mixed += f"{round(part + (end - part) * abs(share)):02x}"
    return mixed
