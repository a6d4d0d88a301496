"""gaponet data: card, split, figures, export."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from gaponet.cli.options import Data, Json, Robot, Source
from gaponet.cli.out import Out
from gaponet.data.checks.finding import some
from gaponet.data.store import Dataset
from gaponet.progress import bar
from gaponet.share.stream import open_dataset


def card(
    dataset: Data,
    licence: str | None = None,
    source: str | None = None,
    json: Json = False,
) -> None:
    """Count and measure what a dataset holds; writes card.json and CARD.md into it.

    Args:
        licence: Record this licence in dataset.json, e.g. CC-BY-4.0; "" takes it away.
        source: Record where the data come from: a paper, a laboratory, an address.
    """
    from gaponet.data.card import make_card, write_card
    from gaponet.data.card_text import card_text

    out, data = Out(json), Dataset(dataset)
    stated = {k: v for k, v in (("licence", licence), ("source", source)) if v is not None}
    if stated:
        data.state(**stated)
    with bar("reading") as update:
        made = make_card(data, update)
    write_card(data, made, card_text(made))
    show_card(out, made)
    out.say(f"written: {dataset / 'CARD.md'!s}, {dataset / 'card.json'!s}")
    out.result(made)


def split(
    dataset: Data,
    by: Literal["motion", "unit", "payload"],
    holdout: tuple[str, ...] = (),
    json: Json = False,
) -> None:
    """Divide a dataset into training, validation and test parts that share no recording; writes splits/….json into it.

    Args:
        by: What the test part has and the others have not.
        holdout: Motions, units or payloads (kg) for the test part; default a quarter of them by a fixed rule.
    """
    from gaponet.data.card import count
    from gaponet.data.split import make_split, require_distinct_samples, write_split

    out, data = Out(json), Dataset(dataset)
    parts = make_split(data, by, holdout)
    with bar("comparing") as update:
        require_distinct_samples(data, parts, update)
    path = write_split(data, parts, by, holdout)
    rows: dict[str, dict[str, Any]] = {part: count(entries) | members(entries) for part, entries in parts.items()}
    columns = ["part", "sequences", "hours", "frames", "motions", "units", "payloads, kg"]
    virtual = ", VIRTUAL robots" if any(e.meta.virtual for e in data.entries) else ""
    out.table(f"{data.path.name} by {by}{virtual}; parts share no recording", columns, [
        [part, f"{r['sequences']:,}", f"{r['hours']:.2f}", f"{r['frames']:,}", str(r["motions"]),
         some(r["units"]), some(r["payloads_kg"])]
        for part, r in rows.items()
    ])  # fmt: skip
    out.say(f"written: {path!s}")
    out.result({"split": str(path), "by": by, "parts": rows})


def figures(
    dataset: Source,
    out: Path,
    robot: Robot = None,
    json: Json = False,
) -> None:
    """Draw the dataset: joint ranges, composition, torque and temperature, real against twin, gap against payload.

    Sequences without a twin that a figure needs are replayed first.

    Args:
        out: Folder for the pictures, each as SVG and PNG.
    """
    from gaponet.eval.draw_dataset import draw_all

    screen = Out(json)
    data, spec = open_dataset(dataset, robot)
    with bar("drawing") as update:
        written, left_out = draw_all(data, spec, out, update)
    for path in written:
        screen.say(f"written: {path!s}")
    for name, reason in left_out.items():
        screen.say(f"  {name}: {reason}", "left out", "yellow")
    screen.result({"figures": [str(path) for path in written], "left_out": left_out})


def export(
    dataset: Source,
    out: Path,
    to: Literal["lerobot", "sage", "npz", "asap", "mcap"] = "lerobot",
    robot: Robot = None,
    json: Json = False,
) -> None:
    """Write a dataset in a format of others; gaponet import reads back all that the format can hold.

    Args:
        out: New folder.
        to: LeRobotDataset v3.0 (one set for each rate), SAGE folder, NumPy, ASAP's motion with action, or ROS 2 bags.
    """
    from gaponet.data.writers import WRITERS, export

    screen = Out(json)
    data, spec = open_dataset(dataset, robot)
    with bar("exporting") as update:
        sets = export(data, spec, out, to, update)
    shown = sets[:20]
    screen.table(f"{out!s}: {WRITERS[to]}", ["set", "episodes", "frames", "fps"], [
        [str(s.path), f"{s.episodes:,}", f"{s.frames:,}", f"{s.fps:g}"] for s in shown
    ])  # fmt: skip
    if len(shown) < len(sets):
        screen.say(f"… and {len(sets) - len(shown)} more")
    pickled = " --allow-pickle" if to == "asap" else ""
    screen.say(f"Back: gaponet import {out!s} --robot {data.robot_name}{pickled} --out NEW")
    screen.result({"sets": [{"path": str(s.path), "episodes": s.episodes, "frames": s.frames} for s in sets]})


# Each is run while the command line is parsed; what is left to call is nothing.
Action = (
    Annotated[None, tyro.conf.subcommand("card", constructor=card)]
    | Annotated[None, tyro.conf.subcommand("split", constructor=split)]
    | Annotated[None, tyro.conf.subcommand("figures", constructor=figures)]
    | Annotated[None, tyro.conf.subcommand("export", constructor=export)]
)


def data(action: tyro.conf.OmitArgPrefixes[tyro.conf.OmitSubcommandPrefixes[Action]]) -> None:
    """What a dataset holds: its card, splits, pictures and export."""


def show_card(out: Out, made: dict[str, Any]) -> None:
    """Counts, repeatability and licence; ranges of all signals stand in CARD.md."""
    from gaponet.data.card import NOT_STATED
    from gaponet.data.card_text import TITLES, headline, number, shares

    out.say("", headline(made))
    for name in TITLES:
        out.show("", shares(made, name))
    repeated = made["repeatability"]
    if repeated["channels"]:
        spread = ", ".join(f"{name} {number(c['mean'])} {c['unit']}" for name, c in repeated["channels"].items())
        out.say(
            f"repeatability (std over {repeated['sequences']} repetitions in {repeated['groups']} groups): {spread}"
        )
    else:
        out.say("repeatability: no motion was repeated with the same command, unit and payload")
    for name in ("licence", "source"):
        ask = f"; set it with gaponet data card DIR --{name} …" if made[name] == NOT_STATED else ""
        out.say(f"{name}: {made[name]}{ask}")


def members(entries: list[Any]) -> dict[str, list[str]]:
    """Which units and payloads."""
    return {
        "units": sorted({e.meta.unit_id for e in entries}),
        "payloads_kg": [f"{p:g}" for p in sorted({e.meta.payload_mass for e in entries})],
    }
