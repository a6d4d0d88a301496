"""Logs that pass in silence where nobody looks: seven faults in recordings of VIRTUAL robots.

    python benchmarks/wrong_records.py WORK --mutations 200 --seed 0

Robot, rate, clock, digits, names of columns and units are drawn for each mutation. Each log is
imported and examined as a user would do it. Counted are, by fault: "named", the import or the
doctor names it; "stopped", another error or refusal; "untold", the doctor says that gravity and
inertia do not tell it; "silent", none of these. Good logs of the same draws count as "false" where
an error is found in them. The exit code is 1 where one is silent or false.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from gaponet import api
from gaponet.base.errors import GAPONetError
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.model import build_model

ROBOTS = 12  # drawn for each seed
SECONDS = 8.0
MOTIONS = 2
STEP_S = 1e-3  # of the recorded truth
LINK = (
    '<body name="link{i}" pos="{x} 0 0"><joint name="joint{i}" axis="{axis}" range="-2.6 2.6" damping="{damping}" '
    'armature="{armature}" frictionloss="{friction}"/><geom type="capsule" fromto="0 0 0 {length} 0 0" size="0.02" '
    'mass="{mass}" contype="0" conaffinity="0"/>{inner}</body>'
)
Columns = dict[str, np.ndarray]


@dataclass
class Truth:
    """A drawn robot and what it did: times (k,), commands, positions, velocities and torques (k,
    n), SI.
    """

    robot: RobotSpec
    motions: list[tuple[np.ndarray, ...]]


@dataclass
class Record:
    """One log before it is written: clock (k,) s, and arrays (k, n) in SI; extra columns and words
    for logs.toml.
    """

    time: np.ndarray
    ctrl: np.ndarray
    qpos: np.ndarray
    tau: np.ndarray | None = None
    extra: Columns | None = None


def draw_robot(folder: Path, rng: np.random.Generator) -> RobotSpec:
    """Write a chain of two to five joints as a robot folder."""
    count = int(rng.integers(2, 6))
    inner, gains = "", []
    for i in reversed(range(count)):
        mass, length = rng.uniform(0.1, 1.0), rng.uniform(0.1, 0.35)
        beyond = sum(rng.uniform(0.2, 0.5) for _ in range(count - i))
        kp = float(rng.uniform(20, 120)) * beyond
        gains.append((f"joint{i}", kp, kp * rng.uniform(0.01, 0.06)))
        inner = LINK.format(
            i=i, x=rng.uniform(0.1, 0.3) if i else 0, axis=["0 1 0", "0 0 1", "1 0 0"][i % 3 if i else 0],
            damping=rng.uniform(0.01, 0.2), armature=rng.uniform(0.005, 0.05), friction=rng.uniform(0, 0.1),
            length=length, mass=mass, inner=inner,
        )  # fmt: skip
    joints = [
        f'[[joint]]\nname = "{name}"\nkp = {kp:.3f}\nkd = {kd:.3f}\neffort_limit = 60.0\n'
        for name, kp, kd in reversed(gains)
    ]
    folder.mkdir(parents=True)
    (folder / "robot.xml").write_text(
        '<mujoco><compiler angle="radian" autolimits="true"/><option integrator="implicitfast"/>'
        f"<worldbody>{inner}</worldbody></mujoco>"
    )
    (folder / "robot.toml").write_text(
        'name = "drawn"\ndt = 0.02\ntimestep = 0.002\n' + "".join(joints)
    )
    return load_robot(folder)


def play(robot: RobotSpec, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Simulate a motion with a delay of the commands: times, commands, positions, velocities,
    torques.
    """
    rows, n = round(SECONDS / STEP_S), len(robot.joint_names)
    time = STEP_S * np.arange(rows)
    ctrl = np.zeros((rows, n))
    for _ in range(4):
        hertz, phase = rng.uniform(0.1, 1.2, n), rng.uniform(0, 2 * np.pi, n)
        ctrl += rng.uniform(0.05, 0.35, n) * np.sin(2 * np.pi * hertz * time[:, None] + phase)
    model = build_model(robot)
    model.opt.timestep = STEP_S
    data = mujoco.MjData(model)
    data.qpos[:] = ctrl[0]
    late = round(rng.uniform(0.0, 0.06) / STEP_S)
    qpos, qvel, tau = np.zeros((3, rows, n))
    for t in range(rows):
        qpos[t], qvel[t] = data.qpos, data.qvel
        data.ctrl[:] = ctrl[max(t - late, 0)]
        mujoco.mj_step(model, data)
        tau[t] = data.actuator_force
    return time, ctrl, qpos + rng.normal(0, 1e-4, qpos.shape), qvel, tau


