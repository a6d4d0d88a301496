"""Logs that pass in silence where nobody looks: seven faults in recordings of VIRTUAL robots.

    python benchmarks/wrong_records.py WORK --mutations 200 --seed 0

Robot, rate, clock, digits, names of columns and units are drawn for each mutation. Each log is
imported and examined as a user would do it. Counted are, by fault: "named", the import or the
doctor names it; "stopped", another error or refusal; "untold", the doctor says that gravity and
inertia do not tell it; "silent", none of these. Good logs of the same draws count as "false" where
an error is found in them. The exit code is 1 where one is silent or false.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections import Counter
from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
from common import command_line

from gaponet import api
from gaponet.base.errors import GAPONetError
from gaponet.robot.finding import Finding
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.model import build_model

ROBOTS = 12  # drawn for each seed
SECONDS = 8.0
MOTIONS = 2
STEP_S = 1e-3  # of the recorded truth
GOOD = "good"
CLOCK_NAMES = (
    "real_time",
    "timestamp",
    "t_host",
    "elapsed_ms",
    "stamp_ns",
    "wallClock",
    "cpu_time",
)
UNTOLD = "do not tell whether"  # words of a finding about what cannot be known
LINK = (
    '<body name="link{i}" pos="{x} 0 0"><joint name="joint{i}" axis="{axis}" range="-2.6 2.6" '
    'damping="{damping}" armature="{armature}" frictionloss="{friction}"/>'
    '<geom type="capsule" fromto="0 0 0 {length} 0 0" size="0.02" '
    'mass="{mass}" contype="0" conaffinity="0"/>{inner}</body>'
)
Columns = dict[str, np.ndarray]


@dataclass(frozen=True)
class Motion:
    """What a robot did: times (k,) s, and commands, positions, velocities and torques (k, n),
    SI.
    """

    time: np.ndarray
    ctrl: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    tau: np.ndarray

    def rows(self, keep: np.ndarray) -> Motion:
        """Select rows."""
        return Motion(
            self.time[keep], self.ctrl[keep], self.qpos[keep], self.qvel[keep], self.tau[keep]
        )


@dataclass
class Truth:
    """A drawn robot and its motions."""

    robot: RobotSpec
    motions: list[Motion]


@dataclass
class Record:
    """One log before it is written: clock (k,) s, arrays (k, n) in SI, and further columns."""

    time: np.ndarray
    ctrl: np.ndarray
    qpos: np.ndarray
    tau: np.ndarray | None = None
    extra: Columns | None = None


def draw_robot(folder: Path, rng: np.random.Generator) -> RobotSpec:
    """Write a chain of two to five joints as a robot folder."""
    count = int(rng.integers(2, 6))
    inner = ""
    joints: list[str] = []
    for i in reversed(range(count)):
        mass = rng.uniform(0.1, 1.0)
        length = rng.uniform(0.1, 0.35)
        beyond = sum(rng.uniform(0.2, 0.5) for _ in range(count - i))
        kp = float(rng.uniform(20, 120)) * beyond
        kd = kp * rng.uniform(0.01, 0.06)
        joint = f'name = "joint{i}"\nkp = {kp:.3f}\nkd = {kd:.3f}\neffort_limit = 60.0\n'
        joints.insert(0, f"[[joint]]\n{joint}")
        inner = LINK.format(
            i=i,
            x=rng.uniform(0.1, 0.3) if i else 0,
            axis=("0 1 0", "0 0 1", "1 0 0")[i % 3],
            damping=rng.uniform(0.01, 0.2),
            armature=rng.uniform(0.005, 0.05),
            friction=rng.uniform(0, 0.1),
            length=length,
            mass=mass,
            inner=inner,
        )
    folder.mkdir(parents=True)
    (folder / "robot.xml").write_text(
        '<mujoco><compiler angle="radian" autolimits="true"/><option integrator="implicitfast"/>'
        f"<worldbody>{inner}</worldbody></mujoco>"
    )
    (folder / "robot.toml").write_text(
        'name = "drawn"\ndt = 0.02\ntimestep = 0.002\n' + "".join(joints)
    )
    return load_robot(folder)


def play(robot: RobotSpec, rng: np.random.Generator) -> Motion:
    """Simulate a motion with a delay of the commands."""
    rows = round(SECONDS / STEP_S)
    n = len(robot.joint_names)
    time = STEP_S * np.arange(rows)
    ctrl = np.zeros((rows, n))
    for _ in range(4):
        hertz = rng.uniform(0.1, 1.2, n)
        phase = rng.uniform(0, 2 * np.pi, n)
        size = rng.uniform(0.05, 0.35, n)
        ctrl += size * np.sin(2 * np.pi * hertz * time[:, None] + phase)
    model = build_model(robot)
    model.opt.timestep = STEP_S
    data = mujoco.MjData(model)
    data.qpos[:] = ctrl[0]
    late = round(rng.uniform(0.0, 0.06) / STEP_S)
    qpos = np.zeros((rows, n))
    qvel = np.zeros((rows, n))
    tau = np.zeros((rows, n))
    for t in range(rows):
        qpos[t] = data.qpos
        qvel[t] = data.qvel
        data.ctrl[:] = ctrl[max(t - late, 0)]
        mujoco.mj_step(model, data)
        tau[t] = data.actuator_force
    return Motion(time, ctrl, qpos + rng.normal(0, 1e-4, qpos.shape), qvel, tau)


# ---- what loggers make of a motion


def sampled(motion: Motion, rng: np.random.Generator) -> Motion:
    """Return rows of a motion on a drawn clock, even or not."""
    rate = float(np.exp(rng.uniform(np.log(15), np.log(500))))
    time = np.arange(0.05, SECONDS - 0.05, 1 / rate)
    if rng.random() < 0.5:
        time = time + rng.uniform(-0.35, 0.35, len(time)) / rate
    return replace(motion.rows(np.searchsorted(motion.time, time)), time=time)


def rounded(values: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return values with a drawn number of digits, or in the steps of an encoder."""
    kind = rng.integers(3)
    step = [1e-9, 10.0 ** -rng.integers(3, 7), 2 * np.pi / 2 ** rng.integers(11, 16)][kind]
    return np.round(values / step) * step


