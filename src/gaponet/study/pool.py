"""Cells of a comparison: every (model, seed) in a process of its own, as many at once as there are cores.

Each cell simulates and learns on one thread. Cells that share a thread pool wait for each other: two trainings at once
with two threads each took three times as long as one after the other (docs/log.md).
"""

from __future__ import annotations

import json
import os
import re
import signal
import time
import traceback
from collections.abc import Callable, Iterator
from collections.abc import Sequence as ListOf
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from gaponet.data.json_file import read_kept
from gaponet.data.store import Dataset, dataset_hash
from gaponet.errors import GAPONetError, UsageError, missing_extra
from gaponet.files import write_text, writing
from gaponet.model.baselines.delay_offset import DelayOffset
from gaponet.progress import Running
from gaponet.robot import RobotSpec
from gaponet.sim.model import model_hash
from gaponet.study.variant import Variant
from gaponet.training.budget import Budget
from gaponet.training.config import TrainConfig

Tell = Callable[[float, str], None]  # share done, what is going on

SETUP, RESULT = "setup.json", "cell.json"
POOLS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
TELL_EVERY = 0.3  # s
PATIENCE = 60.0  # s; the cells of a comparison that was killed notice it at their next step


@dataclass(frozen=True)
class Cell:
    """One model, one seed: a run folder that also says how it was set up (setup.json) and what came out (cell.json)."""

    variant: Variant
    seed: int
    folder: Path
    dataset: Path
    robot: RobotSpec
    """The simulator corrected."""
    budget: str
    holdout_units: tuple[str, ...] = ()
    threads: int = 1

    @property
    def name(self) -> str:
        """Name of the cell for people: model and seed."""
        return f"{self.variant.name} seed {self.seed}"

    @property
    def done(self) -> bool:
        """Whether the cell is trained and evaluated."""
        return (self.folder / RESULT).is_file()

    def setup(self, data: Dataset) -> dict[str, Any]:
        """Everything that a kept cell must agree in; threads change nothing but the time."""
        config = replace(self.variant.config, seed=self.seed, threads=0)
        return json.loads(json.dumps({
            "config": asdict(config), "budget": self.budget, "holdout_units": list(self.holdout_units),
            "dataset": dataset_hash(data.entries), "simulator": model_hash(self.robot),
        }))  # fmt: skip


def plan(
    dataset: Dataset,
    variants: ListOf[Variant],
    seeds: ListOf[int],
    robots: Callable[[Variant], RobotSpec],
    out: Path,
    budget: str,
    holdout_units: tuple[str, ...],
    threads: int = 1,
) -> list[Cell]:
    """All cells, seed by seed, so that what is done first is a comparison already.

    Raises:
        UsageError: The same model twice, or a cell kept in out that was set up differently.
    """
    names = [v.name for v in variants]
    if len(set(names)) < len(names):
        raise UsageError(f"--models: '{max(names, key=names.count)}' is there twice; name each once, seeds repeat it")
    Budget.parse(budget)
    place = lambda v, seed: out / "cells" / f"{re.sub(r'[^A-Za-z0-9_.=+-]+', '_', v.name)}-{seed}"  # noqa: E731
    cells = [
        Cell(v, seed, place(v, seed), dataset.path.resolve(), robots(v), budget, holdout_units, threads)
        for seed in seeds
        for v in variants
    ]
    for cell in cells:
        if not cell.folder.exists():
            continue
        file, wanted = cell.folder / SETUP, cell.setup(dataset)
        if not file.is_file():
            raise UsageError(f"{cell.folder}: is there but is no part of a comparison; choose another --out")
        kept = read_kept(file)
        kept["config"] = _completed(kept["config"], json.loads(json.dumps(asdict(TrainConfig()))))
        if kept != wanted:
            changed = ", ".join(k for k in wanted if kept.get(k) != wanted[k])
            raise UsageError(f"{cell.folder}: kept from a comparison with another {changed}; choose another --out")
    return cells


def _completed(kept: dict[str, Any], defaults: dict[str, Any]) -> dict[str, Any]:
    """A config written before some of today's fields existed, with their defaults."""
    nested = {k: _completed(kept[k], v) for k, v in defaults.items() if isinstance(v, dict) and k in kept}
    return defaults | kept | nested


