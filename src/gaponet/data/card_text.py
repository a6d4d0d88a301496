"""The data card as Markdown, for people."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from gaponet.base.result_table import ResultTable
from gaponet.base.text import escape_markdown
from gaponet.data.card import NOT_STATED

TITLES = {"level": "Level", "payload_kg": "Payload, kg per hand", "unit": "Unit", "rate_hz": "Rate, Hz"}
HEADS = {"min": "least", "p1": "1 %", "mean": "mean", "p99": "99 %", "max": "greatest", "std": "std"}
ASK = "set with `gaponet data card DIR --{0} …`"


def card_text(card: dict[str, Any]) -> str:
    """The card as Markdown; the first line says whether robots were virtual."""
    return "\n".join(
        [
            f"# {escape_markdown(headline(card))}",
            "",
            *_facts(card),
            *_shares(card),
            *_repeatability(card),
            *_signals(card),
        ]
    )


def headline(card: dict[str, Any]) -> str:
    """ "demo: 128 sequences, 0.39 h of h1_2, all on VIRTUAL robots"."""
    total, virtual = card["total"], card["virtual_sequences"]
    kind = "" if not virtual else ", all on VIRTUAL robots" if virtual == total["sequences"] else ""
    kind = kind or (f", {virtual} of them on VIRTUAL robots" if virtual else "")
    return f"{card['name']}: {total['sequences']:,} sequences, {total['hours']:.2f} h of {card['robot']}{kind}"


def _facts(card: dict[str, Any]) -> Iterator[str]:
    total = card["total"]
    for name in ("licence", "source"):
        value = card[name]
        yield f"- {name}: {escape_markdown(value)}" + (f"; {ASK.format(name)}" if value == NOT_STATED else "")
    recorded = card["recorded"]
    dates = recorded if isinstance(recorded, str) else " to ".join(dict.fromkeys(recorded))
    yield f"- recorded: {escape_markdown(dates)}"
    if card["collected"]:
        fleet, seed = (escape_markdown(str(card["collected"].get(name))) for name in ("fleet", "seed"))
        yield f"- made by gaponet collect: fleet {fleet}, seed {seed}"
    yield f"- {total['frames']:,} frames of {len(card['joints'])} joints, {total['motions']} motions"
    yield f"- {card['bytes'] / 1e6:,.1f} MB, dataset hash {card['dataset_hash']}, gaponet {card['gaponet']}"
    yield ""
    yield "Every number was counted or measured from the files; `gaponet data card DIR` writes this page again."
    yield ""


def shares(card: dict[str, Any], by: str) -> ResultTable:
    """How much there is, by one of TITLES."""
    rows = tuple((key, c["sequences"], c["hours"], c["frames"], c["motions"]) for key, c in card["shares"][by].items())
    return ResultTable(by, (TITLES[by], "sequences", "hours", "frames", "motions"), rows)


def _shares(card: dict[str, Any]) -> Iterator[str]:
    for name in TITLES:
        yield from (shares(card, name).markdown(), "")


def _repeatability(card: dict[str, Any]) -> Iterator[str]:
    found = card.get("repeatability")
    if found is None:  # only reading all of it says
        return
    yield "## Repeatability"
    yield ""
    if not found["channels"]:
        yield "No motion was repeated with the same command by the same unit with the same payload."
        yield ""
        return
    yield (
        f"Standard deviation over repetitions of the same command, root mean square over rows; {found['groups']:,} "
        f"groups, {found['sequences']:,} sequences; joints that were commanded to move."
    )
    if found["left_out_other_command"]:
        yield f"{found['left_out_other_command']:,} sequences of these groups had another command and were left out."
    yield ""
    channels = found["channels"]
    joints = dict.fromkeys(j for c in channels.values() for j in c["joints"])
    rows = [(joint, *(_number(c["joints"].get(joint)) for c in channels.values())) for joint in joints]
    mean = ("mean", *(_number(c["mean"]) for c in channels.values()))
    heads = ("joint", *(f"{name}, {c['unit']}" for name, c in channels.items()))
    yield from (ResultTable("repeatability", heads, (*rows, mean)).markdown(), "")


def _signals(card: dict[str, Any]) -> Iterator[str]:
    yield "## Signals"
    yield ""
    for name, signal in card["signals"].items():
        yield f"### {name}, {signal['unit']} ({signal['sequences']:,} sequences)"
        yield ""
        rows = tuple((joint, *map(_number, values.values())) for joint, values in signal["joints"].items())
        heads = ("joint", *(HEADS[k] for k in next(iter(signal["joints"].values()))))
        yield from (ResultTable(name, heads, rows).markdown(), "")


def _number(value: float | None) -> str:
    """Three digits that count; a dash for nothing."""
    return "–" if value is None else f"{value:.3g}"
