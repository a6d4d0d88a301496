"""What each of two processes that torchrun started does for tests/nn/training/test_ranks.py: python two_ranks.py PLACE.

Each writes what it saw to PLACE/RANK.json.
"""

import hashlib
import json
import os
import signal
import sys
from pathlib import Path

import torch
from runs import TINY_TRAINING

from gaponet import api
from gaponet.base.errors import ModelError
from gaponet.nn.layers import Standardise
from gaponet.nn.training import ranks
from gaponet.nn.training.trainer import Trainer

STEPS = 2 * 8 * 30 + 4 * 8 * 8
digests: list[str] = []
written: list[str] = []


def watch(place: Path) -> None:
    """Note what this process writes below the runs, and digests of the networks before they are compared."""
    compare = ranks.require_equal

    def digest(*states):
        digests.append(
            hashlib.sha256(
                b"".join(x.numpy().tobytes() for s in states for x in s.values())
            ).hexdigest()
        )
        compare(*states)

    def opened(event, args):
        writes = event == "open" and (
            set(str(args[1] or "")) & set("wax+") or args[2] & (os.O_WRONLY | os.O_RDWR)
        )
        if (writes or event in ("os.mkdir", "os.rename", "os.remove")) and str(args[0]).startswith(
            f"{place}/run"
        ):
            written.append(str(args[0]))

    ranks.require_equal = digest
    sys.addaudithook(opened)


def together(rank: int) -> dict:
    """What ranks agree on, by numbers that are known."""
    mean, samples = (
        torch.tensor([1.0 + rank, 2.0]),
        torch.randn(1000, 3, generator=torch.Generator().manual_seed(0)),
    )
    ranks.average(mean)
    whole, part = Standardise(3), Standardise(3)
    whole.fit(samples)
    part.fit(samples[rank::2] * 1.0)
    ranks.pool_statistics(part)
    net = torch.nn.Linear(3, 3)
    ranks.broadcast(net)
    ranks.require_equal(net.state_dict())
    try:
        with torch.no_grad():
            net.bias[0] += 1e-7 * rank
        ranks.require_equal(net.state_dict())
        difference = ""
    except ModelError as error:
        difference = str(error)
    return {
        "mean": mean.tolist(), "decided": ranks.decided(0.1 + rank), "once": ranks.once(lambda: f"by {rank}"),
        "pooled": [(whole.mean - part.mean).abs().max().item(), (whole.std / part.std - 1).abs().max().item()],
        "difference": difference,
    }  # fmt: skip


def train(place: Path, name: str, resume: bool = False) -> dict:
    return api.train(
        place / "data",
        out=place / name,
        budget=str(STEPS),
        config=TINY_TRAINING,
        robot=place / "arm",
        resume=resume,
    ).card


def interrupted_in_ppo(tick):
    """Trainer._tick with a Ctrl-C that the first rank alone hears, in the third update."""
    seen = []

    def ticked(self):
        seen.append(self.stage)
        if seen.count("ppo") == 3:
            os.kill(os.getpid(), signal.SIGINT)
        return tick(self)

    return ticked


def main(place: Path) -> None:
    rank = int(os.environ["RANK"])
    watch(place)
    with ranks.joined("cpu"):
        saw = together(rank)
        digests.clear()
        saw["steps"] = train(place, "run-whole")["steps"]
        saw["digests"] = list(digests)
        if rank == 0:
            Trainer._tick = interrupted_in_ppo(Trainer._tick)
        saw["interrupted"] = train(place, "run-stopped")["interrupted"]
        saw["resumed"] = train(place, "run-stopped", resume=True)["steps"]
    saw["written"] = written
    (place / f"{rank}.json").write_text(json.dumps(saw))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