def train_cell(cell: Cell, tell: Tell) -> dict[str, Any]:
    """Train the cell, or what is left of it; returns what its table row says about training.

    Raises:
        KeyboardInterrupt: Training was interrupted; what was reached is kept for the next time.
    """
    import torch

    from gaponet.model.artifact import GapModel
    from gaponet.model.deeponet import build_network
    from gaponet.training.budget import Status
    from gaponet.training.run import Trainer

    torch.set_num_threads(cell.threads)
    config = replace(cell.variant.config, seed=cell.seed, threads=cell.threads)
    card = _card(cell.folder)
    if not card or card["interrupted"]:
        data = Dataset(cell.dataset)

        def show(s: Status) -> None:
            tell(s.fraction, s.note)

        budget = Budget.parse(cell.budget)
        with writing(cell.folder, "run", wait=PATIENCE):
            resume = (cell.folder / "checkpoint.pt").is_file()
            write_text(cell.folder / SETUP, json.dumps(cell.setup(data), indent=1) + "\n")
            trainer = Trainer(data, cell.robot, cell.folder, config, budget, resume, cell.holdout_units, show)
            trainer.baseline = _fitted_beside(cell.folder)
            trainer.run()
        card = _card(cell.folder)
        if card["interrupted"]:
            raise KeyboardInterrupt
    net = build_network(config.model, len(cell.robot.operated))
    return {
        "seed": cell.seed,
        "parameters": sum(p.numel() for p in net.parameters()),
        "weights": GapModel.load(cell.folder).weights_hash(),
        **{k: card[k] for k in ("steps", "seconds", "val_mpjae", "gain", "sensor_r2", "parity_rad")},
    }


def _fitted_beside(folder: Path) -> DelayOffset | None:
    """Delay and offset as another cell has fitted them to the same recordings and simulator; a fit takes a while."""

    def same(other: Path) -> bool:
        split = [(f / "split.json").read_text(encoding="utf-8") for f in (folder, other)]
        setup = [read_kept(f / SETUP)["simulator"] for f in (folder, other)]
        return split[0] == split[1] and setup[0] == setup[1]

    for other in sorted(folder.parent.glob("*/delay_offset.json")):
        if same(other.parent):
            return DelayOffset.read(other.parent)
    return None


def _card(folder: Path) -> dict[str, Any]:
    file = folder / "model" / "card.json"
    return read_kept(file) if file.is_file() else {}


def run_cells(
    cells: ListOf[Cell],
    work: Callable[[Cell, Tell], None],
    workers: int,
    show: Callable[[Running, int], None] = lambda running, done: None,
) -> dict[str, str]:
    """Do the work of each cell in a process of its own; returns the failures, name → reason.

    Args:
        work: What to do with one; a module's function, since processes are spawned.
        show: Called with the running cells and how many are done, whenever something changes.

    Raises:
        KeyboardInterrupt: After every running cell has kept what it reached.
    """
    waiting, failed, context = list(cells), dict[str, str](), get_context("spawn")
    running: dict[Connection, tuple[Cell, BaseProcess]] = {}
    state: Running = {}
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                cell, (here, there) = waiting.pop(0), context.Pipe(duplex=False)
                process: BaseProcess = context.Process(
                    target=_child, args=(cell, work, there, os.getpid()), daemon=True
                )
                with _one_thread_each(cell.threads):
                    process.start()
                there.close()
                running[here], state[cell.name] = (cell, process), (0.0, "starting")
            for pipe in wait(list(running)):
                assert isinstance(pipe, Connection)
                cell, worker = running[pipe]
                try:
                    message = pipe.recv()
                    if isinstance(message, str):
                        failed[cell.name] = message
                    else:
                        state[cell.name] = message
                except EOFError:
                    worker.join()
                    pipe.close()
                    del running[pipe], state[cell.name]
                    if worker.exitcode and cell.name not in failed:
                        failed[cell.name] = f"its process ended with {worker.exitcode}; out of memory?"
            show(dict(state), len(cells) - len(waiting) - len(running))
    finally:
        for _, worker in running.values():
            worker.terminate()
        for _, worker in running.values():
            worker.join()
    return failed


def _child(cell: Cell, work: Callable[[Cell, Tell], None], pipe: Connection, parent: int) -> None:
    """A cell's process. Ctrl-C in the terminal reaches parent and children: the parent tells the children, once."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    last = 0.0

    def tell(share: float, note: str) -> None:
        nonlocal last
        if time.monotonic() - last < TELL_EVERY:
            return
        last = time.monotonic()
        if os.getppid() != parent:
            raise KeyboardInterrupt  # nobody waits for this cell any more
        pipe.send((share, note))

    file = cell.folder.with_name(cell.folder.name + ".error.txt")
    try:
        file.unlink(missing_ok=True)
        work(cell, tell)
    except KeyboardInterrupt:
        os._exit(130)
    except (GAPONetError, OSError) as error:  # a full disk is no bug
        pipe.send(str(error))
    except Exception as error:
        missing = missing_extra(error) if isinstance(error, ModuleNotFoundError) else None
        if missing is not None:
            pipe.send(missing)
            return
        file.parent.mkdir(parents=True, exist_ok=True)
        write_text(file, traceback.format_exc())
        pipe.send(f"{type(error).__name__}: {error} (see {file})")


@contextmanager
def _one_thread_each(threads: int) -> Iterator[None]:
    """What libraries read from the environment when a process starts."""
    before = {name: os.environ.get(name) for name in POOLS}
    os.environ.update(dict.fromkeys(POOLS, str(threads)))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
