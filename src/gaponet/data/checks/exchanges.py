"""Ways in which the columns of a log may be exchanged: pairs of joints, the order of all of them,
left and right, front and rear.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from gaponet.base.arrays import Array

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


@dataclass(frozen=True)
class Exchange:
    """One way in which the columns of a log may be exchanged.

    Attributes:
        words: What is exchanged, for a person.
        joints: Indices of the joints that it is about.
        order: Column order[i] of the log belongs to joint i, (n).
    """

    words: str
    joints: tuple[int, ...]
    order: Array

    def names(self, joint_names: tuple[str, ...]) -> dict[str, str]:
        """Return name in the log → joint, of the columns that are not their own joint's."""
        names = {}
        for joint, column in enumerate(self.order.tolist()):
            if column != joint:
                names[joint_names[column]] = joint_names[joint]
        return names


def exchange(n: int, joints: Sequence[int], columns: Sequence[int], words: str) -> Exchange:
    """Return the exchange by which these columns, of n, belong to these joints."""
    order = np.arange(n)
    order[list(joints)] = columns
    return Exchange(words, tuple(joints), order)


def pairs(joints: list[int], names: tuple[str, ...]) -> Iterator[Exchange]:
    """Yield every two of the joints in each other's place."""
    for one, other in combinations(joints, 2):
        words = f"{names[one]} and {names[other]} in each other's place"
        yield exchange(len(names), [one, other], [other, one], words)


def shifts(joints: list[int], names: tuple[str, ...]) -> Iterator[Exchange]:
    """Yield all of the joints moved by one place, on and back, and in reversed order."""
    orders = {
        "one place on": np.roll(joints, 1).tolist(),
        "one place back": np.roll(joints, -1).tolist(),
        "backwards": joints[::-1],
    }
    for words, columns in orders.items():
        yield exchange(len(names), joints, columns, f"the order of joints {words}")
