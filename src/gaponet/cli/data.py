"""gaponet data: card, split, figures, export, remove."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import tyro

from gaponet.api import datasets
from gaponet.api.datasets import CardResult
from gaponet.base.progress import progress_bar
from gaponet.cli.options import Data, Json, Robot, actions
from gaponet.cli.out import Out
from gaponet.robot.finding import abbreviate

MAX_SETS = 20  # on the screen
SPLIT_COLUMNS = ["part", "sequences", "hours", "frames", "motions", "units", "payloads, kg"]


def _card(
    dataset: Data,
    licence: str | None = None,
    source: str | None = None,
    beside: Literal["paper"] | None = None,
    json: Json = False,
) -> None:
    """Count and measure what a dataset holds; writes card.json and CARD.md into it.

    Args:
        licence: Record this licence in dataset.json, such as CC-BY-4.0; "" removes it.
        source: Record where the data come from: a paper, a laboratory, an address.
        beside: "paper" adds the counts of the SimLifter and GAPONet paper's dataset beside those of
            this one.
    """
    screen = Out(json)
    with progress_bar("reading") as update:
        made = datasets.dataset_card(
            dataset,
            licence=licence,
            source=source,
            beside_paper=beside == "paper",
            progress=update,
        )
    _show_card(screen, made)
    if made.written:
        screen.say(f"written: {dataset / 'CARD.md'!s}, {dataset / 'card.json'!s}")
    else:
        screen.say("nothing may be written into that folder, so the card is only shown")
    screen.result(made.to_dict())


def _split(
    dataset: Data,
    by: datasets.SplitBy,
    holdout: tuple[str, ...] = (),
    json: Json = False,
) -> None:
    """Divide a dataset into training, validation and test parts that share no recording; writes
    splits/….json into it.

    Args:
        by: Property whose values are divided among the parts. The last repetitions, or the last
            pieces in time (logs imported with --cut), are the test part.
        holdout: Motions, units or payloads (kg) for the test part; default a quarter of them by a
            fixed rule.
    """
    screen = Out(json)
    with progress_bar("comparing") as update:
        made = datasets.split_dataset(dataset, by=by, holdout=holdout, progress=update)
    rows = []
    for name, part in made.parts.items():
        counts = part.counts
        row = [name, f"{counts['sequences']:,}", f"{counts['hours']:.2f}"]
        row += [f"{counts['frames']:,}", str(counts["motions"])]
        row += [abbreviate(part.units), abbreviate(part.payloads_kg)]
        rows.append(row)
    data = made.dataset
    virtual = ", VIRTUAL robots" if any(entry.meta.virtual for entry in data.entries) else ""
    title = f"{data.path.name} by {by}{virtual}; parts share no recording"
    screen.table(title, SPLIT_COLUMNS, rows)
    screen.say(f"written: {made.path!s}")
    screen.result(made.to_dict())


def _figures(dataset: Data, out: Path, robot: Robot = None, json: Json = False) -> None:
    """Draw the dataset: joint ranges, composition, torque and temperature.

    Args:
        out: Folder for the pictures, each as SVG and PNG.
    """
    screen = Out(json)
    with progress_bar("drawing") as update:
        made = datasets.draw_dataset(dataset, out=out, robot=robot, progress=update)
    for path in made.written:
        screen.say(f"written: {path!s}")
    for name, reason in made.left_out.items():
        screen.say(f"  {name}: {reason}", "left out", "yellow")
    screen.result(made.to_dict())


def _export(dataset: Data, out: Path, json: Json = False) -> None:
    """Write a dataset as LeRobotDataset v3.0, one set for each rate; gaponet import reads it back.

    Args:
        out: New folder.
    """
    screen = Out(json)
    with progress_bar("exporting") as update:
        made = datasets.export_dataset(dataset, out=out, progress=update)
    shown = made.sets[:MAX_SETS]
    rows = [[str(s.path), f"{s.episodes:,}", f"{s.frames:,}", f"{s.fps:g}"] for s in shown]
    screen.table(str(out), ["set", "episodes", "frames", "fps"], rows)
    more = len(made.sets) - len(shown)
    if more:
        screen.say(f"… and {more} more")
    screen.say(f"Back: gaponet import {out!s} --robot {made.dataset.robot_name} --out NEW")
    screen.result(made.to_dict())


def _remove(dataset: Data, ids: tyro.conf.Positional[tuple[str, ...]], json: Json = False) -> None:
    """Remove sequences from a dataset, with their simulated replays; their logs can be imported
    again.

    Args:
        ids: Ids in sequences.jsonl, or patterns: '*-1kg-*' removes all with a payload of 1 kg.
    """
    screen = Out(json)
    data, gone = datasets.remove_recordings(dataset, ids)
    names = [entry.id for entry in gone]
    screen.say(
        f"removed {len(gone)}: {abbreviate(names)}; {data.path!s} now holds {len(data)}",
    )
    screen.result({"removed": names, "sequences": len(data)})


@actions(card=_card, split=_split, figures=_figures, export=_export, remove=_remove)
def data(action: None) -> None:
    """A dataset's card, splits, pictures, export and removal."""


def _show_card(screen: Out, made: CardResult) -> None:
    """Counts, repeatability and licence; ranges of all signals stand in CARD.md."""
    screen.say("", made.headline)
    for table in made.counts():
        screen.show("", table)
    beside_paper = made.beside_paper()
    if beside_paper is not None:
        screen.show("Beside the paper's counts", beside_paper)
        screen.say(beside_paper.caption)
    screen.say(_repeatability(made.card["repeatability"]))
    for name in ("licence", "source"):
        ask = "" if made.states(name) else f"; set it with gaponet data card DIR --{name} …"
        screen.say(f"{name}: {made.card[name]}{ask}")


def _repeatability(repeated: dict[str, Any]) -> str:
    """Return how much repetitions of a motion differ, in a sentence."""
    if not repeated["channels"]:
        return "repeatability: no motion was repeated with the same command, unit and payload"
    spreads = []
    for name, channel in repeated["channels"].items():
        spreads.append(f"{name} {channel['mean']:.3g} {channel['unit']}")
    source = f"{repeated['sequences']} repetitions in {repeated['groups']} groups"
    return f"repeatability (std over {source}): {', '.join(spreads)}"
