"""One training on several processes, torchrun's ranks: each has its part of the simulations and of every batch.

    torchrun --nproc-per-node 2 -m gaponet train DATASET --out RUN

Networks begin equal and move by the mean of all ranks' gradients, so they stay equal; whether they did is looked at
whenever the run is kept. The first rank fits what is fitted once, says when it is over, and alone writes. With one
process nothing here does anything.
"""

from __future__ import annotations

import hashlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from datetime import timedelta
from typing import Any, TypeVar

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor, nn

from gaponet.base.arrays import Array
from gaponet.base.errors import ModelError, UsageError
from gaponet.nn.layers import Standardise
from gaponet.nn.training.config import TrainConfig

T = TypeVar("T")
BEAT, SILENCE = 2.0, 25.0  # s between two signs of life of a rank; without one it is frozen, or its machine is gone
START = 120.0  # s until the first of them
ALONE = timedelta(hours=24)  # for what one rank does while the others wait: who is busy is not silent
APART = 1_000_003  # between the seeds of two ranks; the seeds of a study are neighbours

_interrupted = False
_parent = os.getppid()  # torchrun


def world() -> int:
    """How many ranks have met."""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def rank() -> int:
    """Which of them this process is, from 0."""
    return dist.get_rank() if world() > 1 else 0


def started() -> int:
    """The rank that torchrun gave this process; 0 where it did not start it."""
    return int(os.environ["RANK"]) if dist.is_available() and dist.is_torchelastic_launched() else 0


def on_first(what: AbstractContextManager[T]) -> AbstractContextManager[T | None]:
    """A context that only the first rank enters."""
    return nullcontext() if rank() else what


@contextmanager
def joined(device: str) -> Iterator[None]:
    """Meet the other ranks, where torchrun started several, and part at the end; on "cuda" each has its own GPU.

    Ctrl-C meanwhile ends all of them at the same step (`decided`).

    Raises:
        ModelError: Another rank failed.
        UsageError: There are not so many GPUs.
    """
    if not dist.is_available() or not dist.is_torchelastic_launched() or dist.is_initialized():
        yield
        return
    local, gpus = int(os.environ["LOCAL_RANK"]), torch.cuda.device_count() if device == "cuda" else 0
    if 0 < gpus <= local:
        raise UsageError(f"--device cuda: torchrun --nproc-per-node asks for more than the {gpus} GPUs of this machine")
    if gpus:
        torch.cuda.set_device(local)
    left = threading.Event()
    threading.Thread(target=_watch, args=(started(), int(os.environ["WORLD_SIZE"]), left), daemon=True).start()
    dist.init_process_group("cpu:gloo,cuda:nccl" if gpus else "gloo", timeout=ALONE)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN if rank() else _interrupt)
    try:
        yield
    finally:
        left.set()
        signal.signal(signal.SIGINT, before)
        dist.destroy_process_group()


def _watch(here: int, ranks: int, left: threading.Event) -> None:
    """Give signs of life, and end this process where another rank gives none."""
    store, met = None, time.monotonic()
    beats, since = [0] * ranks, [time.monotonic() + START - SILENCE] * ranks
    while not left.wait(BEAT):
        try:
            if store is None:
                host, port = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
                store = dist.TCPStore(host, port, is_master=False, timeout=timedelta(seconds=BEAT))
            store.add(f"gaponet/{here}", 1)
            heard = [store.add(f"gaponet/{other}", 0) for other in range(ranks)]
        except RuntimeError:  # torchrun, whose store it is, is gone
            if dist.is_initialized():
                return  # `decided` ends the training
            if time.monotonic() - met > SILENCE:
                os.write(2, f"rank {here}: torchrun does not answer at {host}:{port}\n".encode())
                os._exit(1)
            store = None
            continue
        met = time.monotonic()
        since = [t if now == old else time.monotonic() for t, now, old in zip(since, heard, beats, strict=True)]
        beats = heard
        if not left.is_set() and (silent := time.monotonic() - min(since)) > SILENCE:
            who = since.index(min(since))
            os.write(2, f"rank {here}: rank {who} has been silent for {silent:.0f} s; --resume goes on\n".encode())
            os._exit(1)


def _interrupt(number: int, frame: Any) -> None:
    """Note Ctrl-C, once: torchrun repeats it."""
    global _interrupted
    _interrupted = True
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def _together() -> Iterator[None]:
    try:
        yield
    except RuntimeError as error:
        reason = str(error).partition(". ")[0]
        raise ModelError(
            f"rank {rank()}: another rank has failed ({reason}); the run goes on from its last checkpoint with --resume"
        ) from None


