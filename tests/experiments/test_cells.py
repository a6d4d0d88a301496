"""Cells of a comparison: each in its own process, kept, failing alone."""

import json
import os
from dataclasses import replace

import pytest
from arm import recordings, write_dataset
from cells import note_threads, wait_for_the_end

from gaponet.base.errors import UsageError
from gaponet.base.executor import open_pool
from gaponet.experiments.cells import SETUP_FILE, run_cells
from gaponet.experiments.outcomes import train_cell
from gaponet.experiments.study import Study
from gaponet.nn.delay_offset import DelayOffset
from gaponet.nn.training.config import PPOConfig, PretrainingConfig, TrainConfig

SMALL = TrainConfig(
    pretraining=PretrainingConfig(
        rounds=1, num_envs=16, steps=40, gradient_steps=40, batch_size=128
    ),
    ppo=PPOConfig(num_envs=16, num_steps=16, epochs=1),
)


@pytest.fixture
def local(tmp_path):
    with open_pool("local", 2, 1) as pool:
        yield pool


@pytest.fixture
def data(arm, tmp_path):
    data = write_dataset(tmp_path / "data", arm, recordings(arm, 8, rows=60, kp=0.5, delay=2))
    return data


def cells(data, arm, out, words=("mlp",), seeds=(0,), budget="640", base=SMALL):
    return Study(data, arm, out, replace(base, seed=seeds[0]), budget, len(seeds)).cells(words)


def test_cells_come_seed_by_seed_in_folders_of_their_own(data, arm, tmp_path):
    made = cells(data, arm, tmp_path / "out", ("gaponet", "mlp:mlp_hidden=8,8"), (0, 1))
    assert [c.folder.name for c in made] == [
        "gaponet-0",
        "mlp_mlp_hidden=8_8-0",
        "gaponet-1",
        "mlp_mlp_hidden=8_8-1",
    ]


def test_a_cell_that_fails_leaves_the_others_alone(data, arm, tmp_path, local, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "5")
    made, shown = cells(data, arm, tmp_path / "out", seeds=(0, 1, 2, 3)), []
    failed = run_cells(
        made, note_threads, local, lambda running, done: shown.append((len(running), done))
    )
    assert failed["mlp seed 1"] == "no such thing"
    assert failed["mlp seed 2"].startswith("ZeroDivisionError: a bug (see ")
    assert failed["mlp seed 3"].startswith("3 workers died of it, out of memory?")
    assert set(failed) == {f"mlp seed {i}" for i in (1, 2, 3)}
    assert (made[0].folder / "threads").read_text() == "1"
    assert max(running for running, _ in shown) <= 2
    assert shown[-1] == (0, 4)
    assert os.environ["OMP_NUM_THREADS"] == "5"


def test_a_full_disk_and_a_missing_package_are_reported_without_a_file(data, arm, tmp_path, local):
    made = cells(data, arm, tmp_path / "out", seeds=(4, 5, 6))
    left = made[2].folder.with_name(made[2].folder.name + ".error.txt")
    left.parent.mkdir(parents=True)
    left.write_text("of an earlier attempt")
    failed = run_cells(made, note_threads, local)
    assert failed == {
        "mlp seed 4": "[Errno 28] No space left on device: 'checkpoint.pt'",
        "mlp seed 5": "torch is not installed; run: pip install 'gaponet[train]'",
    }
    assert list((tmp_path / "out").rglob("*.error.txt")) == []


def test_ctrl_c_lets_every_running_cell_write_its_checkpoint(data, arm, tmp_path, local):
    made = cells(data, arm, tmp_path / "out", seeds=(0, 1, 2))

    def stop(running, done):
        if sum(share > 0 for share, _ in running.values()) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_cells(made, wait_for_the_end, local, stop)
    assert [(c.folder / "kept").exists() for c in made] == [True, True, False]
    assert list((tmp_path / "out" / "cells").glob(".gaponet*")) == []


def test_an_interrupted_cell_is_resumed_and_a_trained_one_is_not_trained_again(data, arm, tmp_path):
    (cell,) = cells(data, arm, tmp_path / "out", budget="1200")
    told = []

    def interrupt(share, note):
        told.append(note)
        if note.startswith("ppo"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_cell(cell, interrupt)
    facts = train_cell(cell, lambda share, note: told.append(note))
    assert facts["steps"] >= 1200
    assert facts["parameters"] == sum(
        a * b + b for a, b in ((31, 512), (512, 256), (256, 128), (128, 2))
    )
    assert train_cell(cell, lambda share, note: pytest.fail("trained again")) == facts


def test_a_cell_with_another_setup_is_refused(data, arm, tmp_path):
    (cell,) = cells(data, arm, tmp_path / "out")
    cell.folder.mkdir(parents=True)
    with pytest.raises(UsageError, match="no part of a comparison"):
        cells(data, arm, tmp_path / "out")
    (cell.folder / SETUP_FILE).write_text(json.dumps(cell.setup(data)))
    cells(data, arm, tmp_path / "out", base=replace(SMALL, threads=2))
    with pytest.raises(
        UsageError,
        match=r"mlp-0: belongs to a comparison with another budget; choose another --out",
    ):
        cells(data, arm, tmp_path / "out", budget="641")


def test_a_model_named_twice_is_refused(data, arm, tmp_path):
    with pytest.raises(UsageError, match="'mlp' is there twice"):
        cells(data, arm, tmp_path / "out", ("mlp", "gaponet", "mlp"))


def test_cells_share_the_fit_of_delay_and_offset(data, arm, tmp_path, monkeypatch):
    fits = []
    whole = DelayOffset.fit
    monkeypatch.setattr(DelayOffset, "fit", lambda *args: fits.append(1) or whole(*args))
    first, second, part = cells(
        data,
        arm,
        tmp_path / "out",
        ("mlp:mlp_hidden=8", "mlp:mlp_hidden=8:history=2", "mlp:mlp_hidden=8:train_share=0.5"),
    )
    for cell in (first, second, part):
        train_cell(cell, lambda share, note: None)
    assert len(fits) == 2
    kept = [(c.folder / "delay_offset.json").read_text() for c in (first, second)]
    assert kept[0] == kept[1]
