"""gaponet bench real: methods on public recordings of real robots."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from gaponet.cli.options import Json
from gaponet.cli.out import Out


def bench(
    what: tyro.conf.Positional[Literal["real"]],
    data: Path | None = None,
    out: Path = Path("bench_real"),
    sets: tuple[str, ...] = (),
    questions: tuple[str, ...] = (),
    method: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
    networks: int = 0,
    adversary: Literal["", "labels", "asked_labels", "late", "all_late", "joints"] = "",
    json: Json = False,
) -> None:
    """Compare methods on public recordings of real robots.

    Args:
        what: real: docs/benchmark.md.
        data: Folder of the public recordings; default GAPONET_DATA, else ../shared/data.
        out: Folder for datasets, table and figure.
        sets: Only these data sets.
        questions: Only these questions, such as "3 kg left out".
        method: A method of your own, FILE.py:FUNCTION; may be repeated.
        networks: Train networks too, for so many control steps each; 0 for none.
        adversary: What is done to the recordings that are learned from: labels dealt out anew, or those of
            the recordings asked (asked_labels); late, 40 ms of delay added to one in ten, or to all of them and to
            those asked (all_late); joints in another order.
    """
    from gaponet.experiments.real.bench import Bench, load_method
    from gaponet.experiments.real.cards import data_folder, read_cards
    from gaponet.experiments.real.page import COLUMNS, table, write_page
    from gaponet.experiments.real.rivals import METHODS

    screen = Out(json)
    methods = METHODS | {name: (name, function) for name, function in map(load_method, method)}
    if networks:
        from gaponet.experiments.real.networks import networks as trained

        methods |= trained(networks)
    found = Bench(read_cards(), data_folder(data), out, methods, adversary, screen.say).run(sets, questions)
    screen.table("Real robots, recordings that no method was fitted to", list(COLUMNS), table(found["rows"]))
    for name, remarks in found["labels"].items():
        screen.say(f" of {name}: {'; '.join(remarks)}", "labels")
    for path in write_page(found, out):
        screen.say(f"written: {path!s}")
    screen.result(found)
