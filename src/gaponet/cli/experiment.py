"""gaponet experiment: the paper's experiment."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from gaponet.api.paper import PaperOptions, paper_experiment
from gaponet.base.errors import ModelError, UsageError
from gaponet.base.progress import progress_bar, progress_bars
from gaponet.cli.options import Data, Json
from gaponet.cli.out import Out, writes

if TYPE_CHECKING:
    from gaponet.api.paper import PaperResult

TITLES = {  # of tables on the terminal; the page numbers them too
    "claims_labels": "The paper's claims (labels)",
    "claims_ppo": "The paper's claims (PPO alone)",
    "beside_paper": "Figure 2: the recordings",
    "figure3_labels": "Figure 3 (labels)",
    "figure3_ppo": "Figure 3 (PPO alone)",
    "table1_labels": "Table 1 (labels)",
    "table1_ppo": "Table 1 (PPO alone)",
    "commands_labels": "Commands on the robot (labels)",
    "commands_ppo": "Commands on the robot (PPO alone)",
    "table2": "Table 2",
    "sensors": "What the Sensor Predictor saves",
    "methods": "Methods",
    "large_gaps_labels": "Large gaps (labels)",
    "large_gaps_ppo": "Large gaps (PPO alone)",
}


@writes("experiments")
def experiment(
    name: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="paper")],
    dataset: Data,
    out: Path,
    options: Annotated[PaperOptions, tyro.conf.arg(name="")] = PaperOptions(),  # noqa: B008
    json: Json = False,
) -> None:
    """Run the paper's experiment; show its numbers beside the paper's.

    Every network has the same recordings, inputs, training and seeds, and is measured on motions
    and on a unit that no network has seen. The same command continues an interrupted experiment.
    On two cores it takes a night with three seeds, and about two hours with one.

    Args:
        name: The word "paper"; there is no other experiment.
        out: Folder for the results. OUT/paper.html shows them.
        options: Size of the experiment, and where it runs.
    """
    if name != "paper":
        raise UsageError(f"{name}: no such experiment; there is: paper")
    screen = Out(json)
    result = paper_experiment(
        dataset, out=out, options=options, open_bar=share_bar, open_bars=progress_bars
    )
    show_paper_result(screen, result, tuple(result.tables))
    screen.say(f"written: {result.page}")
    screen.result(
        {
            "page": str(result.page),
            "sentences": result.sentences,
            "tables": {name: table.record() for name, table in result.tables.items()},
        }
    )
    if result.failures:
        raise ModelError(f"{len(result.failures)} trainings failed; run it again to retry")


def show_paper_result(screen: Out, result: PaperResult, shown: tuple[str, ...]) -> None:
    """Print the tables of these names, and the conclusions."""
    for name, table in result.tables.items():
        if name not in shown:
            continue
        screen.show(TITLES.get(name, name), table)
        if table.caption:
            screen.say(table.caption)
    for sentence in result.sentences:
        screen.say(f"- {sentence}")


@contextmanager
def share_bar(title: str) -> Iterator[Callable[[float], None]]:
    """Open a progress bar that is told the share done."""
    with progress_bar(title) as update:
        yield lambda share: update(share, 1.0, "")
