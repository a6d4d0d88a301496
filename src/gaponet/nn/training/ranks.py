"""Training with several processes, the ranks of torchrun. Each has a part of the simulations and of every batch.

    torchrun --nproc-per-node 2 -m gaponet train DATASET --out RUN

Networks start equal and move by the mean gradient of all ranks, so they stay equal. Every checkpoint checks this. The
first rank fits the sensor predictor, decides when training ends, and is the only one that writes. With one process,
all functions here do nothing.
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
HEARTBEAT_S, HEARTBEAT_TIMEOUT_S = (
    2.0,
    25.0,
)  # period of the heartbeat; after the timeout, a rank counts as dead
FIRST_HEARTBEAT_TIMEOUT_S = 120.0
COLLECTIVE_TIMEOUT = timedelta(
    hours=24
)  # ranks wait for one that works alone; the heartbeat detects a dead one
SEED_STEP = 1_000_003  # between the seeds of two ranks; the seeds of a study are consecutive

_interrupted = False  # Ctrl-C was pressed
_parent = os.getppid()  # torchrun


def world() -> int:
    """Return the number of ranks; 1 without torchrun."""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def rank() -> int:
    """Return the rank of this process, from 0."""
    return dist.get_rank() if world() > 1 else 0


def started() -> int:
    """Return the rank that torchrun assigned, also before `joined`; 0 without torchrun."""
    return int(os.environ["RANK"]) if dist.is_available() and dist.is_torchelastic_launched() else 0


def on_first(context: AbstractContextManager[T]) -> AbstractContextManager[T | None]:
    """Return a context that only the first rank enters."""
    return nullcontext() if rank() else context


@contextmanager
def joined(device: str) -> Iterator[None]:
    """Connect the ranks of torchrun for the duration of the context. On device "cuda", each rank has its own GPU.

    Ctrl-C ends the training of all ranks at the same step (`decided`).

    Raises:
        UsageError: There are fewer GPUs than ranks.
    """
    if not dist.is_available() or not dist.is_torchelastic_launched() or dist.is_initialized():
        yield
        return
    local, gpus = (
        int(os.environ["LOCAL_RANK"]),
        torch.cuda.device_count() if device == "cuda" else 0,
    )
    if 0 < gpus <= local:
        raise UsageError(
            f"--device cuda: torchrun --nproc-per-node asks for more than the {gpus} GPUs of this machine"
        )
    if gpus:
        torch.cuda.set_device(local)
    finished = threading.Event()
    heartbeat = threading.Thread(
        target=_heartbeat, args=(started(), int(os.environ["WORLD_SIZE"]), finished)
    )
    heartbeat.daemon = True
    heartbeat.start()
    dist.init_process_group("cpu:gloo,cuda:nccl" if gpus else "gloo", timeout=COLLECTIVE_TIMEOUT)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN if rank() else _interrupt)
    try:
        yield
    finally:
        finished.set()
        signal.signal(signal.SIGINT, before)
        dist.destroy_process_group()


def _heartbeat(own: int, ranks: int, finished: threading.Event) -> None:
    """Count up this rank's heartbeat, and end this process if another rank's stops."""
    store, last_contact = None, time.monotonic()
    beats = [0] * ranks
    changed_at = [time.monotonic() + FIRST_HEARTBEAT_TIMEOUT_S - HEARTBEAT_TIMEOUT_S] * ranks
    while not finished.wait(HEARTBEAT_S):
        try:
            if store is None:
                host, port = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
                store = dist.TCPStore(
                    host, port, is_master=False, timeout=timedelta(seconds=HEARTBEAT_S)
                )
            store.add(f"gaponet/{own}", 1)
            received = [store.add(f"gaponet/{other}", 0) for other in range(ranks)]
        except RuntimeError:  # torchrun, which owns the store, has ended
            if dist.is_initialized():
                return  # `decided` ends the training
            if time.monotonic() - last_contact > HEARTBEAT_TIMEOUT_S:
                os.write(2, f"rank {own}: torchrun does not answer at {host}:{port}\n".encode())
                os._exit(1)
            store = None
            continue
        now = last_contact = time.monotonic()
        changed_at = [
            t if new == old else now
            for t, new, old in zip(changed_at, received, beats, strict=True)
        ]
        beats = received
        if not finished.is_set() and (silent := now - min(changed_at)) > HEARTBEAT_TIMEOUT_S:
            dead = changed_at.index(min(changed_at))
            os.write(
                2,
                f"rank {own}: rank {dead} has been silent for {silent:.0f} s; --resume goes on\n".encode(),
            )
            os._exit(1)


def _interrupt(number: int, frame: Any) -> None:
    """Remember Ctrl-C, and ignore the repetitions of torchrun."""
    global _interrupted
    _interrupted = True
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def _collective() -> Iterator[None]:
    """Raise a ModelError if another rank fails during a collective operation."""
    try:
        yield
    except RuntimeError as error:
        reason = str(error).partition(". ")[0]
        raise ModelError(
            f"rank {rank()}: another rank has failed ({reason}); the run goes on from its last checkpoint with --resume"
        ) from None


def decided(spent: float) -> float:
    """Return the first rank's value on all ranks, so that all end at the same step.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed or torchrun has ended; on every rank at the same step.
    """
    global _interrupted, _parent
    if world() == 1:
        return spent
    message = torch.tensor([spent, _interrupted or os.getppid() != _parent], dtype=torch.float64)
    with _collective():
        dist.broadcast(message, 0)
    if message[1]:
        _interrupted, _parent = False, os.getppid()
        raise KeyboardInterrupt
    return message[0].item()


def once(work: Callable[[], T]) -> T:
    """Run `work` on the first rank, and return its result on every rank."""
    if world() == 1:
        return work()
    result = [None if rank() else work()]
    with _collective():
        dist.broadcast_object_list(result, 0)
    return result[0]  # type: ignore[return-value]


def gathered(own: T) -> list[T]:
    """Return the values of all ranks on the first rank, and an empty list on the others."""
    if world() == 1:
        return [own]
    values: list[Any] = [None] * world()
    with _collective():
        dist.gather_object(own, None if rank() else values)
    return [] if rank() else values


def average(*tensors: Tensor) -> None:
    """Replace each tensor by its mean over the ranks."""
    if world() == 1:
        return
    flat = nn.utils.parameters_to_vector(tensors)
    with _collective():
        dist.all_reduce(flat)
    for x, mean in zip(tensors, (flat / world()).split([x.numel() for x in tensors]), strict=True):
        x.copy_(mean.view_as(x))


def mean(*numbers: float) -> list[float]:
    """Return the mean of each number over the ranks."""
    own = torch.tensor(numbers, dtype=torch.float64)
    average(own)
    return own.tolist()


def each(items: Sequence[T], errors: Callable[[Sequence[T]], Array]) -> Array:
    """Return errors(items), (len(items),). Each rank computes a part of them."""
    if world() == 1:
        return errors(items)
    results, own = np.zeros(len(items)), slice(rank(), None, world())
    results[own] = errors(items[own]) if items[own] else 0.0
    return np.array(mean(*results.tolist())) * world()


def pool_statistics(module: nn.Module) -> None:
    """Replace mean and std of all `Standardise` by those of the samples of all ranks, equally many on each."""
    for s in module.modules() if world() > 1 else ():
        if isinstance(s, Standardise):
            own = s.mean.clone()
            average(s.mean)
            s.std.square_().add_((own - s.mean).square())
            average(s.std)
            s.std.sqrt_()


def broadcast(module: nn.Module) -> None:
    """Copy the first rank's parameters and buffers to all ranks."""
    for x in module.state_dict().values() if world() > 1 else ():
        with _collective():
            dist.broadcast(x, 0)