def good(motion: Motion, rng: np.random.Generator) -> Record:
    """What a careful logger writes."""
    log = sampled(motion, rng)
    ctrl = rounded(log.ctrl, rng)
    qpos = rounded(log.qpos, rng)
    has_torque = rng.random() < 0.5
    return Record(log.time, ctrl, qpos, log.tau if has_torque else None)


def copied(motion: Motion, rng: np.random.Generator) -> Record:
    """The command is the position of a row before or after."""
    log = sampled(motion, rng)
    qpos = rounded(log.qpos, rng)
    shift = int(rng.choice([-3, -2, -1, 0, 1, 2, 3]))
    keep = slice(3, -3)
    has_torque = shift != 0 and rng.random() < 0.5
    ctrl = np.roll(qpos, -shift, axis=0)
    return Record(log.time[keep], ctrl[keep], qpos[keep], log.tau[keep] if has_torque else None)


def not_measured(motion: Motion, rng: np.random.Generator) -> Record:
    """The position is the command of a row before, rounded otherwise."""
    log = sampled(motion, rng)
    shift = int(rng.integers(1, 4))
    digits = int(rng.integers(4, 7))
    earlier = np.roll(log.ctrl, shift, axis=0)
    return Record(log.time[3:], log.ctrl[3:], np.round(earlier[3:], digits))


def by_torque(motion: Motion, rng: np.random.Generator) -> Record:
    """Torque or current was the command; the position's column stands for the command."""
    log = sampled(motion, rng)
    qpos = rounded(log.qpos, rng)
    return Record(log.time, qpos, qpos, log.tau / rng.uniform(0.05, 2.0))


def two_clocks(motion: Motion, rng: np.random.Generator) -> Record:
    """A second column runs like a clock at another rate."""
    record = good(motion, rng)
    ratio = float(rng.choice([rng.uniform(0.2, 0.9), rng.uniform(1.1, 6)]))
    name = str(rng.choice(CLOCK_NAMES))
    unit = float(rng.choice([1.0, 1e3, 1e9]))
    record.extra = {name: unit * (rng.uniform(0, 1e3) + ratio * record.time)}
    return record


def velocity(motion: Motion, rng: np.random.Generator) -> Record:
    """A velocity stands where command or position is expected."""
    log = sampled(motion, rng)
    if rng.random() < 0.5:
        told = np.gradient(log.ctrl, log.time, axis=0)
        return Record(log.time, rounded(told, rng), rounded(log.qpos, rng))
    return Record(log.time, rounded(log.ctrl, rng), rounded(log.qvel, rng))


def exchanged(motion: Motion, rng: np.random.Generator) -> Record:
    """Positions of joints stand under each other's names."""
    record = good(motion, rng)
    record.qpos = record.qpos[:, _another_order(record.qpos.shape[1], rng)]
    return record


def exchanged_in_both(motion: Motion, rng: np.random.Generator) -> Record:
    """Commands, positions and torques of joints stand under each other's names."""
    record = good(motion, rng)
    order = _another_order(record.qpos.shape[1], rng)
    record.ctrl = record.ctrl[:, order]
    record.qpos = record.qpos[:, order]
    if record.tau is not None:
        record.tau = record.tau[:, order]
    return record


def _another_order(n: int, rng: np.random.Generator) -> np.ndarray:
    """Return a permutation of n joints that is not their own order."""
    own = np.arange(n)
    order = own
    while (order == own).all():
        order = rng.permutation(n)
    return order


@dataclass(frozen=True)
class Fault:
    """How a fault is put into a record, and words of which a message that names it has one."""

    make: Callable[[Motion, np.random.Generator], Record]
    words: tuple[str, ...]


FAULTS = {
    "command is the position of another row": Fault(copied, ("copied",)),
    "position is a rounded command": Fault(not_measured, ("copied",)),
    "driven by torque": Fault(by_torque, ("torque",)),
    "two clocks": Fault(two_clocks, ("run like clocks",)),
    "velocity for a position": Fault(velocity, ("command", "velocit", "degrees")),
    "joints exchanged": Fault(exchanged, ("order", "range")),
    "joints exchanged in command and state": Fault(exchanged_in_both, ("place", "order of joints")),
    GOOD: Fault(good, ()),
}


