"""Methods of the benchmark: each is given a question and answers with a simulator (docs/benchmark.md adds one)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.data.sequence import Sequence
from gaponet.experiments.real.questions import Question, recorded, rehearsal
from gaponet.nn.delay_offset import DelayOffset
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.replay import Corrector, replay
from gaponet.sysid.identify import identify
from gaponet.sysid.refit import refit
from gaponet.sysid.robot_rollouts import WINDOW

LEFT_OUT = "left out"  # by validation: begins a note
SECONDS = 30.0  # of the test's own session that adaptation may use


@dataclass(frozen=True)
class Answer:
    """A simulator: robot, what corrects its targets, what is added to positions.

    `corrector` is reset and asked as gaponet.sim.replay.Corrector says; `shift` returns (n,) rad of all joints; `note`
    says what a reader of the table must know.
    """

    robot: RobotSpec
    corrector: Corrector | None = None
    shift: Callable[[Sequence], Array] | None = None
    note: str = ""

    def positions(self, sequences: list[Sequence]) -> list[Array]:
        """Free runs, (T, n) rad each."""
        twins = replay(sequences, self.robot, self.corrector, lock_idle=True)
        return [t.qpos + (self.shift(s) if self.shift else 0.0) for s, t in zip(sequences, twins, strict=True)]

    def errors(self, sequences: list[Sequence]) -> list[float]:
        """Mean |error| of each free run, over the joints that were recorded, rad."""
        runs = self.positions(sequences)
        return [
            float(np.abs((q - s.qpos)[1:, recorded(s, self.robot)]).mean())
            for s, q in zip(sequences, runs, strict=True)
        ]


Method = Callable[[Question], Answer]


def nominal(question: Question) -> Answer:
    """The robot folder as it is."""
    return Answer(question.robot)


def delay_offset(question: Question) -> Answer:
    """A delay and an offset of each joint."""
    return Answer(question.robot, fitted(question).corrector(question.robot))


def fitted(question: Question) -> DelayOffset:
    """Delay and offset, which networks keep beside them."""
    return question.once("delay + offset", lambda: DelayOffset.fit(question.known, question.robot))


def constant(question: Question) -> Answer:
    """An adversary: what the nominal simulator is off by in the mean, for each joint, payload and unit; it sees what
    adaptation sees."""
    robot, n, seen = question.robot, len(question.robot.joint_names), question.known + question.few
    off: dict[tuple[object, ...], list[Array]] = {}
    for s, q in zip(seen, Answer(robot).positions(seen), strict=True):
        mine, bias = recorded(s, robot), np.full(n, np.nan)
        bias[mine] = (s.qpos - q)[1:, mine].mean(axis=0)
        for key in ((s.meta.payload_mass, s.meta.unit_id), (s.meta.payload_mass,), ()):
            off.setdefault(key, []).append(bias)

    def shift(s: Sequence) -> Array:
        found = np.zeros(n)
        for key in ((), (s.meta.payload_mass,), (s.meta.payload_mass, s.meta.unit_id)):
            rows = np.array(off.get(key, np.full((1, n), np.nan)))
            known = np.isfinite(rows).any(axis=0)
            found[known] = np.nanmean(rows[:, known], axis=0)
        return found

    return Answer(robot, shift=shift)


def identified(question: Question) -> Answer:
    """gaponet identify."""
    return Answer(question.once("identified", lambda: _identify(question)))


def adapted(question: Question) -> Answer:
    """The robot identified elsewhere (or on the others), fitted to a little of what is tested."""
    if not question.few:
        raise UsageError(f"{question.name}: there is nothing of the test's own to adapt with")
    start, few = identified(question).robot if question.before is None else question.before(), question.few
    seconds = len(few) * WINDOW if few[0].duration < WINDOW else SECONDS  # all windows that are shorter than one
    found = refit(few, start, seconds, judge=True)
    return Answer(found.robot if found.kept else start)


def elsewhere(question: Question) -> Answer:
    """The robot as it was identified in another session, as it is."""
    if question.before is None:
        raise UsageError(f"{question.name}: the robot was identified nowhere else")
    return Answer(question.before())


METHODS: dict[str, tuple[str, Method]] = {
    "nominal": ("nominal simulator", nominal),
    "constant": ("constant offset by joint, payload, unit", constant),
    "delay_offset": ("delay + offset", delay_offset),
    "elsewhere": ("identified elsewhere", elsewhere),
    "identified": ("identification", identified),
    "adapted": ("identified elsewhere, adapted", adapted),
}


def _identify(question: Question) -> RobotSpec:
    """The command's result, kept where the question has a folder."""
    kept = question.work and question.work / "identified"
    if kept and (kept / "robot.toml").is_file():
        return load_robot(kept)
    train, val = rehearsal(question)
    found = identify(train, question.robot, val).robot
    if kept:
        save_robot(found, kept)
    return found
