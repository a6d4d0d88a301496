"""What a run must remember to go on as if it had never stopped, bit for bit: tensors, numbers, text; no pickled code.

Networks and optimisers keep themselves; here is the rest: random numbers, environments in mid-motion, and the warm
start's pool. The pool is hundreds of megabytes and follows from the networks that collected it, so those are kept and
roll out again.
"""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gaponet.arrays import like
from gaponet.files import whole
from gaponet.training.env import DeltaEnv
from gaponet.training.warm_start import WarmStart

StateDict = dict[str, Any]
SHARED = ("net", "optimiser", "critic", "critic_optimiser")  # equal on all ranks
ROWS = ("row", "first", "last", "now", "elapsed")  # of each environment


def write_state(path: Path, state: StateDict) -> None:
    """Write a checkpoint whole or not at all; OSError where there is no room for it."""
    content = io.BytesIO()  # torch does not say which error it met on a disk
    torch.save(state, content)
    with whole(path) as temporary:
        temporary.write_bytes(content.getbuffer())


def own(state: Any) -> Any:
    """What of a state is a rank's own, on the CPU: all but networks and their optimisers."""
    if isinstance(state, dict):
        return {name: own(x) for name, x in state.items() if name not in SHARED}
    if isinstance(state, list):
        return [own(x) for x in state]
    return state.cpu() if isinstance(state, torch.Tensor) else state


def with_own(state: Any, mine: Any) -> Any:
    """The first rank's state with another one's `own` in the place of its own."""
    if isinstance(mine, dict):
        return (state or {}) | {name: with_own((state or {}).get(name), x) for name, x in mine.items()}
    if isinstance(mine, list):
        return [with_own(x, y) for x, y in zip(state, mine, strict=True)]
    return mine


def _rng_text(rng: np.random.Generator) -> str:
    """State of a generator; its integers have 128 bits."""
    return json.dumps(rng.bit_generator.state)


def _set_rng(rng: np.random.Generator, text: str) -> None:
    rng.bit_generator.state = json.loads(text)


def env_state(env: DeltaEnv) -> StateDict:
    """Where every simulation stands in its motion, what its servos have still under way, and what comes next."""
    arrays = {name: getattr(env, name) for name in ROWS} | {"frames": env.loop.history.frames} | env.sim.state()
    return {
        "arrays": {name: torch.as_tensor(x).cpu().clone() for name, x in arrays.items()},
        "reward": (float(env.reward_sum), env.reward_count),
        "rng": _rng_text(env.rng),
    }


def restore_env(env: DeltaEnv, state: StateDict) -> None:
    """Undo env_state in an environment made alike."""
    arrays = {name: x.numpy() for name, x in state["arrays"].items()}
    for name in ROWS:
        getattr(env, name)[:] = env.sim.array(arrays[name])
    env.loop.history.frames[:] = like(env.loop.history.frames, arrays["frames"])
    env.sim.set_state(arrays)
    env.reward_sum, env.reward_count = state["reward"]
    _set_rng(env.rng, state["rng"])


def round_state(warm: WarmStart) -> StateDict:
    """What the next round's roll-outs follow from."""
    net = {name: x.clone() for name, x in warm.net.state_dict().items()}
    return {"net": net, "rng": _rng_text(warm.env.rng)}


def warm_state(warm: WarmStart, rounds: list[StateDict]) -> StateDict:
    """A warm start between rounds; `rounds`: round_state before each of them."""
    return {
        "rounds": rounds,
        "optimiser": warm.optimiser.state_dict(),
        "generator": warm.generator.get_state(),
        "env_rng": _rng_text(warm.env.rng),
    }


def restore_warm(warm: WarmStart, state: StateDict) -> None:
    """Roll the past rounds out again, then undo warm_state; the network is left as it is."""
    present = {name: x.clone() for name, x in warm.net.state_dict().items()}
    for i, before in enumerate(state["rounds"]):
        warm.net.load_state_dict(before["net"])
        _set_rng(warm.env.rng, before["rng"])
        warm.collect(follow_labels=i == 0)
    warm.net.load_state_dict(present)
    warm.optimiser.load_state_dict(state["optimiser"])
    warm.generator.set_state(state["generator"])
    _set_rng(warm.env.rng, state["env_rng"])
    warm.done = len(state["rounds"])