def write(
    folder: Path, records: list[Record], joints: tuple[str, ...], rng: np.random.Generator
) -> None:
    """Write the records as CSV with drawn names of columns and units, and a logs.toml."""
    separator = str(rng.choice([",", ";", "\t"]))
    names = [["{}_des", "{}_pos"], ["q_cmd_{}", "q_act_{}"], ["target.{}", "measured.{}"]]
    command, state = rng.choice(names)
    scale = float(rng.choice([1.0, 180 / np.pi]))
    per_second, unit = [(1.0, "s"), (1e3, "ms"), (1e6, "us")][rng.integers(3)]
    folder.mkdir(parents=True)
    for k, record in enumerate(records):
        columns = {"t": per_second * record.time} | (record.extra or {})
        for j, joint in enumerate(joints):
            columns[command.format(joint)] = scale * record.ctrl[:, j]
            columns[state.format(joint)] = scale * record.qpos[:, j]
            if record.tau is not None:
                columns[f"tau_{joint}"] = record.tau[:, j]
        file = folder / f"m{k}.csv"
        table = np.stack(list(columns.values()), axis=1)
        np.savetxt(file, table, "%.12g", separator, header=separator.join(columns), comments="")
    angle = "rad" if scale == 1 else "deg"
    lines = [
        'time = "t"',
        f'time_unit = "{unit}"',
        f'position_unit = "{angle}"',
        f'ctrl = "{command.format("{joint}")}"',
        f'qpos = "{state.format("{joint}")}"',
    ]
    if records[0].tau is not None:
        lines.append('tau = "tau_{joint}"')
    (folder / "logs.toml").write_text("\n".join(lines) + "\n")


def outcome(place: Path, truth: Truth, fault: Fault, rng: np.random.Generator) -> tuple[str, str]:
    """Import and examine one mutation: its count (see the top of the file), and the words."""
    state = rng.bit_generator.state
    records = []
    for motion in truth.motions:
        rng.bit_generator.state = state  # the same clock, digits and fault in all motions
        records.append(fault.make(motion, rng))
    write(place / "logs", records, truth.robot.joint_names, rng)
    try:
        made = api.import_logs(
            place / "logs", robot=truth.robot, out=place / "data", unit_id="u", payload_mass=0.0
        )
        findings = api.doctor(made.dataset, robot=truth.robot).findings
    except GAPONetError as error:
        said = str(error)
        return ("named" if _is_named(said, fault) else "stopped"), said
    bad = [finding for finding in findings if finding.level in ("error", "warning")]
    said = "; ".join(f"{f.level} {f.check}: {f.message}" for f in bad)
    return _count(fault, findings, bad), said


def _count(fault: Fault, findings: ListOf[Finding], bad: list[Finding]) -> str:
    """Return as what a mutation counts that was imported; `bad` are warnings and errors."""
    has_error = any(finding.level == "error" for finding in bad)
    if not fault.words:
        return "false" if has_error else "good"
    if any(_is_named(f"{finding.check}: {finding.message}", fault) for finding in bad):
        return "named"
    if any(UNTOLD in finding.message for finding in findings):
        return "untold"
    return "stopped" if has_error else "silent"


def _is_named(text: str, fault: Fault) -> bool:
    return any(word in text for word in fault.words)


def draw_truths(work: Path, seed: int) -> list[Truth]:
    """Draw the robots of a seed and their motions."""
    rng = np.random.default_rng(seed)
    truths = []
    for k in range(ROBOTS):
        robot = draw_robot(work / f"robot{seed}_{k}", rng)
        truths.append(Truth(robot, [play(robot, rng) for _ in range(MOTIONS)]))
    return truths


def main() -> int:
    parser = command_line(__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--mutations", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=FAULTS)
    parser.add_argument("--keep", action="store_true", help="keep logs that pass in silence")
    args = parser.parse_args()
    truths = draw_truths(args.work, args.seed)
    is_wrong = False
    for number, (name, fault) in enumerate(FAULTS.items()):
        if args.only not in (None, name):
            continue
        counts: Counter[str] = Counter()
        for k in range(args.mutations):
            place = args.work / f"{name.replace(' ', '_')}_{args.seed}_{k}"
            shutil.rmtree(place, ignore_errors=True)
            draw = np.random.default_rng((args.seed, number, k))
            result, said = outcome(place, truths[k % ROBOTS], fault, draw)
            counts[result] += 1
            if result in ("silent", "false", "stopped"):
                print(f"{name} {k}: {result}: {said[:300]}", file=sys.stderr)
            is_kept = args.keep and result in ("silent", "false")
            if not is_kept:
                shutil.rmtree(place, ignore_errors=True)
        print(json.dumps({name: counts}), flush=True)
        is_wrong |= counts["silent"] + counts["false"] > 0
    return int(is_wrong)


if __name__ == "__main__":
    sys.exit(main())
