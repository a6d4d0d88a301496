"""Training and evaluation of the cells of a study, and the outcomes of cells and baselines on the same test motions.

Units that were held out from training form a group of their own in every outcome.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gaponet.base.errors import ModelError
from gaponet.base.executor import open_pool
from gaponet.base.files import lock_folder, write_json, write_text
from gaponet.base.progress import Running
from gaponet.base.result_table import MeanStd, ResultTable
from gaponet.data.sequence import Sequence
from gaponet.experiments.cells import RESULT_FILE, SETUP_FILE, Cell, Report, read_record, run_cells
from gaponet.experiments.result import Result, facts
from gaponet.experiments.study import Study
from gaponet.nn.artifact import GapModel
from gaponet.nn.delay_offset import DelayOffset
from gaponet.nn.training.config import Budget, Status
from gaponet.report.candidate import describe_provenance, select_entries, split_of_run
from gaponet.robot.spec import RobotSpec
from gaponet.share.reading import load_dataset
from gaponet.sim.metrics import runs, summary
from gaponet.sim.model import model_hash
from gaponet.sim.replay import Corrector, replay

if TYPE_CHECKING:
    from matplotlib.figure import Figure


BASELINES = ("nominal", "delay_offset", "identified")
Show = Callable[
    [Running, int], None
]  # called with the running cells and the number of finished ones
Outcome = dict[str, Any]  # contents of a cell.json, or of a baseline's part of one
LOCK_TIMEOUT_S = 60.0  # the cells of a comparison that was killed notice it at their next step
CARD_FACTS = ("steps", "seconds", "val_mpjae", "gain", "sensor_r2", "parity_rad")


def train_and_evaluate(cell: Cell, report: Report) -> None:
    """Train a cell and write its cell.json."""
    training = train_cell(cell, report)
    report(1.0, "evaluation")
    data, model, robot = load_dataset(cell.dataset), GapModel.load(cell.folder), cell.robot
    sequences = data.sequences(select_entries([cell.folder], data)[0])
    for dt in sorted({s.dt for s in sequences}):
        model.require(robot, dt)
    outcome = _by_group(sequences, robot, model.corrector(robot), cell.holdout_units, cell.threads)
    start = "identified" if robot.nominal is not None else "nominal"
    training |= {"kind": cell.variant.kind, "changes": list(cell.variant.changes), "start": start}
    write_json(cell.folder / RESULT_FILE, training | outcome)


def train_cell(cell: Cell, report: Report) -> dict[str, Any]:
    """Train the cell, or resume its training. Return the training's part of cell.json.

    Raises:
        KeyboardInterrupt: Training was interrupted; its checkpoint is resumed the next time.
    """
    import torch  # here, so that the parent process and --help do not load it

    from gaponet.nn.networks import build_network
    from gaponet.nn.training.trainer import Trainer

    torch.set_num_threads(cell.threads)
    config = replace(cell.variant.config, seed=cell.seed, threads=cell.threads)
    card = _card(cell.folder)
    if not card or card["interrupted"]:
        data = load_dataset(cell.dataset)

        def show(status: Status) -> None:
            report(status.fraction, status.note)

        with lock_folder(cell.folder, "run", wait=LOCK_TIMEOUT_S):
            resume = (cell.folder / "checkpoint.pt").is_file()
            write_text(cell.folder / SETUP_FILE, json.dumps(cell.setup(data), indent=1) + "\n")
            budget = Budget.parse(cell.budget)
            trainer = Trainer(
                data, cell.robot, cell.folder, config, budget,
                resume=resume, holdout_units=cell.holdout_units, show=show,
            )  # fmt: skip
            trainer.baseline = _baseline_of_another_cell(cell.folder)
            trainer.run()
        card = _card(cell.folder)
        if card["interrupted"]:
            raise KeyboardInterrupt
    net = build_network(config.model, len(cell.robot.operated))
    return {
        "seed": cell.seed,
        "parameters": sum(p.numel() for p in net.parameters()),
        "weights": GapModel.load(cell.folder).weights_hash(),
        **{k: card[k] for k in CARD_FACTS},
    }


def _baseline_of_another_cell(folder: Path) -> DelayOffset | None:
    """Return delay and offset of another cell with the same split and simulator, since a fit takes time."""

    def key(place: Path) -> tuple[str, str]:
        return (place / "split.json").read_text(encoding="utf-8"), read_record(place / SETUP_FILE)[
            "simulator"
        ]

    for other in sorted(folder.parent.glob("*/delay_offset.json")):
        if key(folder) == key(other.parent):
            return DelayOffset.read(other.parent)
    return None


def _card(folder: Path) -> dict[str, Any]:
    file = folder / "model" / "card.json"
    return read_record(file) if file.is_file() else {}


def _by_group(
    sequences: list[Sequence],
    robot: RobotSpec,
    corrector: Corrector | None,
    holdout: tuple[str, ...],
    nthread: int = 0,
) -> Outcome:
    """Return {"known": summary, "new": summary of the units held out}; a group without recordings is left out."""
    replays = replay(sequences, robot, corrector, nthread, lock_idle=True)
    done = runs(sequences, [t.qpos for t in replays], robot)
    groups = {
        name: [r for r in done if (r.meta.unit_id in holdout) == new]
        for name, new in (("known", 0), ("new", 1))
    }
    return {name: summary(part, robot) for name, part in groups.items() if part}


@dataclass(frozen=True)
class StudyOutcomes:
    """Outcomes of the finished cells by model word."""

    runs: Mapping[str, ListOf[Outcome]]  # outcome of each finished seed, as its cell.json holds it
    baselines: Callable[
        [str], Outcome
    ]  # outcomes of the baselines on the test motions of a model word
    cells: Mapping[str, ListOf[Cell]]  # the finished cells

    @classmethod
    def read(cls, cells: ListOf[Cell], study: Study) -> StudyOutcomes:
        """Read the finished cells. Baselines are simulated on their first use and stored in OUT/baselines."""
        done: dict[str, list[Cell]] = {}
        for cell in cells:
            if cell.done:
                done.setdefault(cell.variant.name, []).append(cell)
        runs = {
            word: [read_record(c.folder / RESULT_FILE) for c in part] for word, part in done.items()
        }
        return cls(runs, cache(lambda word: _baselines(done[word][0], study)), done)

    def of_model(self, word: str) -> ListOf[Outcome]:
        """Return the outcome of each finished seed of a model."""
        return self.runs.get(word, [])

    def result(
        self, study: Study, name: str, title: str, tables: ListOf[ResultTable], figures: Mapping[str, Figure], *,
        sentences: ListOf[str], **more: Any,
    ) -> Result:  # fmt: skip
        """Return the result with the facts that are needed to repeat it."""
        seconds = [outcome["seconds"] for runs in self.runs.values() for outcome in runs]
        holdout = {"holdout_units": list(study.holdout_units)} if study.holdout_units else {}
        repeat = facts(
            study.data, range(study.config.seed, study.config.seed + study.seeds), budget=study.budget,
            trainings=len(seconds), training_hours=round(sum(seconds) / 3600, 2), simulator=model_hash(study.robot),
            **holdout, **more,
        )  # fmt: skip
        return Result(name, f"{title}, {study.label}", describe_provenance(study.data), repeat, tuple(tables),
                      dict(figures), tuple(sentences))  # fmt: skip


def train_all(cells: ListOf[Cell], study: Study, show: Show) -> list[str]:
    """Train and evaluate the unfinished cells. Return a sentence for each that failed.

    Raises:
        ModelError: Every cell failed.
    """
    todo = [c for c in cells if not c.done]
    failed = dict[str, str]()
    if todo:
        with open_pool(study.executor, study.workers, study.threads) as pool:
            failed = run_cells(todo, train_and_evaluate, pool, show)
    if not any(c.done for c in cells):
        raise ModelError(
            f"{study.out}: every training failed; the first: {next(iter(failed.values()))}"
        )
    return [
        f"{name} failed and is not in these numbers: {reason}" for name, reason in failed.items()
    ]


def summarize(outcomes: ListOf[Outcome], *path: str, scale: float = 1e3) -> MeanStd:
    """Mean and standard deviation of one number of several outcomes.

    Args:
        path: Keys that lead to the number; outcomes without it are left out.
        scale: Factor of the number; 1e3 gives mrad.
    """
    values = []
    for value in outcomes:
        for key in path:
            value = value.get(key) if value else None  # type: ignore[assignment]
        if value is not None:
            values.append(float(value))  # type: ignore[arg-type]
    return MeanStd.from_values(values, scale)


def _baselines(cell: Cell, study: Study) -> Outcome:
    """Return the outcomes of the baselines on the cell's test motions, from their file where it exists."""
    delay_offset = (cell.folder / "delay_offset.json").read_text(encoding="utf-8")
    nominal = study.robot.nominal or study.robot
    identified = study.identified or (study.robot if study.robot.nominal else None)
    parts = [*sorted(split_of_run(cell.folder)["test"].values()), delay_offset, model_hash(nominal)]
    parts += [*cell.holdout_units, *([model_hash(identified)] if identified else [])]
    file = (
        study.out
        / "baselines"
        / f"{hashlib.sha256(' '.join(parts).encode()).hexdigest()[:12]}.json"
    )
    if not file.is_file():
        sequences = study.data.sequences(select_entries([cell.folder], study.data)[0])
        correctors = {
            "nominal": None,
            "delay_offset": DelayOffset.read(cell.folder).corrector(nominal),
        }
        outcome = {
            k: _by_group(sequences, nominal, c, cell.holdout_units) for k, c in correctors.items()
        }
        if identified is not None:
            outcome["identified"] = _by_group(sequences, identified, None, cell.holdout_units)
        file.parent.mkdir(parents=True, exist_ok=True)
        write_json(file, outcome)
    return read_record(file)
