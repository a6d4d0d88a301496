"""Training curves for those who watch them elsewhere: the numbers of progress.jsonl to TensorBoard or Weights & Biases.

Both packages are extras and are imported when asked for.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from gaponet.base.errors import UsageError

KINDS = ("tensorboard", "wandb")


class Loggers:
    """Writes a line of progress to each of them; numbers only, NaN left out, over control steps."""

    def __init__(self, kinds: tuple[str, ...], out: Path, config: dict[str, Any]) -> None:
        """kinds: any of KINDS. out: Run folder; TensorBoard's files go to out/tensorboard. config: Shown beside."""
        self.writers = [{"tensorboard": _tensorboard, "wandb": _wandb}[kind](out, config) for kind in kinds]

    def write(self, line: dict[str, Any]) -> None:
        """Log one line of progress.jsonl."""
        numbers = {k: float(v) for k, v in line.items() if isinstance(v, (int, float)) and v == v and k != "steps"}
        for write, _ in self.writers:
            write(numbers, line["steps"])

    def close(self) -> None:
        for _, close in self.writers:
            close()


Writer = tuple[Callable[[dict[str, float], int], None], Callable[[], None]]


def _tensorboard(out: Path, config: dict[str, Any]) -> Writer:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise _missing("tensorboard") from None
    board = SummaryWriter(str(out / "tensorboard"))

    def write(numbers: dict[str, float], steps: int) -> None:
        for name, value in numbers.items():
            board.add_scalar(name, value, steps)
        board.flush()

    return write, board.close


def _wandb(out: Path, config: dict[str, Any]) -> Writer:
    try:
        import wandb
    except ImportError:
        raise _missing("wandb") from None
    run = wandb.init(project="gaponet", name=out.name, dir=str(out), config=config)
    return lambda numbers, steps: run.log(numbers, step=steps), run.finish


def _missing(kind: str) -> UsageError:
    return UsageError(f"--log {kind}: {kind} is not installed; run: pip install 'gaponet[{kind}]'")
