"""Tables that hold several recordings: a column with the number of the episode in each row."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import LogError
from gaponet.data.describe.raw_recording import RawRecording, Signal

COLUMNS = (
    "episode_index",
    "episode",
    "episode_id",
    "episode_idx",
    "episode_number",
    "ep",
    "traj_id",
    "trajectory_id",
    "trajectory_index",
    "demo_id",
    "demo_index",
    "rollout_id",
    "rollout_index",
    "run_id",
)
# that begin again with each episode
FRAME_COLUMNS = (
    "frame_index",
    "frame",
    "step_index",
    "step",
    "timestep",
)
MAX_EPISODES = 100_000
MAX_NUMBER = 2**53  # beyond which a float is not one whole number


def episodes(recording: RawRecording) -> Iterator[RawRecording]:
    """Yield a recording for each episode of a table; the table itself if it has one, or does not
    number them.

    Rows of one episode need not stand together. Between episodes the robot was reset, which is no
    motion.
    """
    numbers = _whole_numbers(recording, COLUMNS)
    if numbers is None:
        frames = _whole_numbers(recording, FRAME_COLUMNS)
        numbers = None if frames is None else _counted(frames)
    if numbers is None:
        yield recording
        return
    different = np.unique(numbers).astype(int)
    if not 1 < len(different) <= MAX_EPISODES:
        yield recording
        return
    width = max(4, len(str(different[-1])))
    for number in different.tolist():
        rows = np.flatnonzero(numbers == number)
        yield replace(
            recording,
            name=f"{recording.name}-{number:0{width}d}",
            source=f"{recording.source}#{number}",
            first_line=recording.first_line + int(rows[0]),
            load=partial(_load, recording.load, rows),
        )


def _whole_numbers(recording: RawRecording, columns: tuple[str, ...]) -> Array | None:
    """Return the first of these columns, (k,); None if there is none, or it does not hold whole
    numbers.
    """
    column = next((name for name in recording.signals if name.lower() in columns), None)
    if column is None or recording.signals[column]:
        return None
    try:
        values = recording.load([column])[column].values
    except LogError:  # text
        return None
    whole = np.isfinite(values).all() and (values == np.round(values)).all()
    if not whole or np.abs(values).max(initial=0.0) > MAX_NUMBER:
        return None
    return values


def _counted(frames: Array) -> Array:
    """Return the number of the episode by numbers of frames that begin again with each."""
    steps = np.diff(frames)
    again = (steps < 0) & (frames[1:] == frames[0])
    if (steps < 0).sum() > again.sum():
        return np.zeros(len(frames))
    return np.concatenate([[0.0], np.cumsum(again)])


def _load(
    load: Callable[[list[str]], dict[str, Signal]], rows: Array, names: list[str]
) -> dict[str, Signal]:
    """Load the rows of one episode."""
    loaded = {}
    for name, signal in load(names).items():
        time = None if signal.time is None else signal.time[rows]
        loaded[name] = Signal(signal.values[rows], time, signal.in_seconds)
    return loaded
