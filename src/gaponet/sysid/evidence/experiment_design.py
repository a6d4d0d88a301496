"""Choice of the motions whose recordings would reduce a robot's parameter uncertainty most.

Every candidate is played in the identified simulator. The derivative of its path by a servo
parameter is the information that a recording of it would hold. The overdispersion of this robot's
recordings (uncertainty.json) accounts for model errors that last. The chosen motions minimise the
sum of the logarithms of the standard errors, each parameter by itself, since parameters that are
only known together are to be separated. It is a greedy design with exchanges (Pukelsheim, Optimal
Design of Experiments, 2006).
"""

from __future__ import annotations

from collections.abc import Iterator
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.base.progress import Progress, no_progress
from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.motion.coordinated import ANY
from gaponet.motion.library import SIGNALS, Library, short
from gaponet.motion.motion import GRID, Motion
from gaponet.robot.spec import RobotSpec
from gaponet.sim.replay import replay
from gaponet.sysid.evidence.evidence import evidence
from gaponet.sysid.uncertainty import ParameterUncertainty

MOTIONS_OF_ALL_JOINTS = 24  # candidates with a signal in every joint
VARIANTS = 4  # of tours and the like
MAX_SINGLE_JOINTS = 8  # of a robot with more, no joint moves by itself
RANGE_SHARE = 0.5  # of a joint's interval, from home, beside others
# Playing on is worth its time while this time reduces the errors by this share.
WORTH_INTERVAL_S = 30.0
MIN_WORTH = 0.05
# Relative, after all motions: more means that they do not determine it.
MAX_KP_ERROR = 0.1
# So that a parameter without any can be divided by it.
MIN_INFORMATION = 1e-9
MIN_GAIN = 1e-9  # of the mean log error, by an exchange


@dataclass(frozen=True)
class ExperimentDesign:
    """Information that R recordings would hold about n joints' P parameters, on the axes of
    sysid/uncertainty.py.
    """

    information: Array  # Gauss-Newton information of each recording, (n, R, P, P)
    seconds: Array  # durations, (R,)
    covariance: Array  # present covariance, (n, P, P)
    overdispersion: Array  # variance of recordings' gradients over that of independent rows, (n, P)

    @classmethod
    def from_recordings(
        cls,
        robot: RobotSpec,
        uncertainty: ParameterUncertainty,
        recordings: ListOf[Sequence],
    ) -> ExperimentDesign:
        """Make the design from simulated recordings of the identified robot; their names differ."""
        seen = evidence(robot, recordings, uncertainty.fields, 10**6).by_recording()
        covariance = np.stack([uncertainty.array(j, "covariance") for j in robot.operated])
        overdispersion = np.stack([uncertainty.array(j, "overdispersion") for j in robot.operated])
        seconds = np.array([s.duration for s in recordings])
        return cls(
            seen.information[..., :-1, :-1],
            seconds,
            covariance,
            np.maximum(overdispersion[:, :-1], 1.0),
        )

    def after(self, picks: ListOf[int]) -> Array:
        """Return the covariance after these recordings, (n, P, P)."""
        return self._covariance_with(self.information[:, list(picks)].sum(axis=1))

    def _covariance_with(self, normal: Array) -> Array:
        """Return the covariance after recordings with this information, (…, n, P, P)."""
        size = np.sqrt(np.maximum(np.einsum("...ii->...i", normal), MIN_INFORMATION))
        scale = size[..., :, None] * size[..., None, :]
        least = MIN_INFORMATION * np.eye(normal.shape[-1])
        scaled = normal / scale + least  # with a diagonal of one
        less_sure = scaled / np.sqrt(self.overdispersion)[:, None, :]
        added = less_sure @ np.linalg.solve(scaled, np.swapaxes(less_sure, -1, -2))
        added = size[..., :, None] * added * size[..., None, :]
        present = np.linalg.inv(self.covariance)
        return np.asarray(np.linalg.inv(present + added))

    def _mean_log_error(self, normal: Array) -> Array:
        """Return the mean over joints and parameters of the logarithm of the standard error then,
        (…,).
        """
        variance = np.einsum("...ii->...i", self._covariance_with(normal))
        return np.asarray(0.5 * np.log(variance).mean(axis=(-2, -1)))

    def choose(self, seconds: float) -> list[int]:
        """Return the best recordings in so much time, s: greedily by gain per second, then by
        exchanges.
        """
        picks = [recording for recording, _ in self.greedy(seconds)]
        if not picks:
            return picks
        error = float(self._mean_log_error(self.information[:, picks].sum(axis=1)))
        for _ in range(2 * len(picks)):
            exchanges = self._exchanges(picks, seconds)
            if not exchanges:
                break
            error_then, place, recording = min(exchanges)
            if error_then > error - MIN_GAIN:
                break
            error = error_then
            picks[place] = recording
        return picks

    def _exchanges(self, picks: list[int], seconds: float) -> list[tuple[float, int, int]]:
        """Return all exchanges of one pick for another recording in so much time, s: mean log error
        after it, place among the picks, and recording.
        """
        exchanges = []
        for place in range(len(picks)):
            kept = picks.copy()
            del kept[place]
            others = self._that_fit(kept, seconds, without=picks)
            errors = self._errors_with(kept, others)
            for recording, error in zip(others.tolist(), errors.tolist(), strict=True):
                exchanges.append((error, place, recording))
        return exchanges

    def _that_fit(self, picks: list[int], seconds: float, without: list[int]) -> Array:
        """Return the recordings, without some, that fit into a time beside the picks, (more,)."""
        left = seconds - self.seconds[picks].sum()
        return np.setdiff1d(np.flatnonzero(self.seconds <= left), without)

    def greedy(self, seconds: float = np.inf) -> Iterator[tuple[int, float]]:
        """Yield the recording with the largest gain per second, one after another, and the mean
        log error after it.
        """
        picks = list[int]()
        now = float(self._mean_log_error(np.zeros_like(self.information[:, 0])))
        while True:
            others = self._that_fit(picks, seconds, without=picks)
            if not len(others):
                return
            then = self._errors_with(picks, others)
            gain_per_second = (now - then) / self.seconds[others]
            best = int(gain_per_second.argmax())
            recording = int(others[best])
            picks.append(recording)
            now = float(then[best])
            yield recording, now

    def _errors_with(self, picks: ListOf[int], more: Array) -> Array:
        """Return the mean log error after the picks and each of some more recordings, (more,)."""
        here = self.information[:, list(picks)].sum(axis=1)
        return self._mean_log_error(here + np.swapaxes(self.information[:, more], 0, 1))

    def worth(self) -> float:
        """Return the seconds after which WORTH_INTERVAL_S more reduce the errors by less than
        MIN_WORTH, on average.
        """
        played = 0.0
        before = float(self._mean_log_error(np.zeros_like(self.information[:, 0])))
        for recording, now in self.greedy():
            seconds = float(self.seconds[recording])
            if (before - now) * WORTH_INTERVAL_S / seconds < MIN_WORTH:
                return played
            played += seconds
            before = now
        return played


