"""Left and right, front and rear: which joints of a robot are each other's counterpart, by their
names.
"""

from __future__ import annotations

import re

# Words of names, and their counterparts.
SIDES = {
    "left and right": {
        "left": "right",
        "l": "r",
        "fl": "fr",
        "rl": "rr",
        "hl": "hr",
        "bl": "br",
        "lf": "rf",
        "lh": "rh",
    },
    "front and rear": {"front": "rear", "fl": "rl", "fr": "rr", "lf": "lh", "rf": "rh"},
}


def mirrored_joints(names: tuple[str, ...]) -> dict[str, dict[int, int]]:
    """Return "left and right", "front and rear" → joint → its counterpart, as indices of names.

    Sides that a robot does not have are left out.
    """
    result: dict[str, dict[int, int]] = {}
    for side, words in SIDES.items():
        both = words | {other: word for word, other in words.items()}
        partners: dict[int, int] = {}
        for i, name in enumerate(names):
            other = _counterpart(name, both)
            if other != name and other in names:
                partners[i] = names.index(other)
        if partners:
            result[side] = partners
    return result


def _counterpart(name: str, words: dict[str, str]) -> str:
    """Return the name with each word replaced: FL_hip_joint → FR_hip_joint."""

    def replaced(match: re.Match[str]) -> str:
        word = match[0]
        other = words.get(word.lower(), word)
        return other.upper() if word.isupper() else other

    return re.sub(r"[A-Za-z]+", replaced, name)
