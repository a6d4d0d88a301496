"""What a user of another engine takes along: an identified robot in its own words, and a check that travels."""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from gaponet.base.arrays import array_module
from gaponet.base.errors import UsageError
from gaponet.base.files import lock_folder, write_text
from gaponet.data.sequence import Sequence
from gaponet.export import mujoco_servos
from gaponet.export.configs import CONFIGS
from gaponet.export.edit import edit_mjcf
from gaponet.export.edit_urdf import LOST, edit_urdf, tags_alone
from gaponet.export.facts import mjcf_text, simulator_facts
from gaponet.export.forms import check_motions, comparable, left, mean_error, own_motions, plain_form
from gaponet.nn.artifact import GapModel
from gaponet.robot.spec import RobotSpec
from gaponet.sim import servo

KIND = "engine"
FACTS, ROBOT, TERM, CHECK = "facts.json", "robot.xml", "gaponet_action.py", "check.npz"
ENGINES = ("mjcf", "urdf", "mjlab", "isaaclab", "newton", "drake", "json")
CHECKS = {
    "mjcf": {"check.py": "mjcf.py", "check_mjx.py": "mjx.py"},
    "mjlab": {"check.py": "mjlab.py"},
    "isaaclab": {"check.py": "isaaclab.py"},
    "newton": {"check.py": "newton.py"},
    "drake": {"check.py": "drake.py"},
    "actuator-net": {
        "check.py": "actuator_mjlab.py",
        "check_newton.py": "actuator_newton.py",
        "actuators.py": "actuators.py",
    },
}
OURS = re.compile(r"from gaponet\S*\.(servo|mujoco_servos|scene_facts) import")
LAW = """\"\"\"The law of an identified servo: what MuJoCo's actuators and friction loss do not; numpy or torch.\"\"\"

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np

Law = dict[str, Any]  # name of a term → values that broadcast to the joints
"""
SERVOS = re.compile(r"\s*<actuator>.*?</actuator>", re.DOTALL)


@dataclass(frozen=True)
class Exported:
    """What was written, and what each form of the robot leaves.

    Attributes:
        file: The MJCF; None for json.
        left: Form → mean |error| over the motions that judged it, rad.
        motions: How many those are.
        virtual: Whether no real robot played them, but this one or another simulated one.
        notes: What the form leaves out, and what the user is to decide.
    """

    file: Path | None
    left: dict[str, float]
    motions: int
    virtual: bool
    notes: tuple[str, ...] = ()


def export_robot(
    robot: RobotSpec,
    to: str,
    out: Path,
    recordings: tuple[ListOf[Sequence], ListOf[Sequence]] | None = None,
    source: Path | None = None,
    prefix: str = "",
    payload_mass: float = 0.0,
    progress: Callable[[float, float, str], None] = lambda done, total, note: None,
) -> Exported:
    """Write a robot for an engine: one of ENGINES.

    Args:
        robot: Identified, or nominal.
        to: Engine.
        out: Folder.
        recordings: Training and validation motions; default: what the robot itself answers to motions of the library.
        source: For mjcf and urdf, a file of the user's own that is edited in a copy; for mjcf by default the robot's.
        prefix: What that file has before each joint's name.
        payload_mass: In each hand, kg.
        progress: The progress of the fit without a law, as identification's.

    Raises:
        RobotError: The file cannot be edited.
        UsageError: No recording was made with this payload and the robot's gains.
    """
    if recordings is None:
        made = own_motions(robot, payload_mass, 24 if robot.has_servo_model else 2)
        recordings = made[::2], made[1::2] or made
    train, judging = recordings[0], comparable(recordings[1], robot, payload_mass)
    if not judging:
        raise UsageError(f"no validation motion was made with {payload_mass:g} kg and the robot's own gains")
    plain = plain_form(robot, train, progress=progress)
    facts = simulator_facts(robot, robot.dt, payload_mass, plain)
    motions = check_motions(judging, robot)
    facts |= {"file": ROBOT, "prefix": prefix, "virtual": judging[0].meta.virtual}
    facts["left_mrad"] = {"joints": 1e3 * left(motions, robot), "plain": 1e3 * left(motions, plain)}
    prices = {"in gaponet": left(judging, robot)}
    if robot.has_servo_model:
        prices["in gaponet, fitted without the law"] = left(judging, plain)
    with lock_folder(out, KIND):
        file, told, more = _write_form(robot, plain, to, out, facts, judging, source, prefix, payload_mass)
        _write_motions(out / CHECK, motions)
        _ship(out, to)
        write_text(out / FACTS, json.dumps(facts, indent=1, ensure_ascii=False) + "\n")
    notes = (*_notes(robot, facts, to), *told)
    return Exported(file, prices | more, len(judging), judging[0].meta.virtual, notes)


