"""The work of one cell's process: training, then evaluation on the test motions.

Units that were held out from training form a group of their own in every outcome.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from gaponet.base.files import lock_folder, write_json, write_text
from gaponet.data.sequence import Sequence
from gaponet.data.store import Dataset
from gaponet.experiments.cells import RESULT_FILE, SETUP_FILE, Cell, Report, read_record
from gaponet.nn.artifact import GapModel
from gaponet.nn.delay_offset import DelayOffset
from gaponet.nn.training.budget import Budget, Status
from gaponet.report.candidate import select_entries
from gaponet.robot.spec import RobotSpec
from gaponet.share.reading import load_dataset
from gaponet.sim.metrics import runs, summary
from gaponet.sim.replay import Corrector, replay

Outcome = dict[str, Any]  # contents of a cell.json, or of a baseline's part of one
LOCK_TIMEOUT_S = 60.0  # the cells of a comparison that was killed notice it at their next step
CARD_FACTS = ("steps", "seconds", "val_mpjae", "gain", "sensor_r2", "parity_rad")


def train_and_evaluate(cell: Cell, report: Report) -> None:
    """Train a cell and write its cell.json."""
    training = train_cell(cell, report)
    report(1.0, "evaluation")
    outcome = evaluate_model(cell.folder, load_dataset(cell.dataset), cell.robot, cell.holdout_units, cell.threads)
    start = "identified" if cell.robot.nominal is not None else "nominal"
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
            trainer = Trainer.prepare(
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
        return (place / "split.json").read_text(encoding="utf-8"), read_record(place / SETUP_FILE)["simulator"]

    for other in sorted(folder.parent.glob("*/delay_offset.json")):
        if key(folder) == key(other.parent):
            return DelayOffset.read(other.parent)
    return None


def _card(folder: Path) -> dict[str, Any]:
    file = folder / "model" / "card.json"
    return read_record(file) if file.is_file() else {}


def evaluate_model(
    run: Path, dataset: Dataset, robot: RobotSpec, holdout: tuple[str, ...], nthread: int = 0
) -> Outcome:
    """Evaluate a run's artifact on its test motions, by group of units."""
    model = GapModel.load(run)
    sequences = dataset.sequences(select_entries([run], dataset)[0])
    for dt in sorted({s.dt for s in sequences}):
        model.require(robot, dt)
    return _by_group(sequences, robot, model.corrector(robot), holdout, nthread)


def evaluate_baselines(
    run: Path, dataset: Dataset, nominal: RobotSpec, identified: RobotSpec | None, holdout: tuple[str, ...]
) -> Outcome:
    """Evaluate the nominal simulator, the run's delay + offset and the identified simulator on its test motions."""
    sequences = dataset.sequences(select_entries([run], dataset)[0])
    outcomes = {
        "nominal": _by_group(sequences, nominal, None, holdout),
        "delay_offset": _by_group(sequences, nominal, DelayOffset.read(run).corrector(nominal), holdout),
    }
    return outcomes | ({} if identified is None else {"identified": _by_group(sequences, identified, None, holdout)})


def _by_group(
    sequences: list[Sequence], robot: RobotSpec, corrector: Corrector | None, holdout: tuple[str, ...], nthread: int = 0
) -> Outcome:
    """Return {"known": summary, "new": summary of the units held out}; a group without recordings is left out."""
    replays = replay(sequences, robot, corrector, nthread, lock_idle=True)
    done = runs(sequences, [t.qpos for t in replays], robot)
    groups = {name: [r for r in done if (r.meta.unit_id in holdout) == new] for name, new in (("known", 0), ("new", 1))}
    return {name: summary(part, robot) for name, part in groups.items() if part}
