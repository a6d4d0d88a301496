"""gaponet data: card, split, figures, export, remove."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import tyro

from gaponet.base.progress import progress_bar
from gaponet.cli.options import Data, Json, Robot, actions
from gaponet.cli.out import Out
from gaponet.data.store import Dataset
from gaponet.robot.finding import abbreviate
from gaponet.sim.dataset_robot import open_dataset


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
        beside: "paper" adds the counts of the SimLifter and GAPONet paper's dataset beside those of this one.
    """
    from gaponet.data.card import beside_paper, make_card, write_card

    out, data = Out(json), Dataset(dataset)
    stated = {k: v for k, v in (("licence", licence), ("source", source)) if v is not None}
    if stated:
        data.set_provenance(**stated)
    with progress_bar("reading") as update:
        made = make_card(data, update)
    if beside == "paper":
        made["beside_paper"] = beside_paper(data)
    _show_card(out, made)
    if data.read_only:
        out.say("nothing may be written into that folder, so the card is only shown")
    else:
        write_card(data, made)
        out.say(f"written: {dataset / 'CARD.md'!s}, {dataset / 'card.json'!s}")
    out.result(made)


def _split(
    dataset: Data,
    by: Literal["motion", "unit", "payload", "repetition", "time"],
    holdout: tuple[str, ...] = (),
    json: Json = False,
) -> None:
    """Divide a dataset into training, validation and test parts that share no recording; writes splits/….json into it.

    Args:
        by: Property whose values are divided among the parts. The last repetitions, or the last pieces in time (logs
            imported with --cut), are the test part.
        holdout: Motions, units or payloads (kg) for the test part; default a quarter of them by a fixed rule.
    """
    from gaponet.data.card import count_entries
    from gaponet.data.split import make_split, require_distinct_samples, write_split

    out, data = Out(json), Dataset(dataset)
    parts = make_split(data, by, holdout)
    with progress_bar("comparing") as update:
        require_distinct_samples(data, parts, update)
    path = write_split(data, parts, by, holdout)
    rows: dict[str, dict[str, Any]] = {
        part: count_entries(entries) | {
            "units": sorted({e.meta.unit_id for e in entries}),
            "payloads_kg": [f"{p:g}" for p in sorted({e.meta.payload_mass for e in entries})],
        }
        for part, entries in parts.items()
    }  # fmt: skip
    columns = ["part", "sequences", "hours", "frames", "motions", "units", "payloads, kg"]
    virtual = ", VIRTUAL robots" if any(e.meta.virtual for e in data.entries) else ""
    out.table(f"{data.path.name} by {by}{virtual}; parts share no recording", columns, [
        [part, f"{r['sequences']:,}", f"{r['hours']:.2f}", f"{r['frames']:,}", str(r["motions"]),
         abbreviate(r["units"]), abbreviate(r["payloads_kg"])]
        for part, r in rows.items()
    ])  # fmt: skip
    out.say(f"written: {path!s}")
    out.result({"split": str(path), "by": by, "parts": rows})


def _figures(dataset: Data, out: Path, robot: Robot = None, json: Json = False) -> None:
    """Draw the dataset: joint ranges, composition, torque and temperature.

    Args:
        out: Folder for the pictures, each as SVG and PNG.
    """
    from gaponet.report.figures.dataset_figures import write_figures

    screen = Out(json)
    data, spec = open_dataset(dataset, robot)
    with progress_bar("drawing") as update:
        written, left_out = write_figures(data, spec, out, update)
    for path in written:
        screen.say(f"written: {path!s}")
    for name, reason in left_out.items():
        screen.say(f"  {name}: {reason}", "left out", "yellow")
    screen.result({"figures": [str(path) for path in written], "left_out": left_out})


def _export(dataset: Data, out: Path, json: Json = False) -> None:
    """Write a dataset as LeRobotDataset v3.0, one set for each rate; gaponet import reads it back.

    Args:
        out: New folder.
    """
    from gaponet.data.writers import export

    screen = Out(json)
    data = Dataset(dataset)
    with progress_bar("exporting") as update:
        sets = export(data, out, update)
    shown = sets[:20]
    screen.table(str(out), ["set", "episodes", "frames", "fps"], [
        [str(s.path), f"{s.episodes:,}", f"{s.frames:,}", f"{s.fps:g}"] for s in shown
    ])  # fmt: skip
    if len(shown) < len(sets):
        screen.say(f"… and {len(sets) - len(shown)} more")
    screen.say(f"Back: gaponet import {out!s} --robot {data.robot_name} --out NEW")
    screen.result(
        {"sets": [{"path": str(s.path), "episodes": s.episodes, "frames": s.frames} for s in sets]}
    )


def _remove(dataset: Data, ids: tyro.conf.Positional[tuple[str, ...]], json: Json = False) -> None:
    """Remove sequences from a dataset, with their simulated replays; their logs can be imported again.

    Args:
        ids: Ids in sequences.jsonl, or patterns: '*-1kg-*' removes all with a payload of 1 kg.
    """
    out, data = Out(json), Dataset(dataset)
    gone = data.remove(ids)
    out.say(
        f"removed {len(gone)}: {abbreviate([e.id for e in gone])}; {data.path!s} now holds {len(data)}"
    )
    out.result({"removed": [e.id for e in gone], "sequences": len(data)})


@actions(card=_card, split=_split, figures=_figures, export=_export, remove=_remove)
def data(action: None) -> None:
    """A dataset's card, splits, pictures, export and removal."""


def _show_card(out: Out, made: dict[str, Any]) -> None:
    """Counts, repeatability and licence; ranges of all signals stand in CARD.md."""
    from gaponet.data.card import NOT_STATED, PROPERTIES, count_table, headline, paper_table

    out.say("", headline(made))
    for name in PROPERTIES:
        out.show("", count_table(made, name))
    if "beside_paper" in made:
        counts = paper_table(made)
        out.show("Beside the paper's counts", counts)
        out.say(counts.caption)
    repeated = made["repeatability"]
    if repeated["channels"]:
        spread = ", ".join(
            f"{name} {c['mean']:.3g} {c['unit']}" for name, c in repeated["channels"].items()
        )
        out.say(
            f"repeatability (std over {repeated['sequences']} repetitions in {repeated['groups']} groups): {spread}"
        )
    else:
        out.say("repeatability: no motion was repeated with the same command, unit and payload")
    for name in ("licence", "source"):
        ask = f"; set it with gaponet data card DIR --{name} …" if made[name] == NOT_STATED else ""
        out.say(f"{name}: {made[name]}{ask}")