def _write_form(
    robot: RobotSpec,
    plain: RobotSpec,
    to: str,
    out: Path,
    facts: dict[str, Any],
    judging: ListOf[Sequence],
    source: Path | None,
    prefix: str,
    payload_mass: float,
) -> tuple[Path | None, tuple[str, ...], dict[str, float]]:
    """The robot in the engine's own file, whose name goes into facts: file, notes, and what it leaves, rad."""
    left_there = dict[str, float]()
    if to == "mjcf":
        longest = {n: max(facts[form][n]["delay"] for form in ("joints", "plain")) for n in robot.joint_names}
        mine = source or robot.mjcf
        file, changes, other = edit_mjcf(mine, out, plain, facts["plain"], longest, prefix, payload_mass)
        facts["file"] = str(file.relative_to(out))
        write_text(out / "changes.diff", changes)
        for form, what in (("joints", "with servo_law.py"), ("plain", "alone")):
            if form == "plain" or robot.has_servo_model:
                left_there[f"{file.name} {what}"] = _played(file, facts, judging, robot, form)
        units = f"targets of {', '.join(other)} were not in rad before (degrees?): now they are; ctrl of keyframes not"
        return file, (units,) * bool(other), left_there
    if to == "urdf":
        if source is None:
            raise UsageError("--to urdf edits a copy of your own file: --into FILE.urdf, or .sdf")
        file, changes = edit_urdf(source, out, facts["plain"], robot.operated, prefix)
        facts["file"] = file.name
        write_text(out / "changes.diff", changes)
        left_there[f"{file.name} alone, all else as before"] = left(judging, tags_alone(plain))
        return file, (), left_there
    if to == "json":
        return None, (), left_there
    _write_scene(robot if to == "mjlab" else plain, out / ROBOT, payload_mass, servos=to == "mjlab")
    write_text(out / "robot_cfg.py", CONFIGS[to](robot.name, facts))
    return out / ROBOT, (), left_there


def _notes(robot: RobotSpec, facts: dict[str, Any], to: str) -> tuple[str, ...]:
    told = []
    for name in robot.joint_names if to == "mjcf" else ():
        i = robot.joint_names.index(name)
        stops = [x for x in (robot.stop_low[i], robot.stop_high[i]) if np.isfinite(x)]
        if stops:
            at = " and ".join(f"{x:.2f}" for x in stops)
            told.append(
                f"{name} met something at {at} rad in the recordings; the file keeps its range: was that a stop?"
            )
    if robot.target_speed.any():
        ramps = ", ".join(f"{n} {v:.3g}" for n, v in zip(robot.joint_names, robot.target_speed, strict=True) if v)
        told.append(f"servos' own ramps ({ramps} rad/s) are in no engine: limit targets so, as check's motions have it")
    if any(s["delay"] for s in facts["plain"].values()):
        told += {"newton": ["Newton has no delays: check.py has a buffer of five lines"],
                 "drake": ["Drake has no delays: check.py has a buffer of five lines; friction is robot_cfg.py's"],
                 "mjcf": ["delays need MuJoCo 3.5; MJX and Newton drop them without a word: check_mjx.py has a buffer"],
                 "isaaclab": ["robot_cfg.py rounds delays to physics steps; the action term does not"],
                 "mjlab": ["robot_cfg.py rounds delays to physics steps; robot.xml does not"]}.get(to, [])  # fmt: skip
    if to == "urdf":
        lost = [f for f in LOST if any(s[f] for s in facts["plain"].values())]
        told.append(
            f"{facts['file']} has no place for {', '.join(lost)}: they stand in facts.json (plain), kp and kd for your "
            "controller; files that it names stay where they were"
        )
    if facts["law"] and to in ("isaaclab", "newton", "drake", "urdf"):
        told.append(f"the servos' law ({', '.join(facts['law'])}) is not in {to}: the numbers were fitted without it")
    return tuple(told)


def export_model(model: GapModel, run: Path, folder: Path, payload_mass: float = 0.0) -> float:
    """Write a model's simulator for mjlab and Isaac Lab, and the model as a torch.export program.

    Returns:
        Largest difference between program and artifact, rad.

    Raises:
        ModelError: The simulator does not lie beside the model, the payload is beyond those trained on, the model is
            one that DeltaStep is not for, or the program differs by more than 1e-5 rad.
    """
    from gaponet.export.program import export_program

    model.require_payload(payload_mass)
    robot = model.simulator()
    rates = model.card.get("dt") or [robot.dt]
    dt = robot.dt if any(abs(rate / robot.dt - 1) < 0.02 for rate in rates) else rates[0]
    with lock_folder(folder, KIND):
        difference = export_program(model, run, folder)
        past = {"depth": (model.config.history - 1) * model.config.stride + 1, "parity_rad": difference}
        facts = simulator_facts(robot, dt, payload_mass)
        facts |= {"model": past, "payload_seen": model.card.get("payload_seen")}
        _write_scene(robot, folder / ROBOT, payload_mass, dt=dt)
        _write_scene(robot, folder / "robot_without_servos.xml", payload_mass, servos=False, dt=dt)
        _ship(folder, "torch")
        write_text(folder / FACTS, json.dumps(facts, indent=1, ensure_ascii=False) + "\n")
    return difference


