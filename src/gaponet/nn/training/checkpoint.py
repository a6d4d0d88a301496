"""What a run must remember to go on as if it had never stopped, bit for bit: tensors, numbers, text, no code."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from gaponet.base.errors import ModelError, UsageError
from gaponet.base.files import atomic_write, write_text
from gaponet.nn.layers import DeltaNet
from gaponet.nn.training import ranks
from gaponet.nn.training.sensor_fit import Report

StateDict = dict[str, Any]

CHECKPOINT, PROGRESS = "checkpoint.pt", "progress.jsonl"
SHARED = ("net", "optimiser", "critic", "critic_optimiser")  # equal on all ranks


@dataclass
class Checkpoint:
    """The best networks so far, what was done, and where the stages stand."""

    best_state: StateDict
    trained_state: StateDict
    best: float = float("inf")
    trained: float = float("inf")
    """Validation error of the best network that was fitted, with gain 1."""
    val: float = float("nan")
    steps: int = 0
    seconds: float = 0.0
    """Trained up to the last checkpoint."""
    rounds_done: int = 0
    updates: int = 0
    anew: bool = False
    """Whether PPO began from the untrained network, the warm start having been worse than no correction."""
    sensor_r2: Report | None = None
    learner: StateDict | None = None
    """The state of PPO: its critic and optimisers."""
    env: StateDict | None = None
    """State of PPO's environments."""
    warm: StateDict | None = None
    progress: list[dict[str, Any]] = field(default_factory=list)
    """Lines of progress.jsonl."""
    dataset: str = ""
    """Hash of its recordings."""

    def write(self, out: Path, net: DeltaNet) -> None:
        """Write the checkpoint, and progress.jsonl beside it; of all ranks, whose networks must be equal, the first."""
        ranks.require_equal(net.state_dict(), self.learner["critic"] if self.learner else {})
        state = vars(self) | {"net": net.state_dict(), "rng": torch.get_rng_state()}
        others = ranks.gathered(_own({name: state[name] for name in ("rng", "env", "learner", "warm")}))[1:]
        if not ranks.rank():
            content = io.BytesIO()  # torch does not say which error it met on a disk
            torch.save(state | {"others": others}, content)
            with atomic_write(out / CHECKPOINT) as temporary:
                temporary.write_bytes(content.getbuffer())
            self.write_progress(out)

    def write_progress(self, out: Path) -> None:
        """Write progress.jsonl anew."""
        write_text(out / PROGRESS, "".join(json.dumps(line) + "\n" for line in self.progress))

    @classmethod
    def read(cls, out: Path, net: DeltaNet, dataset: str) -> tuple[Checkpoint, torch.Tensor]:
        """Read a checkpoint: into the network, into torch's random numbers, and the rest.

        Args:
            dataset: Hash of the recordings to go on with.

        Raises:
            ModelError: Damaged, or of another network.
            UsageError: Trained on other recordings, or by another number of ranks.
        """
        try:
            state = torch.load(out / CHECKPOINT, weights_only=True, map_location="cpu")
            net.load_state_dict(state.pop("net"))
            others = state.pop("others", [])
            if 0 < ranks.rank() <= len(others):
                state = _with_own(state, others[ranks.rank() - 1])
            rng = state.pop("rng")
            kept = cls(**state)
            torch.set_rng_state(rng)
        except Exception as error:  # torch and its unpickler raise of every kind
            reason = next(iter(str(error).splitlines()), type(error).__name__)
            raise ModelError(f"{out / CHECKPOINT}: does not fit this model or is damaged ({reason})") from None
        if len(others) + 1 != ranks.world():
            n = len(others) + 1
            raise UsageError(f"{out}: was trained by {n} processes; resume with torchrun --nproc-per-node {n}")
        if kept.dataset not in ("", dataset):
            raise UsageError(f"{out}: was trained on other recordings than this dataset holds; train anew")
        return kept, rng


def _own(state: Any) -> Any:
    """What of a state is a rank's own, on the CPU: all but networks and their optimisers."""
    if isinstance(state, dict):
        return {name: _own(x) for name, x in state.items() if name not in SHARED}
    if isinstance(state, list):
        return [_own(x) for x in state]
    return state.cpu() if isinstance(state, torch.Tensor) else state


def _with_own(state: Any, mine: Any) -> Any:
    """The first rank's state with another one's `_own` in the place of its own."""
    if isinstance(mine, dict):
        return (state or {}) | {name: _with_own((state or {}).get(name), x) for name, x in mine.items()}
    if isinstance(mine, list):
        return [_with_own(x, y) for x, y in zip(state, mine, strict=True)]
    return mine
