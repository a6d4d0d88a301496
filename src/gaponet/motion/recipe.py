"""Recipe: which motions are played with which payloads, on which units, at which rates, how often."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from gaponet.errors import UsageError
from gaponet.packaged import load_toml

RECIPES = Path(__file__).parent / "recipes"


@dataclass(frozen=True)
class Recipe:
    """What is played.

    Attributes:
        payloads: kg per hand; the heaviest decides how far and fast motions may go.
        units: Ids in the fleet.
        motions: Names of motion.library, or patterns of them (`*-left_*`).
        files: Motion files (motion.files) to play too; in a recipe file relative to it.
        rates: Control rates, Hz.
        repetitions: Of everything; they differ in temperature, noise and exact start, as on a robot.
        variants: How many of each kind of coordinated motion patterns choose among.
        payload_side: both, or one hand.
    """

    name: str
    payloads: tuple[float, ...]
    units: tuple[str, ...]
    motions: tuple[str, ...] = ()
    files: tuple[str, ...] = ()
    rates: tuple[float, ...] = (50.0,)
    repetitions: int = 1
    variants: int = 1
    payload_side: str = "both"

    def __post_init__(self) -> None:
        for field in ("payloads", "units", "rates"):
            if not getattr(self, field):
                raise UsageError(f"recipe '{self.name}': {field} is empty; name at least one")
        if not (self.motions or self.files):
            raise UsageError(f"recipe '{self.name}': name motions, files, or both")
        if min(self.rates) <= 0:
            raise UsageError(f"recipe '{self.name}': rates are in Hz and positive, got {min(self.rates)}")
        if self.repetitions < 1 or self.variants < 1:
            raise UsageError(f"recipe '{self.name}': repetitions and variants are counts, 1 or more")


@dataclass(frozen=True)
class Take:
    """One sequence to be recorded."""

    motion: str
    unit: str
    payload: float
    rate: float
    repetition: int

    def seed(self, base: int) -> int:
        """Of everything random in this take."""
        return int(hashlib.sha256(repr((base, self)).encode()).hexdigest()[:16], 16)


def load_recipe(name_or_path: str | Path) -> Recipe:
    """A recipe of the package by name, or a TOML file with the fields of Recipe.

    Raises:
        UsageError: No such recipe, or a field is unknown, missing or empty; with the file and what to write.
    """
    path, table = load_toml("recipe", RECIPES, name_or_path)
    known_fields = [f.name for f in fields(Recipe)]
    for key in table:
        if key not in known_fields:
            raise UsageError(f"{path}: '{key}' is not a field of a recipe; fields are {', '.join(known_fields)}")
    for key in ("payloads", "units"):
        if key not in table:
            raise UsageError(f"{path}: '{key}' is missing; add {key} = [...]")
    values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in table.items()}
    values["files"] = tuple(str(path.parent / f) for f in values.get("files", ()))
    return Recipe(**({"name": path.stem} | values))


def takes(recipe: Recipe, names: list[str]) -> list[Take]:
    """All sequences of a recipe, in the order in which they are written; names are the library's.

    Raises:
        UsageError: A pattern matches nothing.
    """
    motions: list[str] = []
    for pattern in recipe.motions:
        found = [name for name in names if fnmatchcase(name, pattern)]
        if not found and any(c in pattern for c in "*?["):
            raise UsageError(f"recipe '{recipe.name}': no motion of this robot matches '{pattern}'")
        motions += found or [pattern]
    motions += [Path(file).stem for file in recipe.files]
    return [
        Take(motion, unit, float(payload), float(rate), repetition)
        for motion in dict.fromkeys(motions)
        for rate in recipe.rates
        for payload in recipe.payloads
        for unit in recipe.units
        for repetition in range(recipe.repetitions)
    ]