def sampled(motion: tuple[np.ndarray, ...], rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Rows of a motion on a drawn clock, even or not."""
    rate = float(np.exp(rng.uniform(np.log(15), np.log(500))))
    time = np.arange(0.05, SECONDS - 0.05, 1 / rate)
    if rng.random() < 0.5:
        time = time + rng.uniform(-0.35, 0.35, len(time)) / rate
    truth, *channels = motion
    rows = np.searchsorted(truth, time)
    return time, *(channel[rows] for channel in channels)


def rounded(values: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Values with a drawn number of digits, or in the steps of an encoder."""
    kind = rng.integers(3)
    step = [1e-9, 10.0 ** -rng.integers(3, 7), 2 * np.pi / 2 ** rng.integers(11, 16)][kind]
    return np.round(values / step) * step


def good(motion: tuple[np.ndarray, ...], rng: np.random.Generator) -> Record:
    """What a careful logger writes."""
    time, ctrl, qpos, _, tau = sampled(motion, rng)
    return Record(time, rounded(ctrl, rng), rounded(qpos, rng), tau if rng.random() < 0.5 else None)


def copied(motion: tuple[np.ndarray, ...], rng: np.random.Generator) -> Record:
    """The command is the position of a row before or after."""
    time, _, qpos, _, tau = sampled(motion, rng)
    qpos = rounded(qpos, rng)
    shift = int(rng.choice([-3, -2, -1, 0, 1, 2, 3]))
    keep = slice(3, -3)
    torque = tau if shift and rng.random() < 0.5 else None
    return Record(
        time[keep],
        np.roll(qpos, -shift, axis=0)[keep],
        qpos[keep],
        None if torque is None else torque[keep],
    )


def not_measured(motion: tuple[np.ndarray, ...], rng: np.random.Generator) -> Record:
    """The position is the command of a row before, rounded otherwise."""
    time, ctrl, _, _, _ = sampled(motion, rng)
    shift = int(rng.integers(1, 4))
    digits = int(rng.integers(4, 7))
    return Record(time[3:], ctrl[3:], np.round(np.roll(ctrl, shift, axis=0)[3:], digits))


def by_torque(motion: tuple[np.ndarray, ...], rng: np.random.Generator) -> Record:
    """Torque or current was the command; the position's column stands for the command."""
    time, _, qpos, _, tau = sampled(motion, rng)
    qpos = rounded(qpos, rng)
    return Record(time, qpos, qpos, tau / rng.uniform(0.05, 2.0))


def two_clocks(motion: tuple[np.ndarray, ...], rng: np.random.Generator) -> Record:
    """A second column runs like a clock at another rate."""
    record = good(motion, rng)
    ratio = float(rng.choice([rng.uniform(0.2, 0.9), rng.uniform(1.1, 6)]))
    name = str(
        rng.choice(
            ["real_time", "timestamp", "t_host", "elapsed_ms", "stamp_ns", "wallClock", "cpu_time"]
        )
    )
    unit = float(rng.choice([1.0, 1e3, 1e9]))
    record.extra = {name: unit * (rng.uniform(0, 1e3) + ratio * record.time)}
    return record


def velocity(motion: tuple[np.ndarray, ...], rng: np.random.Generator) -> Record:
    """A velocity stands where command or position is expected."""
    time, ctrl, qpos, qvel, _ = sampled(motion, rng)
    told = np.gradient(ctrl, time, axis=0)
    if rng.random() < 0.5:
        return Record(time, rounded(told, rng), rounded(qpos, rng))
    return Record(time, rounded(ctrl, rng), rounded(qvel, rng))


def exchanged(motion: tuple[np.ndarray, ...], rng: np.random.Generator) -> Record:
    """Positions of joints stand under each other's names."""
    record = good(motion, rng)
    n = record.qpos.shape[1]
    order = np.arange(n)
    while (order == np.arange(n)).all():
        order = rng.permutation(n)
    record.qpos = record.qpos[:, order]
    return record


def exchanged_in_both(motion: tuple[np.ndarray, ...], rng: np.random.Generator) -> Record:
    """Commands, positions and torques of joints stand under each other's names."""
    record = good(motion, rng)
    n = record.qpos.shape[1]
    order = np.arange(n)
    while (order == np.arange(n)).all():
        order = rng.permutation(n)
    record.ctrl = record.ctrl[:, order]
    record.qpos = record.qpos[:, order]
    if record.tau is not None:
        record.tau = record.tau[:, order]
    return record


UNTOLD = "do not tell whether"
FAULTS: dict[str, tuple[Callable[..., Record], tuple[str, ...]]] = {
    "command is the position of another row": (copied, ("copied",)),
    "position is a rounded command": (not_measured, ("copied",)),
    "driven by torque": (by_torque, ("torque",)),
    "two clocks": (two_clocks, ("run like clocks",)),
    "velocity for a position": (velocity, ("command", "velocit", "degrees")),
    "joints exchanged": (exchanged, ("order", "range")),
    "joints exchanged in command and state": (exchanged_in_both, ("place", "order of joints")),
    "good": (good, ()),
}


def write(
    folder: Path, records: list[Record], joints: tuple[str, ...], rng: np.random.Generator
) -> None:
    """Write the records as CSV with drawn names of columns and units, and a logs.toml."""
    separator = str(rng.choice([",", ";", "\t"]))
    command, state = rng.choice(
        [["{}_des", "{}_pos"], ["q_cmd_{}", "q_act_{}"], ["target.{}", "measured.{}"]]
    )
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
        np.savetxt(
            folder / f"m{k}.csv", np.stack(list(columns.values()), axis=1), "%.12g", separator,
            header=separator.join(columns), comments="",
        )  # fmt: skip
    lines = [
        f'time = "t"\ntime_unit = "{unit}"',
        f'position_unit = "{"rad" if scale == 1 else "deg"}"',
    ]
    lines += [f'ctrl = "{command.format("{joint}")}"', f'qpos = "{state.format("{joint}")}"']
    lines += ['tau = "tau_{joint}"'] if records[0].tau is not None else []
    (folder / "logs.toml").write_text("\n".join(lines) + "\n")


def outcome(place: Path, truth: Truth, fault: str, rng: np.random.Generator) -> tuple[str, str]:
    """Import and examine one mutation: named, stopped, silent (or good, false), and the words."""
    make, words = FAULTS[fault]
    state = rng.bit_generator.state
    records = []
    for motion in truth.motions:
        rng.bit_generator.state = state  # the same clock, digits and fault in all motions
        records.append(make(motion, rng))
    write(place / "logs", records, truth.robot.joint_names, rng)
    try:
        made = api.import_logs(
            place / "logs", robot=truth.robot, out=place / "data", unit_id="u", payload_mass=0.0
        )
        findings = api.doctor(made.dataset, robot=truth.robot).findings
    except GAPONetError as error:
        said = str(error)
        return ("named" if any(word in said for word in words) else "stopped"), said
    bad = [f for f in findings if f.level in ("error", "warning")]
    errors = [f for f in bad if f.level == "error"]
    said = "; ".join(f"{f.level} {f.check}: {f.message}" for f in bad)
    if not words:
        return ("false" if errors else "good"), said
    if any(word in f"{f.check}: {f.message}" for word in words for f in bad):
        return "named", said
    if any(UNTOLD in f.message for f in findings):
        return "untold", said
    return ("stopped" if errors else "silent"), said


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("work", type=Path)
    parser.add_argument("--mutations", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=FAULTS)
    parser.add_argument("--keep", action="store_true", help="keep logs that pass in silence")
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    truths = list[Truth]()
    for k in range(ROBOTS):
        robot = draw_robot(args.work / f"robot{args.seed}_{k}", rng)
        truths.append(Truth(robot, [play(robot, rng) for _ in range(MOTIONS)]))
    counts: dict[str, dict[str, int]] = {}
    for f, fault in enumerate(FAULTS):
        if args.only not in (None, fault):
            continue
        counts[fault] = {}
        for k in range(args.mutations):
            place = args.work / f"{fault.replace(' ', '_')}_{args.seed}_{k}"
            shutil.rmtree(place, ignore_errors=True)
            draw = np.random.default_rng((args.seed, f, k))
            result, said = outcome(place, truths[k % ROBOTS], fault, draw)
            counts[fault][result] = counts[fault].get(result, 0) + 1
            if result in ("silent", "false", "stopped"):
                print(f"{fault} {k}: {result}: {said[:300]}", file=sys.stderr)
            if not (args.keep and result in ("silent", "false")):
                shutil.rmtree(place, ignore_errors=True)
        print(json.dumps({fault: counts[fault]}), flush=True)
    wrong = [c for c in counts.values() if c.get("silent") or c.get("false")]
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
