"""The work of a cell's process, and what its artifact and the baselines are worth: free runs on the test motions.

Units held out from training form a group of their own: what is said of the units trained on is not mixed with what is
said of a unit never seen.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from gaponet.base.files import write_json
from gaponet.data.sequence import Sequence
from gaponet.data.store import Dataset
from gaponet.experiments.pool import RESULT, Cell, Tell, train_cell
from gaponet.nn.artifact import GapModel
from gaponet.nn.delay_offset import DelayOffset
from gaponet.report.candidate import choose
from gaponet.robot.spec import RobotSpec
from gaponet.share.reading import load_dataset
from gaponet.sim.metrics import Run, runs, summary
from gaponet.sim.replay import Corrector, replay

Outcome = dict[str, Any]


def train_and_evaluate(cell: Cell, tell: Tell) -> None:
    """Train a cell and write its cell.json."""
    told = train_cell(cell, tell)
    tell(1.0, "evaluation")
    found = evaluate_model(cell.folder, load_dataset(cell.dataset), cell.robot, cell.holdout_units, cell.threads)
    start = "identified" if cell.robot.nominal is not None else "nominal"
    told |= {"kind": cell.variant.kind, "changes": list(cell.variant.changes), "start": start}
    write_json(cell.folder / RESULT, told | found)


def evaluate_model(
    run: Path, dataset: Dataset, robot: RobotSpec, holdout: tuple[str, ...], nthread: int = 0
) -> Outcome:
    """Metrics of a run's artifact on the test motions, by group of units."""
    model = GapModel.load(run)
    sequences = dataset.sequences(choose([run], dataset)[0])
    for dt in sorted({s.dt for s in sequences}):
        model.require(robot, dt)
    return _grouped(sequences, robot, model.corrector(robot), holdout, nthread)


def evaluate_baselines(
    run: Path, dataset: Dataset, nominal: RobotSpec, identified: RobotSpec | None, holdout: tuple[str, ...]
) -> Outcome:
    """The same of the nominal simulator, of delay + offset as kept in a run, and of the identified simulator."""
    fitted = DelayOffset.read(run)
    sequences = dataset.sequences(choose([run], dataset)[0])
    out = {
        "nominal": _grouped(sequences, nominal, None, holdout),
        "delay_offset": _grouped(sequences, nominal, fitted.corrector(nominal), holdout),
    }
    return out if identified is None else out | {"identified": _grouped(sequences, identified, None, holdout)}


def _grouped(
    sequences: list[Sequence], robot: RobotSpec, corrector: Corrector | None, holdout: tuple[str, ...], nthread: int = 0
) -> Outcome:
    """{"known": summary, "new": summary of units held out, where there are any}."""
    twins = replay(sequences, robot, corrector, nthread, lock_idle=True)
    done = runs(sequences, [t.qpos for t in twins], robot)
    of: Callable[[bool], list[Run]] = lambda new: [r for r in done if (r.meta.unit_id in holdout) == new]  # noqa: E731
    return {name: summary(of(new), robot) for name, new in (("known", False), ("new", True)) if of(new)}
