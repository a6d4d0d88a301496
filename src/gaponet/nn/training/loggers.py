"""Training curves for TensorBoard or Weights & Biases: the numbers of progress.jsonl. Both packages are extras."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from gaponet.base.errors import UsageError

KINDS = ("tensorboard", "wandb")
Writer = tuple[Callable[[dict[str, float], int], None], Callable[[], None]]  # write(numbers, steps), close()


class Loggers:
    """Writes the finite numbers of each progress line over control steps."""

    def __init__(self, kinds: tuple[str, ...], out: Path, config: dict[str, Any]) -> None:
        """
        Args:
            kinds: Any of KINDS.
            out: Run folder. TensorBoard's files go to out/tensorboard.
            config: Configuration of the run, for Weights & Biases.

        Raises:
            UsageError: A package is not installed.
        """
        self.writers = [{"tensorboard": _tensorboard, "wandb": _wandb}[kind](out, config) for kind in kinds]

    def write(self, line: dict[str, Any]) -> None:
        """Log one line of progress.jsonl."""
        numbers = {k: float(v) for k, v in line.items() if isinstance(v, (int, float)) and v == v and k != "steps"}
        for write, _ in self.writers:
            write(numbers, line["steps"])

    def close(self) -> None:
        """Close all files and connections."""
        for _, close in self.writers:
            close()


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
