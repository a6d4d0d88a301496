"""Targets, simulations and recording of one sequence: the joint angles that `gaponet view`
shows.
"""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import DatasetError, UsageError
from gaponet.base.progress import Progress, no_progress, with_note
from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.data.signals import busiest_window
from gaponet.data.store import Dataset, Entry
from gaponet.evaluation.candidate import Candidate, FittedData
from gaponet.evaluation.methods import title
from gaponet.robot.spec import RobotSpec
from gaponet.sim.replay import Corrector, replay


@dataclass(frozen=True)
class Copy:
    """One copy of the robot."""

    method: str  # key of evaluation.methods.METHODS
    qpos: Array  # (T, n), rad; row t at t·dt
    error: Array  # mean |q − q_real| over the operated joints, (T), rad; row 0 is the common start

    @property
    def mpjae(self) -> float:
        """Mean error over the whole motion (MPJAE), rad."""
        return float(self.error[1:].mean())


@dataclass(frozen=True)
class SideBySide:
    """The motions of one recording."""

    real: Sequence
    robot: RobotSpec
    motions: tuple[Copy, ...]  # target, nominal, identified, models and recording, in this order
    # True if a model was trained or validated on this recording; None without a model
    seen: bool | None

    def only(self, methods: tuple[str, ...]) -> SideBySide:
        """Return some motions in this order; "aligned" stands for the motions of all models.

        Raises:
            UsageError: No such motion, or none at all.
        """
        have = {motion.method: motion for motion in self.motions}
        wanted: list[str] = []
        for name in methods:
            if name == "aligned":
                wanted += [m for m in have if m not in ("target", "nominal", "recorded")]
            elif name in have:
                wanted.append(name)
            else:
                raise UsageError(
                    f"--show {name}: here are {', '.join(have)}; models are given with --model RUN"
                )
        if not wanted:
            raise UsageError("--show: nothing is selected; aligned motion needs --model RUN")
        return replace(self, motions=tuple(have[name] for name in dict.fromkeys(wanted)))

    def magnified(self, factor: float) -> SideBySide:
        """Return the motions with their differences from the recording times a factor.

        Errors are unchanged.
        """
        if not factor > 0:
            raise UsageError(f"--magnify is {factor}; give a positive factor, 1 for the truth")
        real = self.real.qpos
        motions = []
        for motion in self.motions:
            motions.append(replace(motion, qpos=real + factor * (motion.qpos - real)))
        return replace(self, motions=tuple(motions))


@dataclass(frozen=True)
class Clip:
    """A part of a recording."""

    start: float  # s into the recording
    duration: float  # s of the recording
    speed: float = 1.0  # below 1 is slow motion
    fps: float = 20.0  # pictures per second of the film

    def __post_init__(self) -> None:
        for name, highest in (("duration", 3600), ("speed", 100), ("fps", 120)):
            value = getattr(self, name)
            if not 0 < value <= highest:
                raise UsageError(f"--{name} is {value}; give more than 0 and at most {highest}")

    @classmethod
    def from_start(
        cls,
        shown: SideBySide,
        start: float | None,
        duration: float,
        speed: float = 1.0,
        fps: float = 20.0,
    ) -> Clip:
        """Return the part from start on, or the part with the most motion, cut at the recording's
        end.
        """
        real = shown.real
        dt = shown.real.dt
        recorded_s = (len(real) - 1) * dt
        if start is None:
            rows = max(round(duration / dt), 1)
            start = dt * busiest_window(real.qpos[:, shown.robot.operated_index], rows)
        if not 0 <= start < recorded_s:
            raise UsageError(f"--start is {start:g} s; the recording lasts {recorded_s:.1f} s")
        return cls(start, min(duration, recorded_s - start), speed, fps)

    @property
    def stop(self) -> float:
        """End of the clip, s into the recording."""
        return self.start + self.duration

    def times(self, period: float) -> np.ndarray:
        """Return the times of the recording, s, with a picture every `period` s."""
        count = max(round(self.duration / (period * self.speed)), 1)
        return self.start + np.arange(count) * period * self.speed


