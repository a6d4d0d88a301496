"""Choice of the motions whose recordings would reduce a robot's parameter uncertainty most.

Every candidate is played in the identified simulator. The derivative of its path by a servo parameter is the
information that a recording of it would hold. The overdispersion of this robot's recordings (uncertainty.json) accounts
for model errors that last. The chosen motions minimise the sum of the logarithms of the standard errors, each parameter
by itself, since parameters that are only known together are to be separated. It is a greedy design with exchanges
(Pukelsheim, Optimal Design of Experiments, 2006).
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
from gaponet.robot.spec import RobotSpec
from gaponet.sim.dynamics import static_torque
from gaponet.sim.model import build_model
from gaponet.sim.replay import replay
from gaponet.sysid.evidence import evidence
from gaponet.sysid.motion.excite import SIGNALS
from gaponet.sysid.motion.feasible import TORQUE_SHARE
from gaponet.sysid.motion.library import Library, short
from gaponet.sysid.motion.motion import GRID, Motion
from gaponet.sysid.motion.whole_body import ANY
from gaponet.sysid.uncertainty import ParameterUncertainty

ALL_AT_ONCE, VARIANTS = 24, 4  # candidates in which every joint plays a signal of its own; tours and the like
ALONE = 8  # joints: of a robot with more, none is moved by itself
AWAY = 0.5  # of a joint's interval: how far from home it plays beside others
PACE, LITTLE = 30.0, 0.05  # s; so long that makes no error smaller than this share is not worth playing
LOOSE = 0.1  # of kp: an error as large after all motions says that they do not tell it
MASSES = (3.0, 2.0, 1.0, 0.5, 0.2, 0.1, 0.05)  # kg: what a payload might tell is tried with the heaviest that is held
NONE = 1e-9


@dataclass(frozen=True)
class ExperimentDesign:
    """What R recordings would tell of n joints' P numbers, on the axes of sysid/uncertainty.py.

    Attributes:
        normals: Slopes of the path over the numbers, squared, (n, R, P, P).
        seconds: (R,).
        covariance: Known already, (n, P, P).
        scatter: How much farther recordings pull apart than independent rows, (n, P).
    """

    normals: Array
    seconds: Array
    covariance: Array
    scatter: Array

    @classmethod
    def from_recordings(
        cls, robot: RobotSpec, known: ParameterUncertainty, played: ListOf[Sequence], nthread: int = 0
    ) -> ExperimentDesign:
        """What recordings would tell that the identified robot would make; their names differ."""
        says = evidence(robot, played, known.fields, 10**6, nthread).by_recording()
        kept = lambda what: np.stack([known.array(j, what) for j in robot.operated])  # noqa: E731
        scatter = np.maximum(kept("overdispersion")[:, :-1], 1.0)
        return cls(says.normals[..., :-1, :-1], np.array([s.duration for s in played]), kept("covariance"), scatter)

    def after(self, picks: ListOf[int]) -> Array:
        """Covariance when these have been recorded too, (n, P, P)."""
        return self._joined(self.normals[:, list(picks)].sum(axis=1))

    def _joined(self, normal: Array) -> Array:
        """Covariance after recordings with these slopes squared, (…, n, P, P)."""
        size = np.sqrt(np.maximum(np.einsum("...ii->...i", normal), NONE))
        share = normal / (size[..., :, None] * size[..., None, :]) + NONE * np.eye(normal.shape[-1])
        scaled = share / np.sqrt(self.scatter)[:, None, :]
        told = scaled @ np.linalg.solve(share, np.swapaxes(scaled, -1, -2))
        told = size[..., :, None] * told * size[..., None, :]
        return np.asarray(np.linalg.inv(np.linalg.inv(self.covariance) + told))

    def _errors(self, normal: Array) -> Array:
        """Mean over joints and numbers of the logarithm of the standard error then, (…,)."""
        variance = np.einsum("...ii->...i", self._joined(normal))
        return np.asarray(0.5 * np.log(variance).mean(axis=(-2, -1)))

    def choose(self, seconds: float) -> list[int]:
        """Recordings that tell most in so much time: the most a second, one after another, then exchanged."""
        picks = [i for i, _ in self.greedy(seconds)]
        best = float(self._errors(self.normals[:, picks].sum(axis=1))) if picks else np.inf
        for _ in range(2 * len(picks)):
            tried = [
                (float(e), k, int(i))
                for k in range(len(picks))
                for rest in [[*picks[:k], *picks[k + 1 :]]]
                for fits in [np.setdiff1d(np.flatnonzero(self.seconds <= seconds - self.seconds[rest].sum()), picks)]
                for i, e in zip(fits, self._with(rest, fits), strict=True)
            ]
            if not tried or min(tried)[0] > best - NONE:
                break
            best, k, i = min(tried)
            picks[k] = i
        return picks

    def greedy(self, seconds: float = np.inf) -> Iterator[tuple[int, float]]:
        """One after another: the recording that tells most a second, and the mean logarithm of the errors after it."""
        picks = list[int]()
        now = float(self._errors(np.zeros_like(self.normals[:, 0])))
        while len(fits := np.setdiff1d(np.flatnonzero(self.seconds <= seconds - self.seconds[picks].sum()), picks)):
            then = self._with(picks, fits)
            best = int(((now - then) / self.seconds[fits]).argmax())
            picks, now = [*picks, int(fits[best])], float(then[best])
            yield picks[-1], now

    def _with(self, picks: ListOf[int], more: Array) -> Array:
        """Mean logarithm of the errors with each of some more recordings, (more,)."""
        here = self.normals[:, list(picks)].sum(axis=1)
        return self._errors(here + np.swapaxes(self.normals[:, more], 0, 1))

    def worth(self) -> float:
        """Seconds after which PACE more make the errors smaller by less than LITTLE, on average."""
        played, before = 0.0, float(self._errors(np.zeros_like(self.normals[:, 0])))
        for i, now in self.greedy():
            if (before - now) * PACE / self.seconds[i] < LITTLE:
                return played
            played, before = played + float(self.seconds[i]), now
        return played


def candidates(library: Library, progress: Progress = no_progress) -> list[Motion]:
    """Motions within a robot's limits: joints alone, tours, and all joints at once with a signal each."""
    robot = library.robot
    alone = [f"{s}-{short(j)}" for j in robot.operated for s in SIGNALS] if len(robot.operated) <= ALONE else []
    names = [*alone, *(f"{kind.__name__}-all-{v}" for kind in ANY for v in range(VARIANTS))]
    found = []
    for k in range(len(names) + ALL_AT_ONCE):
        progress(k, len(names) + ALL_AT_ONCE, "which motions fit the robot's limits")
        try:
            found.append(library.make(names[k]) if k < len(names) else _at_once(library, k - len(names)))
        except UsageError:  # does not fit this robot's limits: no candidate
            continue
    if not found:
        raise UsageError(f"{robot.name}: no motion fits its limits; lighten --payloads, or look at collision.toml")
    return found


