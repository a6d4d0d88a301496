"""Cells of a comparison: every (model, seed) a job, as many at once as there are cores, or on a cluster.

Each cell simulates and learns on one thread. Cells that share a thread pool wait for each other: two trainings at once
with two threads each took three times as long as one after the other.
"""

from __future__ import annotations

import json
import os
import re
import time
import traceback
from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from gaponet.base.errors import GAPONetError, UsageError, missing_extra
from gaponet.base.executor import POLL_INTERVAL_S, Pool
from gaponet.base.files import FOLDER_MARKER, lock_folder, write_text
from gaponet.base.progress import Running
from gaponet.data.store import Dataset, dataset_hash
from gaponet.experiments.kept import read_kept
from gaponet.experiments.variant import Variant
from gaponet.nn.delay_offset import DelayOffset
from gaponet.nn.training.budget import Budget
from gaponet.nn.training.config import TrainConfig
from gaponet.robot.spec import RobotSpec
from gaponet.share.reading import load_dataset
from gaponet.sim.model import model_hash

Tell = Callable[[float, str], None]  # share done, what is going on

SETUP, RESULT = "setup.json", "cell.json"
LOST = 180.0  # s without a sign of the parent; what a shared folder shows may be a minute old
PATIENCE = 60.0  # s; the cells of a comparison that was killed notice it at their next step


@dataclass(frozen=True)
class Cell:
    """One model, one seed: a run folder that also says how it was set up (setup.json) and what came out (cell.json)."""

    variant: Variant
    seed: int
    folder: Path
    dataset: str
    """Folder, or address."""
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
        config = replace(self.variant.config, seed=self.seed, threads=0).sized()
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
    data = dataset.address or str(dataset.path.resolve())
    cells = [
        Cell(v, seed, place(v, seed), data, robots(v), budget, holdout_units, threads)
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
        kept["config"] = _completed(kept["config"], json.loads(json.dumps(asdict(TrainConfig().sized()))))
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

    from gaponet.nn.artifact import GapModel
    from gaponet.nn.networks import build_network
    from gaponet.nn.training.budget import Status
    from gaponet.nn.training.trainer import Trainer

    torch.set_num_threads(cell.threads)
    config = replace(cell.variant.config, seed=cell.seed, threads=cell.threads)
    card = _card(cell.folder)
    if not card or card["interrupted"]:
        data = load_dataset(cell.dataset)

        def show(s: Status) -> None:
            tell(s.fraction, s.note)

        budget = Budget.parse(cell.budget)
        with lock_folder(cell.folder, "run", wait=PATIENCE):
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


@dataclass
class _Post:
    """How a cell tells its parent how far it is, and learns that nobody waits for it: two files that both can see.

    The parent touches `alive` all the time and removes it when it goes.
    """

    said: Path
    alive: Path
    last: float = 0.0
    beat: float = 0.0
    heard: float = 0.0

    def __call__(self, share: float, note: str) -> None:
        now = time.monotonic()
        if now - self.last < POLL_INTERVAL_S:
            return
        self.last = now
        try:
            beat = self.alive.stat().st_mtime
        except FileNotFoundError:
            raise KeyboardInterrupt from None
        if beat != self.beat:
            self.beat, self.heard = beat, now
        elif now - self.heard > LOST:
            raise KeyboardInterrupt
        self.said.write_text(json.dumps([share, note]), encoding="utf-8")


def run_cells(
    cells: ListOf[Cell],
    work: Callable[[Cell, Tell], None],
    pool: Pool,
    show: Callable[[Running, int], None] = lambda running, done: None,
) -> dict[str, str]:
    """Do the work of each cell somewhere; returns the failures, name → reason.

    Args:
        work: What to do with one; a module's function.
        pool: Its workers see the cells' folders and the dataset under the same paths.
        show: Called with the running cells and how many are done, all the time.

    Raises:
        KeyboardInterrupt: After every running cell has kept what it reached.
    """
    failed, done, own = dict[str, str](), 0, f"{FOLDER_MARKER}-{os.getpid()}-"
    cells = [replace(c, folder=c.folder.absolute()) for c in cells]
    shown: tuple[Running, int] = {}, 0
    alive = cells[0].folder.with_name(f"{own}alive")
    posts = {c.name: _Post(c.folder.with_name(own + c.folder.name), alive) for c in cells}

    def look() -> None:
        nonlocal shown
        os.utime(alive)
        now = {name: told for name, post in posts.items() if (told := _told(post.said))}, done
        if now != shown:
            shown = now
            show(*now)

    def stop(job: tuple[Cell, _Post]) -> bool:
        alive.unlink(missing_ok=True)
        return job[1].said.exists()

    for cell in cells:
        cell.folder.parent.mkdir(parents=True, exist_ok=True)
    alive.touch()
    try:
        for outcome in pool.run(partial(_cell, work), ((c, posts[c.name]) for c in cells), look, stop):
            cell, post = outcome.job
            reason = outcome.value if outcome.error is None else str(outcome.error)
            failed |= {cell.name: reason} if reason else {}
            post.said.unlink(missing_ok=True)
            done += 1
            look()
    finally:
        for file in (alive, *(post.said for post in posts.values())):
            file.unlink(missing_ok=True)
    return failed


def _told(file: Path) -> tuple[float, str] | None:
    """What a running cell said last."""
    try:
        share, note = json.loads(file.read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):  # not yet, or just being written
        return None
    return float(share), str(note)


def _cell(work: Callable[[Cell, Tell], None], job: tuple[Cell, _Post]) -> str | None:
    """A cell in its worker; returns why it failed."""
    cell, tell = job
    file = cell.folder.with_name(cell.folder.name + ".error.txt")
    try:
        tell(0.0, "starting")
        file.unlink(missing_ok=True)
        work(cell, tell)
    except KeyboardInterrupt:
        return "nobody waited for it any more; what it reached is kept"
    except (GAPONetError, OSError) as error:  # a full disk is no bug
        return str(error)
    except Exception as error:
        missing = missing_extra(error) if isinstance(error, ModuleNotFoundError) else None
        if missing is None:
            write_text(file, traceback.format_exc())
        return missing or f"{type(error).__name__}: {error} (see {file})"
    return None