def largest_error_time(shown: SideBySide, clip: Clip) -> float:
    """Return the time of the largest error of the first simulated copy, s."""
    dt = shown.real.dt
    first = round(clip.start / dt)
    last = round(clip.stop / dt)
    simulated = [m for m in shown.motions if m.method not in ("target", "recorded")]
    copy = simulated[0] if simulated else shown.motions[0]
    return (first + int(copy.error[first : last + 1].argmax())) * dt


def select_entry(
    dataset: Dataset,
    runs: ListOf[Path],
    motion: str = "",
    unit: str = "",
    payload_mass: float | None = None,
) -> Entry:
    """Return the first matching recording; recordings that no run was fitted to come first.

    Raises:
        DatasetError: No recording matches.
    """
    entries = dataset.select((motion,) if motion else ())
    entries = sorted(entries, key=lambda e: was_used(e, runs))
    for entry in entries:
        meta = entry.meta
        is_unit = unit in ("", meta.unit_id)
        is_mass = payload_mass is None or abs(payload_mass - meta.payload_mass) < 1e-6
        if is_unit and is_mass:
            return entry
    there = sorted({f"{e.meta.unit_id} with {e.meta.payload_mass:g} kg" for e in entries})
    raise DatasetError(
        f"{dataset.path}: no such recording of {motion or 'any motion'}; there are "
        f"{', '.join(there)}. Change --unit or --payload-mass"
    )


def side_by_side(
    dataset: Dataset,
    entry: Entry,
    robot: RobotSpec,
    runs: ListOf[Path] = (),
    progress: Progress = no_progress,
) -> SideBySide:
    """Replay a recording in the nominal simulator, in identified ones, and with each run's
    exported model.

    Args:
        robot: Identified, it is shown beside the nominal one.
        runs: Run folders, or folders of identified robots.
    """
    dataset.require_robot(robot)
    real = dataset.read(entry)
    simulators: dict[str, tuple[RobotSpec, Corrector | None]] = {}
    simulators["nominal"] = (robot.before_identification, None)
    if robot.is_identified:
        simulators["identified"] = (robot, None)
    for run in runs:
        candidate = Candidate.load(run, robot)
        if candidate.model is not None:
            candidate.model.require(candidate.robot, real.dt)
        if candidate.method in simulators:
            raise UsageError(
                f"{run}: a second run of {title(candidate.method)}; give runs of different methods"
            )
        simulators[candidate.method] = (candidate.robot, candidate.corrector())
    # The command of row t is the target at t + 1.
    target = np.concatenate([real.qpos[:1], real.ctrl[:-1]])
    shown = {"target": target}
    for name, (simulator, corrector) in simulators.items():
        report = with_note(progress, name)
        shown[name] = replay([real], simulator, corrector, progress=report, lock_idle=True)[0].qpos
    shown["recorded"] = real.qpos
    motions = []
    for name, qpos in shown.items():
        error = np.abs(qpos - real.qpos)[:, robot.operated_index].mean(axis=1)  # (T,) rad
        motions.append(Copy(name, qpos, error))
    folders = list(runs)
    if robot.is_identified:
        folders.append(robot.folder)
    seen = was_used(entry, folders) if folders else None
    return SideBySide(real, robot, tuple(motions), seen)


def standing(robot: RobotSpec) -> SideBySide:
    """Return a robot at home."""
    home = np.tile(robot.qpos_home, (2, 1))
    still = np.zeros(2)
    meta = SequenceMeta(robot.name, "home", "home", 0.0)
    real = Sequence(meta, robot.joint_names, robot.dt, home, home, np.zeros_like(home))
    return SideBySide(real, robot, (Copy("nominal", home, still),), None)


def was_used(entry: Entry, folders: ListOf[Path]) -> bool:
    """Return True if any run or robot folder was fitted or validated on a recording, or does not
    say.
    """
    data = [FittedData.of_folder(folder) for folder in folders]
    return any(d is None or entry in d for d in data)