def export_networks(
    model: GapModel, run: Path, folder: Path, data: str | None = None, payload_mass: float = 0.0
) -> Exported:
    """Write a run as actuator networks, of every joint .onnx (Newton), .pt (mjlab, Isaac Lab) and .pt2 (torch.export).

    Args:
        run: Whose motions the networks are fitted to, and judged on.
        data: Where its recordings are now; default where they were.
        payload_mass: In each hand, kg, of the recordings that count.

    Raises:
        UsageError: No recording was made with this payload and the robot's gains.
    """
    from gaponet.export.actuator_net import recordings, write_networks

    model.require_payload(payload_mass)
    robot = model.simulator()
    train, val = recordings(run, data, robot, payload_mass)
    motions, dt = check_motions(val, robot), train[0].dt
    facts = simulator_facts(robot, dt, payload_mass) | {"file": ROBOT, "virtual": train[0].meta.virtual}
    with lock_folder(folder, KIND):
        _write_scene(robot, folder / ROBOT, payload_mass, servos=False, dt=dt)
        left = write_networks(train, motions, model.corrector(robot), robot, folder, facts)
        facts["left_mrad"] = {form: 1e3 * error for form, error in left.items()}
        _write_motions(folder / CHECK, motions)
        _ship(folder, "actuator-net")
        write_text(folder / FACTS, json.dumps(facts, indent=1, ensure_ascii=False) + "\n")
    lost = "what the run adds goes by posture, which no joint's network is told: these are the servos alone; try torch"
    law = f"the servos' law ({', '.join(facts['law'])}) is not in actuator networks"
    notes = (lost,) * (not facts["actuator_net"]["gain"]) + (law,) * bool(facts["law"])
    return Exported(folder / ROBOT, left, len(motions), train[0].meta.virtual, notes)


def _write_scene(
    robot: RobotSpec, file: Path, payload_mass: float, servos: bool = True, dt: float | None = None
) -> None:
    """The simulator as one MJCF; without its servos for engines that bring their own, or they act twice."""
    text = mjcf_text(robot, dt or robot.dt, payload_mass)
    write_text(file, text if servos else SERVOS.sub("", text))


def _write_motions(file: Path, motions: ListOf[Sequence]) -> None:
    held: dict[str, Any] = {"count": np.array(len(motions)), "names": np.array([s.meta.motion for s in motions])}
    for i, s in enumerate(motions):
        held |= {f"ctrl_{i}": s.ctrl, f"qpos_{i}": s.qpos, f"qvel_{i}": s.qvel, f"dt_{i}": np.array(s.dt)}
    with file.open("wb") as opened:
        np.savez_compressed(opened, **held)


def _ship(folder: Path, to: str) -> None:
    """Files that need no gaponet: the law, the action term, the check."""
    here = Path(__file__).parent
    told = (servo.present, servo.passing_friction, servo.resting_friction, servo.friction_limit, servo.servo_torque)
    law = [inspect.getsource(f) for f in (array_module, *told)]
    limits = f"SLOWEST, FINEST = {servo.SLOWEST}, {servo.FINEST}  # rad/s of stribeck_speed, rad of encoder_step\n"
    write_text(folder / "servo_law.py", "\n\n".join([LAW + limits, *law]))
    shipped = {"mujoco_servos.py": here / "mujoco_servos.py"}
    if to in ("mjlab", "isaaclab", "torch", "actuator-net"):
        shipped |= {"scene_facts.py": here / "scene_facts.py", TERM: here / "action_term.py"}
    shipped |= {name: here / "checks" / file for name, file in CHECKS.get(to, {}).items()}
    for name, file in shipped.items():
        text = OURS.sub(r"from \1 import", file.read_text(encoding="utf-8"))
        write_text(folder / name, text.replace("from servo import", "from servo_law import"))


def _played(file: Path, facts: dict[str, Any], motions: ListOf[Sequence], robot: RobotSpec, form: str) -> float:
    """What the written file leaves in plain MuJoCo, rad."""
    op, low, high = robot.operated_index, *robot.qpos_range.T
    errors = []
    for s in motions:
        motion = {"ctrl": np.clip(s.ctrl, low, high), "qpos": s.qpos, "qvel": s.qvel, "dt": s.dt}
        played = mujoco_servos.play(mujoco.MjModel.from_xml_path(str(file)), facts, motion, facts["prefix"], form)
        errors.append(mean_error(s.qpos[:, op], played[:, op]))
    return float(np.mean(errors))
