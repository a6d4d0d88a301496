"""Put robots that were identified from the public recordings into the package, as
src/gaponet/robot/identified/NAME.

    python benchmarks/ship_robots.py one SET FOLDER DATASET [--limits SENTENCE]

SET is a data set of the benchmark (benchmarks/real_robots/cards.toml), which has its source and
licence; FOLDER is what `gaponet identify DATASET --out FOLDER` wrote. Copied are the robot, its
uncertainty, the hashes of its recordings, and its nearest PD servos, so that an export needs no
recordings. The errors of the card are measured here, with the robot as it is shipped, on the test
motions of DATASET. Nothing is shipped if a check fails. The table goes into docs/robots.md.

    python benchmarks/ship_robots.py all --data FOLDER --work FOLDER

imports, identifies and ships every set of NAMES.
"""

from __future__ import annotations

import json
import shutil
import tempfile
import tomllib
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import tyro
from real_robots.cards import Card, prepare, read_cards
from shipping import (
    markdown_cards,
    measure_error,
    put_into_package,
    require_public,
    today,
    without_names,
    write_json_line,
    write_table,
)

import gaponet
from gaponet import api
from gaponet.base.errors import UsageError
from gaponet.data.store import Dataset
from gaponet.evaluation.candidate import read_origin
from gaponet.export.plain_servos import CACHE, fit_plain_servos, read_recordings
from gaponet.robot.by_name import CARD, identified_catalogue
from gaponet.robot.card import (
    ROBOT_HEADINGS,
    Published,
    RobotCard,
    RobotFacts,
    SourceOfData,
    robot_cards,
)
from gaponet.robot.folder import PROVENANCE_FILE, UNCERTAINTY_FILE, save_robot
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.replay import rollout_errors

PAGE = Path(__file__).parents[1] / "docs" / "robots.md"
MAX_TOTAL_BYTES = 1_000_000  # of all robots together, so that the wheel stays small
LICENCE = "Apache-2.0"  # of the identified values, as of the package
NAMES = {  # data set of the benchmark → name in the package
    "so101": "so101@sage",
    "so101_another_day": "so101@sage-earlier",
    "h1_2": "h1_2@sage-left",
    "h1_2_right": "h1_2@sage-right",
    "g1_arms": "g1_29@policy-train",
    "go2": "go2@rx-00",
    "go2_other_lab": "go2@iit",
    "aliengo": "aliengo@iit",
    "z1": "z1@iit",
}
LIMITS = (
    "These are the values of that unit on that day: identify or adapt yours before you rely on "
    "them; another unit of the type differs, and so does this one when it is warm or worn"
)


def ship(
    name: Annotated[str, tyro.conf.Positional],
    folder: Annotated[Path, tyro.conf.Positional],
    dataset: Annotated[Path, tyro.conf.Positional],
    limits: str = "",
) -> None:
    """Put an identified robot into the package.

    Args:
        name: Data set of the benchmark, of NAMES. A robot of its name in the package is replaced.
        folder: Robot folder of gaponet identify.
        dataset: The dataset that it was identified from, for the errors on its test motions.
        limits: What the robot is not for beside LIMITS, a sentence without its full stop.
    """
    card = card_of(name)
    with tempfile.TemporaryDirectory() as place:
        made = Path(place) / NAMES[name]
        write_robot(folder, made, Dataset(dataset), card, limits)
        total = put_into_package(made, identified_catalogue(), MAX_TOTAL_BYTES)
    write_table(PAGE, "robots", markdown_cards(robot_cards(), ROBOT_HEADINGS))
    shipped = RobotCard.read(identified_catalogue().place / NAMES[name])
    print(f"{shipped.name}: {', '.join(shipped.row()[1:4])}; {total:,} bytes in all robots")


def ship_all(data: Path, work: Path, sets: tuple[str, ...] = tuple(NAMES)) -> None:
    """Import, identify and ship data sets; what is there below `work` is used again.

    Args:
        data: Folder of the public recordings.
        work: Folder for datasets and robots.
        sets: Only these data sets.
    """
    for name in sets:
        dataset, robot, _ = prepare(card_of(name), data, work)
        folder = work / name / "identified"
        if not (folder / "robot.toml").is_file():
            api.identify(dataset, out=folder, robot=robot)
        ship(name, folder, dataset.path)


def card_of(name: str) -> Card:
    """Return the data card of a set of NAMES."""
    if name not in NAMES:
        raise UsageError(f"no set '{name}'; there are {', '.join(NAMES)}")
    (card,) = [card for card in read_cards().set if card.name == name]
    return card


def write_robot(folder: Path, made: Path, dataset: Dataset, card: Card, limits: str = "") -> None:
    """Write a robot folder as it is shipped.

    Raises:
        GAPONetError: A check failed; the message says which.
    """
    robot = load_robot(folder)
    save_robot(robot, made)
    (made / ".gaponet").unlink()
    origin = read_origin(folder)
    if origin is None or robot.nominal is None:
        raise UsageError(f"{folder}: was not written by gaponet identify")
    parts = {
        "train": without_names(origin["parts"]["train"]),
        "val": without_names(origin["parts"]["val"]),
        "test": without_names(origin["parts"]["test"]),
    }
    write_json_line(made / PROVENANCE_FILE, dict(origin) | {"dataset": card.name, "parts": parts})
    uncertainty = json.loads((folder / UNCERTAINTY_FILE).read_text(encoding="utf-8"))
    write_json_line(made / UNCERTAINTY_FILE, uncertainty)
    plain = write_plain_servos(robot, made, dataset)
    tests = set(origin["parts"]["test"].values())
    test_recordings = dataset.sequences([entry for entry in dataset.entries if entry.hash in tests])
    table = tomllib.loads((made / "robot.toml").read_text(encoding="utf-8"))
    entries = dataset.entries
    facts = RobotFacts(
        robot=robot.name,
        model=table["license"],
        payloads_kg=tuple(sorted({entry.meta.payload_mass for entry in entries})),
        rates_hz=tuple(sorted({round(1 / entry.dt, 1) for entry in entries})),
        units=tuple(sorted({entry.meta.unit_id for entry in entries})),
        gaponet=gaponet.__version__,
        plain_mrad=round(1e3 * float(rollout_errors(test_recordings, plain).mean()), 3),
        published=Published(
            licence=LICENCE,
            date=today(),
            data=SourceOfData(card.title, card.source, card.licence),
            test=measure_error(made, dataset, load_robot(made)),
            limits_of_use=". ".join(filter(None, (LIMITS, limits))) + ".",
        ),
    )
    write_json_line(made / CARD, asdict(facts))
    require_public(made, folder, lambda file: file.read_text(encoding="utf-8"))
    RobotCard.read(made)


def write_plain_servos(robot: RobotSpec, made: Path, dataset: Dataset) -> RobotSpec:
    """Fit the nearest servos without a servo model to the recordings, and copy them; return the
    robot with them.

    A robot without a servo model is returned as it is.
    """
    recordings = read_recordings(robot.folder, str(dataset.path), robot)
    if recordings is None:
        raise UsageError(f"{dataset.path}: no position was commanded")
    plain = fit_plain_servos(robot, recordings[0])
    if (robot.folder / CACHE).is_file():
        shutil.copyfile(robot.folder / CACHE, made / CACHE)
    return plain


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict({"one": ship, "all": ship_all})
