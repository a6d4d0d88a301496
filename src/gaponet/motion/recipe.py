"""Recipe: which motions are played with which payloads, on which units, at which rates, how
often.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from itertools import product
from pathlib import Path
from typing import Annotated

from annotated_types import Interval, Len

from gaponet.base.errors import UsageError
from gaponet.base.structure import load_toml, validated

RECIPES = Path(__file__).parent / "recipes"
MAX_TAKES = 1_000_000

Name = Annotated[str, Len(1, 200)]
Count = Annotated[int, Interval(ge=1, le=10_000)]
Names = Annotated[tuple[Name, ...], Len(0, 1000)]


@dataclass(frozen=True)
class Recipe:
    """Motions, payloads, units, rates and repetitions to be recorded.

    Attributes:
        payloads: kg per hand; the heaviest decides how far and fast motions may go.
        units: Ids in the fleet.
        motions: Names of motion.library, or patterns of them (`*-left_*`).
        files: Motion files (motion.files) to play too; in a recipe file relative to it.
        rates: Control rates, Hz.
        repetitions: How often all is played; repetitions differ in temperature, noise and exact
            start, as on a robot.
        variants: How many of each kind of coordinated motion patterns choose among.
        payload_side: both, or one hand.
    """

    name: str
    payloads: Annotated[tuple[Annotated[float, Interval(ge=0, le=100)], ...], Len(1, 1000)]
    units: Annotated[Names, Len(1, 1000)]
    motions: Names = ()
    files: Names = ()
    rates: Annotated[tuple[Annotated[float, Interval(ge=1, le=10_000)], ...], Len(1, 1000)] = (
        50.0,
    )
    repetitions: Count = 1
    variants: Count = 1
    payload_side: Name = "both"

    def __post_init__(self) -> None:
        if not (self.motions or self.files):
            raise UsageError(f"recipe '{self.name}': name motions, files, or both")


@dataclass(frozen=True)
class Take:
    """One sequence to be recorded."""

    motion: str
    unit: str
    payload: float
    rate: float
    repetition: int

    def seed(self, base: int) -> int:
        """Seed of everything random in this take."""
        return int(hashlib.sha256(repr((base, self)).encode()).hexdigest()[:16], 16)


def load_recipe(name_or_path: str | Path) -> Recipe:
    """A recipe of the package by name, or a TOML file with the fields of Recipe.

    Raises:
        UsageError: No such recipe, or a field is unknown, missing or empty; with the file and what
            to write.
    """
    path, table = load_toml("recipe", RECIPES, name_or_path)
    hint = f"fields are {', '.join(Recipe.__dataclass_fields__)}"
    recipe = validated(Recipe, {"name": path.stem} | table, path, UsageError, hint)
    return replace(recipe, files=tuple(str(path.parent / file) for file in recipe.files))


def takes(recipe: Recipe, names: list[str]) -> list[Take]:
    """Return all sequences of a recipe in order; names are the library's.

    Raises:
        UsageError: A pattern matches nothing.
    """
    motions = _motions(recipe, names)
    count = (
        len(motions)
        * len(recipe.rates)
        * len(recipe.payloads)
        * len(recipe.units)
        * recipe.repetitions
    )
    if count > MAX_TAKES:
        raise UsageError(
            f"recipe '{recipe.name}': {count} sequences; at most {MAX_TAKES} in one recipe"
        )
    repetitions = range(recipe.repetitions)
    every = product(motions, recipe.rates, recipe.payloads, recipe.units, repetitions)
    wanted = []
    for motion, rate, payload, unit, repetition in every:
        wanted.append(Take(motion, unit, float(payload), float(rate), repetition))
    return wanted


def _motions(recipe: Recipe, names: list[str]) -> list[str]:
    """Return the names of a recipe's motions and files, each once."""
    motions: list[str] = []
    for pattern in recipe.motions:
        matches = [name for name in names if fnmatchcase(name, pattern)]
        if not matches and any(c in pattern for c in "*?["):
            raise UsageError(
                f"recipe '{recipe.name}': no motion of this robot matches '{pattern}'; recipe arm "
                "has motions for any robot"
            )
        motions += matches or [pattern]
    motions += [Path(file).stem for file in recipe.files]
    return list(dict.fromkeys(motions))