def require_equal(*states: dict[str, Tensor]) -> None:
    """Compare the networks of all ranks bit for bit.

    Raises:
        ModelError: They differ.
    """
    if world() == 1:
        return
    digest, digests = hashlib.sha256(), [""] * world()
    for x in (x for state in states for x in state.values()):
        digest.update(x.cpu().numpy().tobytes())
    with _collective():
        dist.all_gather_object(digests, digest.hexdigest()[:16])
    if len(set(digests)) > 1:
        raise ModelError(
            f"the ranks' networks differ ({', '.join(digests)}), a bug; --resume goes on from before"
        )


def share(config: TrainConfig) -> TrainConfig:
    """Return this rank's configuration: its part of the simulations, of each batch and of the cores.

    Raises:
        UsageError: A number is not divisible by the number of ranks.
    """
    if world() == 1:
        return config

    def part(option: str, total: int) -> int:
        if total % world():
            raise UsageError(
                f"{option} {total}: {world()} ranks cannot share them evenly; give a multiple"
            )
        return total // world()

    pretraining, ppo = config.pretraining, config.ppo
    cores = max(1, (os.cpu_count() or 1) // int(os.environ.get("LOCAL_WORLD_SIZE", world())))
    return replace(
        config,
        threads=config.threads or cores,
        pretraining=replace(
            pretraining,
            num_envs=part("--pretraining.num-envs", pretraining.num_envs),
            batch_size=part("--pretraining.batch-size", pretraining.batch_size),
        ),
        ppo=replace(ppo, num_envs=part("--ppo.num-envs", ppo.num_envs)),
    )
