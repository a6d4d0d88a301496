"""Two processes of torchrun train one model: equal networks, exact steps, one writer, and each its own simulations."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from arm import recordings, write_arm, write_dataset
from runs import TINY_TRAINING, differences, read_checkpoint
from two_ranks import STEPS

from gaponet.base.errors import UsageError
from gaponet.data.store import Dataset
from gaponet.nn.training import ranks
from gaponet.nn.training.config import Budget
from gaponet.nn.training.trainer import Trainer

pytestmark = pytest.mark.skipif(
    os.name == "nt", reason="Ctrl-C reaches no single process on Windows"
)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    place = tmp_path_factory.mktemp("ranks")
    robot = write_arm(place / "arm")
    write_dataset(place / "data", robot, recordings(robot, 8, rows=60, kp=0.5))
    script = Path(__file__).parents[2] / "two_ranks.py"
    command = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--standalone",
        "--nproc-per-node",
        "2",
        str(script),
    ]
    done = subprocess.run([*command, str(place)], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-3000:]
    return place


@pytest.fixture(scope="module")
def saw(place):
    return [json.loads((place / f"{rank}.json").read_text()) for rank in range(2)]


def test_what_ranks_agree_on(saw):
    for rank in saw:
        assert rank["mean"] == [1.5, 2.0]
        assert rank["decided"] == pytest.approx(0.1)
        assert rank["once"] == "by 0"
        assert max(rank["pooled"]) < 2e-3


def test_networks_that_differ_by_a_bit_are_refused_on_every_rank(saw):
    assert all("the ranks' networks differ" in rank["difference"] for rank in saw)


def test_networks_are_equal_whenever_the_run_is_kept(place, saw):
    lines = (place / "run-whole" / "progress.jsonl").read_text().splitlines()
    assert saw[0]["digests"] == saw[1]["digests"]
    assert len(lines) == len(saw[0]["digests"])
    assert len(set(saw[0]["digests"])) > 4  # they did learn


def test_the_budget_is_met_to_the_step_by_all_together(saw):
    assert [rank["steps"] for rank in saw] == [STEPS, STEPS]


def test_the_first_rank_alone_writes(saw):
    assert len(saw[0]["written"]) > 10
    assert saw[1]["written"] == []


def test_ranks_have_simulations_and_noise_of_their_own(place):
    first = read_checkpoint(place / "run-whole")
    (second,) = first["others"]
    assert not torch.equal(first["env"]["arrays"]["row"], second["env"]["arrays"]["row"])
    assert not torch.equal(first["ppo"]["noise"], second["ppo"]["noise"])
    assert len(first["ppo"]["noise"]) == TINY_TRAINING.ppo.num_envs // 2
    assert "critic" not in second["ppo"]


def test_an_interrupt_of_one_rank_ends_both_and_the_resumed_run_is_equal_bit_for_bit(place, saw):
    assert [rank["interrupted"] for rank in saw] == [True, True]
    assert [rank["resumed"] for rank in saw] == [STEPS, STEPS]
    whole, stopped = (read_checkpoint(place / f"run-{name}") for name in ("whole", "stopped"))
    assert differences(whole, stopped) == []


def test_a_run_is_resumed_by_as_many_processes(place):
    data, robot = Dataset(place / "data"), write_arm(place / "arm")
    with pytest.raises(
        UsageError, match="was trained by 2 processes; resume with torchrun --nproc-per-node 2"
    ):
        Trainer(data, robot, place / "run-whole", TINY_TRAINING, Budget(steps=STEPS), resume=True)


def test_what_ranks_cannot_share_evenly_is_refused(monkeypatch):
    monkeypatch.setattr(ranks, "world", lambda: 3)
    with pytest.raises(
        UsageError, match=r"--pretraining\.num-envs 8: 3 ranks cannot share them evenly"
    ):
        ranks.share(TINY_TRAINING)