def candidate_motions(library: Library, progress: Progress = no_progress) -> list[Motion]:
    """Return motions within a robot's limits: single joints, tours, and all joints at once with a
    signal each.
    """
    robot = library.robot
    names = _candidate_names(robot)
    count = len(names) + MOTIONS_OF_ALL_JOINTS
    motions = []
    for number in range(count):
        progress(number, count, "which motions fit the robot's limits")
        try:
            if number < len(names):
                motion = library.make(names[number])
            else:
                motion = _at_once(library, number - len(names))
        except UsageError:  # does not fit this robot's limits: no candidate
            continue
        motions.append(motion)
    if not motions:
        raise UsageError(
            f"{robot.name}: no motion fits its limits; lighten --payloads, or look at "
            "collision.toml"
        )
    return motions


def _candidate_names(robot: RobotSpec) -> list[str]:
    """Return names in a motion library: signals in single joints, of a robot with few; tours and
    the like.
    """
    names = []
    if len(robot.operated) <= MAX_SINGLE_JOINTS:
        for joint in robot.operated:
            names += [f"{signal}-{short(joint, robot)}" for signal in SIGNALS]
    for kind in ANY:
        names += [f"{kind.__name__}-all-{variant}" for variant in range(VARIANTS)]
    return names


def _at_once(library: Library, variant: int) -> Motion:
    """Return a motion in which every operated joint plays a signal of its own around the ready
    posture.
    """
    robot = library.robot
    rng = np.random.default_rng([library.seed, 5, variant])
    kinds = list(SIGNALS.values())
    signals = {}  # joint's number → its commands, (rows,) rad
    for joint in robot.operated:
        i = robot.index([joint])[0]
        interval = library.excitation_range(joint)
        ready = library.kit.ready[i]
        low = ready + RANGE_SHARE * (interval.low - ready)
        high = ready + RANGE_SHARE * (interval.high - ready)
        kind = kinds[rng.integers(len(kinds))]
        signals[i] = kind(low, high, rng, GRID)
    rows = max(map(len, signals.values()))
    ctrl = np.repeat(library.kit.ready[None], rows, axis=0)
    for i, signal in signals.items():
        ctrl[: len(signal), i] = signal
        ctrl[len(signal) :, i] = signal[-1]
    made = Motion(f"together-{variant}", "whole_body", GRID, ctrl, robot.operated)
    return library.limits.fit(made)


def simulated_recordings(
    robot: RobotSpec,
    motions: ListOf[Motion],
    payload: float,
) -> list[Sequence]:
    """Return recordings of motions that the robot would make as it is identified."""
    commanded = []
    for motion in motions:
        ctrl = motion.sample(robot.dt).astype(np.float32)
        name = f"{motion.name} {payload:g} kg"
        meta = SequenceMeta(robot.name, "expected", name, payload, virtual=True)
        resting = np.zeros_like(ctrl)
        commanded.append(Sequence(meta, robot.joint_names, robot.dt, ctrl, ctrl, resting))
    replays = replay(commanded, robot, lock_idle=True)
    recordings = []
    for s, simulated in zip(commanded, replays, strict=True):
        recordings.append(replace(s, qpos=simulated.qpos, qvel=simulated.qvel))
    return recordings


def undetermined_gains(
    uncertainty: ParameterUncertainty, design: ExperimentDesign
) -> dict[str, str]:
    """Return joint → advice for joints whose kp all recordings of the design together do not
    determine.
    """
    kp = uncertainty.fields.index("kp")
    after_all = design.after(range(len(design.seconds)))
    errors = np.sqrt(after_all[:, kp, kp]).tolist()  # of log kp, (n,)
    advice = {}
    for joint, error in zip(uncertainty.joints, errors, strict=True):
        if error > MAX_KP_ERROR:
            advice[joint] = (
                "nothing loads it, so no motion separates kp from friction and damping "
                f"(± {error:.0%} after all of them); take its numbers as a set, or load it: weigh "
                "a payload, --payloads 0 KG"
            )
    return advice