def _at_once(library: Library, variant: int) -> Motion:
    """Every operated joint plays a signal of its own, around the posture from which all motions begin."""
    robot, rng = library.robot, np.random.default_rng([library.seed, 5, variant])
    kinds = list(SIGNALS.values())
    columns = {}
    for joint in robot.operated:
        i, stage = robot.index([joint])[0], library.stage(joint)
        low, high = (library.kit.ready[i] + AWAY * (end - library.kit.ready[i]) for end in (stage.low, stage.high))
        columns[i] = kinds[rng.integers(len(kinds))](min(low, high), max(low, high), rng, GRID)
    ctrl = np.repeat(library.kit.ready[None], max(map(len, columns.values())), axis=0)
    for i, column in columns.items():
        ctrl[:, i] = np.concatenate([column, np.full(len(ctrl) - len(column), column[-1])])
    made = Motion(f"together-{variant}", "whole_body", GRID, ctrl, robot.operated)
    return library.limits.fit(made)


def expected(robot: RobotSpec, motions: ListOf[Motion], payload: float, nthread: int = 0) -> list[Sequence]:
    """What recordings of motions would be if the robot were as it is identified."""
    asked = []
    for motion in motions:
        ctrl = motion.sample(robot.dt).astype(np.float32)
        meta = SequenceMeta(robot.name, "expected", f"{motion.name} {payload:g} kg", payload, virtual=True)
        asked.append(Sequence(meta, robot.joint_names, robot.dt, ctrl, ctrl, np.zeros_like(ctrl)))
    twins = replay(asked, robot, nthread=nthread, lock_idle=True)
    return [replace(s, qpos=t.qpos, qvel=t.qvel) for s, t in zip(asked, twins, strict=True)]


def open_gains(
    robot: RobotSpec,
    known: ParameterUncertainty,
    told: ExperimentDesign,
    motions: ListOf[Motion],
    payloads: ListOf[float],
) -> dict[str, str]:
    """Joints whose kp none of these motions tells, with what would."""
    kp = known.fields.index("kp")

    def errors(of: ExperimentDesign) -> dict[str, float]:
        whole = of.after(range(len(of.seconds)))
        return dict(zip(known.joints, np.sqrt(whole[:, kp, kp]).tolist(), strict=True))

    left = {j: e for j, e in errors(told).items() if e > LOOSE}
    mass = _held(robot, motions) if left and max(payloads) == 0 else None
    tried = {}
    if mass is not None:
        with_it = ExperimentDesign.from_recordings(robot, known, expected(robot, motions, mass))
        tried = errors(replace(told, normals=np.concatenate([told.normals, with_it.normals], axis=1)))
    return {j: _advice(e, tried.get(j), mass, bool(robot.payload_mounts), max(payloads)) for j, e in left.items()}


def _advice(error: float, tried: float | None, mass: float | None, hand: bool, most: float) -> str:
    """What to do about a joint of which motions show friction, damping and offset over kp, and not kp."""
    said = f"nothing loads it, so no motion tells kp from friction and damping (± {error:.0%} after all of them)"
    if tried is not None and tried < min(LOOSE, 0.5 * error):
        return f"{said}; {mass:g} kg in the hand would, to ± {tried:.0%}: weigh it, --payloads 0 {mass:g}"
    if mass is not None:
        return f"{said}, nor would {mass:g} kg in the hand (± {tried:.0%}); take its numbers as a set"
    if hand and not most:
        return f"{said}, and no payload can be held in all of them; take its numbers as a set"
    return f"{said}; take its numbers as a set{'' if hand else ', or give robot.toml a [[payload_mount]]'}"


def _held(robot: RobotSpec, motions: ListOf[Motion]) -> float | None:
    """The heaviest of MASSES that all motions can be held with, kg."""
    postures = np.concatenate([m.ctrl[::50] for m in motions])
    for mass in MASSES if robot.payload_mounts else ():
        if (np.abs(static_torque(build_model(robot, mass), postures)) <= TORQUE_SHARE * robot.effort_limit).all():
            return mass
    return None