def decided(spent: float) -> float:
    """The first rank's answer, on all of them: by clocks of their own they would not end at the same step.

    Raises:
        KeyboardInterrupt: Ctrl-C, or torchrun is gone; on every rank at once.
    """
    global _interrupted, _parent
    if world() == 1:
        return spent
    told = torch.tensor([spent, _interrupted or os.getppid() != _parent], dtype=torch.float64)
    with _together():
        dist.broadcast(told, 0)
    if told[1]:
        _interrupted, _parent = False, os.getppid()
        raise KeyboardInterrupt
    return told[0].item()


def once(work: Callable[[], T]) -> T:
    """What the first rank's work comes to, on every rank; the others wait as long as it takes."""
    if world() == 1:
        return work()
    said = [None if rank() else work()]
    with _together():
        dist.broadcast_object_list(said, 0)
    return said[0]  # type: ignore[return-value]


def gathered(own: T) -> list[T]:
    """Every rank's own, on the first; on the others an empty list."""
    if world() == 1:
        return [own]
    all_: list[Any] = [None] * world()
    with _together():
        dist.gather_object(own, None if rank() else all_)
    return [] if rank() else all_


def average(*tensors: Tensor) -> None:
    """Put the mean over the ranks in the place of each tensor."""
    if world() == 1:
        return
    flat = nn.utils.parameters_to_vector(tensors)
    with _together():
        dist.all_reduce(flat)
    for x, mean in zip(tensors, (flat / world()).split([x.numel() for x in tensors]), strict=True):
        x.copy_(mean.view_as(x))


def mean(*numbers: float) -> list[float]:
    """The mean of each number over the ranks."""
    own = torch.tensor(numbers, dtype=torch.float64)
    average(own)
    return own.tolist()


def each(parts: Sequence[T], errors: Callable[[Sequence[T]], Array]) -> Array:
    """errors(parts), (len(parts),), of which each rank finds its own part."""
    if world() == 1:
        return errors(parts)
    found, own = np.zeros(len(parts)), slice(rank(), None, world())
    found[own] = errors(parts[own]) if parts[own] else 0.0
    return np.array(mean(*found.tolist())) * world()


def pool(module: nn.Module) -> None:
    """Give what was standardised by equally many samples on each rank the statistics of all of them."""
    for s in module.modules() if world() > 1 else ():
        if isinstance(s, Standardise):
            own = s.mean.clone()
            average(s.mean)
            s.std.square_().add_((own - s.mean).square())
            average(s.std)
            s.std.sqrt_()


def spread(module: nn.Module) -> None:
    """Give every rank the first one's parameters and statistics."""
    for x in module.state_dict().values() if world() > 1 else ():
        with _together():
            dist.broadcast(x, 0)


def require_equal(*states: dict[str, Tensor]) -> None:
    """Compare digests of networks.

    Raises:
        ModelError: They differ between ranks, if by a bit.
    """
    if world() == 1:
        return
    digest, found = hashlib.sha256(), [""] * world()
    for x in (x for state in states for x in state.values()):
        digest.update(x.cpu().numpy().tobytes())
    with _together():
        dist.all_gather_object(found, digest.hexdigest()[:16])
    if len(set(found)) > 1:
        raise ModelError(f"the ranks' networks differ ({', '.join(found)}), a bug; --resume goes on from before")


def share(config: TrainConfig) -> TrainConfig:
    """This rank's part of a training: of simulations, of each batch and of the machine's cores.

    Raises:
        UsageError: They cannot be shared evenly.
    """
    if world() == 1:
        return config

    def part(option: str, whole: int) -> int:
        if whole % world():
            raise UsageError(f"{option} {whole}: {world()} ranks cannot share them evenly; give a multiple")
        return whole // world()

    warm, ppo = config.warm_start, config.ppo
    cores = max(1, (os.cpu_count() or 1) // int(os.environ.get("LOCAL_WORLD_SIZE", world())))
    return replace(
        config,
        threads=config.threads or cores,
        warm_start=replace(
            warm,
            num_envs=part("--warm-start.num-envs", warm.num_envs),
            batch_size=part("--warm-start.batch-size", warm.batch_size),
        ),
        ppo=replace(ppo, num_envs=part("--ppo.num-envs", ppo.num_envs)),
    )
