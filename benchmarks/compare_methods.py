"""Compare methods on public recordings of real robots.

    python benchmarks/compare_methods.py --data FOLDER

docs/benchmark.md says what is asked and how somebody adds a method or a data set.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import tyro
from real_robots.bench import Bench, load_method
from real_robots.cards import data_folder, read_cards
from real_robots.methods import METHODS, network_methods
from real_robots.page import result_table, write_page

from gaponet.cli.options import Json
from gaponet.cli.out import Out


def compare(
    data: Path | None = None,
    out: Path = Path("bench_real"),
    sets: tuple[str, ...] = (),
    questions: tuple[str, ...] = (),
    method: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
    networks: int = 0,
    json: Json = False,
) -> None:
    """Compare methods on public recordings of real robots.

    The exit code is 1 if a method failed; the other rows are there, and the same command tries
    again.

    Args:
        data: Folder of the public recordings; default GAPONET_DATA, else ../shared/data.
        out: Folder for datasets, table and figure.
        sets: Only these data sets.
        questions: Only these questions, such as "3 kg left out".
        method: A method of your own, FILE.py:FUNCTION; may be repeated.
        networks: Train networks too, for so many control steps each; 0 for none.
    """
    screen = Out(json)
    methods = METHODS | {name: (name, function) for name, function in map(load_method, method)}
    if networks:
        methods |= network_methods(networks)
    bench = Bench(read_cards(), data_folder(data), out, methods, screen.say)
    result = bench.run(sets, questions)
    screen.show(
        "Real robots, recordings that no method was fitted to", result_table(result["rows"])
    )
    for name, remarks in result["labels"].items():
        screen.say(f" of {name}: {'; '.join(remarks)}", "labels")
    for path in write_page(result, out):
        screen.say(f"written: {path!s}")
    screen.result(result)
    if bench.failed:
        sys.exit(f"no rows of: {'; '.join(bench.failed)}")


if __name__ == "__main__":
    tyro.cli(compare)
