"""The paper's experiment as a public function."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from gaponet.api.opening import Place, open_dataset
from gaponet.base.progress import Running
from gaponet.data.store import Dataset
from gaponet.experiments.paper.options import DEMO as DEMO
from gaponet.experiments.paper.options import PaperOptions as PaperOptions

if TYPE_CHECKING:
    from gaponet.experiments.paper.experiment import OpenBar, OpenBars
    from gaponet.experiments.paper.experiment import PaperResult as PaperResult


@contextmanager
def _no_bar(title: str) -> Iterator[Callable[[float], None]]:
    yield lambda share: None


@contextmanager
def _no_bars(title: str, total: int) -> Iterator[Callable[[Running, int], None]]:
    yield lambda running, done: None


def paper_experiment(
    dataset: Dataset | Place,
    *,
    out: Place,
    options: PaperOptions = PaperOptions(),  # noqa: B008
    open_bar: OpenBar = _no_bar,
    open_bars: OpenBars = _no_bars,
) -> PaperResult:
    """Run the experiment of the paper "SimLifter and GAPONet": its claims, Figures 2 and 3, Tables
    1 and 2.

    Every network has the same recordings, inputs, training and seeds. All are measured on motions
    and on a unit that no network has seen. The same call continues an interrupted experiment.

    Args:
        dataset: Recordings of a VIRTUAL fleet (gaponet collect), or of a real robot. Of a real
            robot simulators are compared on its test motions, and nothing is commanded.
        out: Folder of the results; OUT/paper.html is the page.
        options: Size of the experiment, and where it runs.
        open_bar: Opens a progress bar: title → update(share).
        open_bars: Opens the bars of the trainings: title and number → show(running, done).

    Returns:
        Claims, tables (Q_dis in rad·s, MPJAE in mrad, offsets in cm) and the page.

    Raises:
        UsageError: The dataset or the folder does not fit, or a motion of the experiment was
            recorded.
        ModelError: Every training failed.
    """
    from gaponet.experiments.paper.experiment import run_paper_experiment

    data, robot = open_dataset(dataset, options.robot)
    return run_paper_experiment(data, robot, Path(out), options, open_bar, open_bars)
