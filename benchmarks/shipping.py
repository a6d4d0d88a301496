"""What ship_networks.py and ship_robots.py have in common: checks, the copy into the package, the
page's table.
"""

from __future__ import annotations

import json
import re
import shutil
import tempfile
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

from gaponet.base.errors import UsageError
from gaponet.base.files import write_text
from gaponet.data.store import Dataset
from gaponet.evaluation.evaluate import evaluate
from gaponet.robot.by_name import Catalogue
from gaponet.robot.card import ErrorOnTest, folder_size
from gaponet.robot.spec import RobotSpec

HOMES = ("/home/", "/Users/", ":\\\\Users")  # in a path of some machine


class Card(Protocol):
    """A card that has a row in a table, and a line below it."""

    @property
    def name(self) -> str:
        """The name in the package."""

    def row(self) -> list[str]:
        """Return the cells of its row; the first one is the name."""

    def details(self) -> str:
        """Return the line below the table."""


def markdown_cards(cards: Sequence[Card], headings: Sequence[str]) -> str:
    """Return cards as text of the documentation: a table, and a line with the details of each."""
    if not cards:
        return "This version of the package has none.\n"
    lines = [f"| {' | '.join(headings)} |", "|---" * len(headings) + "|"]
    for card in cards:
        cells = card.row()
        cells[0] = f"`{cells[0]}`"
        lines.append(f"| {' | '.join(cells)} |")
    lines.append("")
    for card in cards:
        lines.append(f"- `{card.name}`: {card.details()}")
    return "\n".join(lines) + "\n"


def today() -> str:
    """Return the day for a card, YYYY-MM-DD."""
    return datetime.now(UTC).strftime("%Y-%m-%d")


def put_into_package(folder: Path, place: Catalogue, limit_bytes: int) -> int:
    """Copy a folder into the package, in place of one of that name; return the size of all, bytes.

    Raises:
        UsageError: All together would be larger than the limit.
    """
    others = [other for other in place.folders() if other.name != folder.name]
    total = sum(folder_size(other) for other in others) + folder_size(folder)
    if total > limit_bytes:
        raise UsageError(
            f"{folder.name} has {folder_size(folder):,} bytes; all of its kind together would have "
            f"{total:,} of at most {limit_bytes:,}"
        )
    shutil.rmtree(place.place / folder.name, ignore_errors=True)
    shutil.copytree(folder, place.place / folder.name)
    return total


def measure_error(folder: Path, data: Dataset, robot: RobotSpec) -> ErrorOnTest:
    """Measure a robot folder or a network on test motions.

    Raises:
        UsageError: A motion was used in the fit or in training.
    """
    result = evaluate([folder], data, robot).result
    if not result["unseen"]:
        raise UsageError(
            f"{data.path}: some test motions were used in training; split the dataset by motion"
        )
    methods = result["methods"]
    (fitted,) = result["artifacts"] or ("identified",)
    return ErrorOnTest(
        recordings=result["sequences"],
        motions=tuple(result["motions"]),
        nominal_mrad=round(1e3 * methods["nominal"]["mpjae"], 3),
        model_mrad=round(1e3 * methods[fitted]["mpjae"], 3),
    )


def require_public(folder: Path, source: Path, read: Callable[[Path], str]) -> None:
    """Refuse files that name a path of a machine: a home, or where the source and its programs lie.

    Args:
        source: Run or robot folder that the files come from.
        read: Returns a file as text.
    """
    here = (Path.home(), Path.cwd(), source.resolve().parent, Path(tempfile.gettempdir()))
    private = [*HOMES, *(str(place) for place in here if place != Path("/"))]
    for file in sorted(folder.iterdir()):
        text = read(file)
        for path in private:
            if path in text:
                raise UsageError(
                    f"{file.name} names '{path}', a path of a machine; remove it from the "
                    "source's files"
                )


def write_table(page: Path, name: str, table: str) -> None:
    """Write a table into a page, between the comments <!-- NAME --> and <!-- end of NAME -->."""
    text = page.read_text(encoding="utf-8")
    place = re.compile(rf"(?<=<!-- {name} -->\n)\n.*?(?=\n<!-- end of {name} -->)", re.DOTALL)
    if not place.search(text):
        raise UsageError(
            f"{page}: has no place for the table; restore the comments <!-- {name} -->"
        )
    write_text(page, place.sub(lambda _: "\n" + table, text))


def write_json_line(file: Path, value: Any) -> None:
    """Write JSON without blanks."""
    file.write_text(
        json.dumps(value, ensure_ascii=False, separators=(",", ":")) + "\n", encoding="utf-8"
    )


def without_names(hashes: dict[str, str]) -> dict[str, str]:
    """Return the hashes of a split's part with numbers in place of the names; hashes tell what was
    seen.
    """
    return {str(i): digest for i, digest in enumerate(hashes.values())}
