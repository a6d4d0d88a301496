"""Export folders: a robot or a network for another program, with a check without gaponet."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from gaponet.base.errors import RobotError, UsageError
from gaponet.base.files import atomic_write, lock_folder, write_text
from gaponet.base.progress import Progress, no_progress
from gaponet.data.sequence import Sequence
from gaponet.export import envhub, isaaclab_config
from gaponet.export.helper_file import (
    MUJOCO_HELPER,
    SHIPPED,
    TORCH_HELPER,
    helper_text,
    without_gaponet,
)
from gaponet.export.mjcf_edit import MUJOCO_HAS_RAMPS, edit_mjcf
from gaponet.export.newton_config import newton_config
from gaponet.export.plain_servos import (
    at_rate,
    check_error,
    check_motions,
    comparable,
    fit_plain_servos,
    mean_error,
    own_motions,
    rollout_error,
)
from gaponet.export.shipped import mujoco_servos
from gaponet.export.simulator_facts import control_period, mjcf_text, simulator_facts
from gaponet.export.targets import (
    NEWTON_CHECK,
    TARGETS,
    own_terms,
    temperature_note,
)
from gaponet.export.urdf_edit import MISSING_FIELDS, edit_urdf, with_urdf_fields
from gaponet.nn.artifact import GapModel
from gaponet.robot.servo_fields import STOP_FIELDS
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import carried

FOLDER_KIND = "engine"
FACTS = "facts.json"
ROBOT = "robot.xml"
CHECK = "check.npz"
CONFIG = "robot_cfg.py"  # servos in the classes of Isaac Lab or Newton
ACTUATORS = re.compile(r"\s*<actuator>.*?</actuator>", re.DOTALL)


@dataclass(frozen=True)
class ExportedFolder:
    """Files and errors of an export."""

    file: Path | None  # the MJCF or URDF; None for json
    errors: dict[str, float]  # form of the robot → mean |error| over the motions, rad
    motions: int  # number of validation motions
    virtual: bool  # True if no real robot played the motions
    own_motions: bool  # True if they were simulated for the export
    notes: tuple[str, ...] = ()  # effects that the form lacks, and decisions for the user


@dataclass(frozen=True)
class Source:
    """A file of the user's of which an edited copy is written."""

    file: Path
    prefix: str = ""  # text before each joint's name in it


@dataclass
class _RobotExport:
    """An export of a robot while it is written.

    Attributes:
        robot: Identified, or nominal.
        plain: The robot as fitted without a servo model.
        to: Engine.
        out: Folder.
        validation: Validation motions that can be compared.
        checked: Those of check.npz.
        facts: Content of facts.json.
        errors, notes: As in `ExportedFolder`.
    """

    robot: RobotSpec
    plain: RobotSpec
    to: str
    out: Path
    validation: ListOf[Sequence]
    checked: ListOf[Sequence]
    facts: dict[str, Any]
    errors: dict[str, float]
    notes: list[str]

    @property
    def payload_mass(self) -> float:
        """In each hand, kg."""
        return float(self.facts["payload_mass"])

    @property
    def step(self) -> float:
        """Physics step, s."""
        return float(self.facts["options"]["timestep"])

    def write_robot(self, source: Source | None) -> Path | None:
        """Write the file of the robot, and return it; None for json, which has none.

        A target that edits no file of the user's gets a scene, robot.xml.
        """
        if TARGETS[self.to].edits_mjcf:
            return self.write_mjcf(source.file if source else self.robot.mjcf)
        if self.to == "urdf":
            assert source is not None
            return self.write_urdf(source.file)
        if self.to == "json":
            return None
        return self.write_scene()

    def require_finite_errors(self) -> None:
        """Refuse a robot whose simulation ended in numbers that are not finite.

        Raises:
            RobotError: One of `errors` is not finite.
        """
        for form, error in self.errors.items():
            if not np.isfinite(error):
                raise RobotError(
                    f"{self.out}: the error of {form} is {error}, so the simulation is unstable "
                    "there: check the gains and masses in robot.toml, or take a shorter timestep"
                )

    def write_mjcf(self, source: Path) -> Path:
        """Write an edited copy of an MJCF, and measure it in plain MuJoCo."""
        file, not_rad = edit_mjcf(source, self.out, self.plain, self.facts, self.payload_mass)
        forms = {"plain": "alone"}
        if self.robot.servo.has_terms:
            forms = {"joints": "with mujoco_servos.py", **forms}
        for form, what in forms.items():
            error = _error_in_mujoco(file, self.facts, self.validation, self.robot, form)
            self.errors[f"{file.name} {what}"] = error
        if not_rad:
            names = ", ".join(not_rad)
            self.notes.append(
                f"targets of {names} were not in rad before (degrees, or another sign?): now they "
                "are; ctrl of keyframes not"
            )
        return file

    def write_urdf(self, source: Path) -> Path:
        """Write an edited copy of a URDF; the error is that of its fields in gaponet."""
        edited = edit_urdf(source, self.out, self.facts, self.robot)
        file = edited.file
        if edited.other_links:
            self.notes.append(
                f"inertias of {', '.join(edited.other_links)} were not written: their masses in "
                "the file are others"
            )
        if edited.without_limit:
            self.notes.append(
                f"torque limits of {', '.join(edited.without_limit)} were not written: these "
                "joints have no <limit>; facts.json (plain, effort_limit) has them"
            )
        error = rollout_error(self.validation, with_urdf_fields(self.plain, edited))
        self.errors[f"{file.name} alone, all else as before"] = error
        return file

    def write_scene(self) -> Path:
        """Write robot.xml, and for Isaac Lab and Newton also the servos in their own classes.

        Only mjlab reads the servos of robot.xml; for the others it has none.
        """
        file = self.out / ROBOT
        has_servos = self.to == "mjlab"
        robot = self.robot if has_servos else self.plain
        _write_scene(robot, file, self.payload_mass, servos=has_servos)
        if self.to == "newton":
            write_text(self.out / CONFIG, newton_config(self.robot.name, self.facts))
        if self.to == "isaaclab":
            self._write_native_form()
        return file

    def _write_native_form(self) -> None:
        """Write the servos in Isaac Lab's own classes, and which form is which."""
        name = self.robot.name
        form = isaaclab_config.native_form(self.robot, self.plain, self.step, self.validation)
        servos = form.servos(self.payload_mass, self.facts["dt"])
        motions = "VIRTUAL motions" if self.facts["virtual"] else "validation motions"
        config = isaaclab_config.robot_config(name, servos, self.step, form.lines(), motions)
        write_text(self.out / CONFIG, config)
        self.facts["native"] = servos
        self.facts["error_mrad"]["native"] = 1e3 * check_error(self.checked, form.robot)
        readme = isaaclab_config.readme(name, form, self.facts["error_mrad"], motions)
        write_text(self.out / "README.md", readme)
        *_, last = form.losses.values()
        self.errors["in Isaac Lab's own classes"] = last
        self.notes.append(
            "README.md says what is lost in Isaac Lab's own classes, effect by effect"
        )


def export_robot(
    robot: RobotSpec,
    to: str,
    out: Path,
    recordings: tuple[ListOf[Sequence], ListOf[Sequence]] | None = None,
    source: Source | None = None,
    payload_mass: float = 0.0,
    progress: Progress = no_progress,
) -> ExportedFolder:
    """Write a robot for an engine.

    Args:
        robot: Identified, or nominal.
        to: One of TARGETS that is a robot's (api.files.RobotTarget).
        out: Folder.
        recordings: Training and validation motions; default: simulated motions of the robot itself.
        source: For mjcf, envhub and urdf, a file of the user's; by default, except for urdf, the
            robot's.
        payload_mass: In each hand, kg.
        progress: Progress of the fit without the servo model, as of `identify`.

    Raises:
        RobotError: The file cannot be edited, or the written robot does not move in finite numbers.
        UsageError: No recording was made with this payload and the robot's gains.
    """
    if to == "urdf" and source is None:
        raise UsageError("--to urdf edits a copy of your own file: --into FILE.urdf")
    train, validation = _motions(robot, recordings, payload_mass)
    plain = fit_plain_servos(robot, train, progress, own_terms(to))
    dt = control_period(robot, (motion.dt for motion in validation))
    facts = simulator_facts(robot, dt, payload_mass, plain)
    facts["file"] = ROBOT
    facts["prefix"] = source.prefix if source else ""
    facts["virtual"] = validation[0].meta.virtual
    export = _measured_export(robot, plain, to, out, validation, facts)
    with lock_folder(out, FOLDER_KIND):
        file = export.write_robot(source)
        export.require_finite_errors()
        if file is not None:
            facts["file"] = str(file.relative_to(out))
        _write_motions(out / CHECK, export.checked)
        _write_shipped(out, to, facts)
    if to == "envhub":
        why_no_units = envhub.write_units(robot, out, recordings, progress)
        envhub.write_readme(robot, facts, why_no_units, out)
        if why_no_units:
            export.notes.append(f"no units of the servos are drawn: {why_no_units}")
    return ExportedFolder(
        file,
        export.errors,
        len(validation),
        facts["virtual"],
        recordings is None,
        tuple(export.notes),
    )


def _motions(
    robot: RobotSpec,
    recordings: tuple[ListOf[Sequence], ListOf[Sequence]] | None,
    payload_mass: float,
) -> tuple[ListOf[Sequence], ListOf[Sequence]]:
    """Return training motions, and validation motions that can be compared.

    Without recordings, both are simulated motions of the robot itself.
    """
    if recordings is None:
        count = 24 if robot.servo.has_terms else 2
        motions = own_motions(robot, payload_mass, count)
        recordings = motions[::2], motions[1::2] or motions
    train, played = recordings
    validation = comparable(played, robot, payload_mass)
    if not validation:
        raise UsageError(
            f"no validation motion was made with {payload_mass:g} kg and the robot's own gains"
        )
    return train, validation


def _measured_export(
    robot: RobotSpec,
    plain: RobotSpec,
    to: str,
    out: Path,
    validation: ListOf[Sequence],
    facts: dict[str, Any],
) -> _RobotExport:
    """Return an export with its errors in gaponet, before anything is written."""
    has_ramps = TARGETS[to].edits_mjcf and MUJOCO_HAS_RAMPS
    checked = check_motions(validation, robot, facts["dt"], ramped=not has_ramps)
    if to == "envhub":
        facts["lerobot_units"] = envhub.lerobot_units(robot)
    played_there = plain if TARGETS[to].has_table else plain.with_table(None)
    facts["error_mrad"] = {
        "joints": 1e3 * check_error(checked, robot),
        "plain": 1e3 * check_error(checked, played_there),
    }
    errors = {"in gaponet": rollout_error(validation, robot)}
    if robot.servo.has_terms:
        errors["in gaponet, without the servo model"] = rollout_error(validation, plain)
    notes = _notes(robot, facts, to)
    return _RobotExport(robot, plain, to, out, validation, checked, facts, errors, notes)


def _notes(robot: RobotSpec, facts: dict[str, Any], to: str) -> list[str]:
    """Return effects that a target's form of a robot lacks, and questions for the user, in the
    order in which they are printed.

    Args:
        facts: facts.json; its "plain" are the servos as fitted without the servo model.
        to: One of TARGETS.
    """
    target = TARGETS[to]
    notes = []
    if target.edits_mjcf:
        notes += _stop_notes(robot)
    if robot.servo.target_speed.any():
        notes.append(_ramp_note(robot, to))
    if robot.servo.friction_per_kelvin.any():
        notes.append(temperature_note(robot))
    is_late = any(servo["delay"] for servo in facts["plain"].values())
    if is_late and target.delay_note:
        notes.append(target.delay_note)
    notes += _own_model_notes(robot, facts, to)
    if not target.has_table:
        notes += _table_notes(robot, f"the scene for {to}")
    if not target.has_servo_model:
        notes += _servo_model_notes(facts["law"], to)
    if to == "mjlab" and robot.servo.backlash.any():
        notes.append("mjlab simulates no backlash: use the form for MuJoCo, or identify without it")
    return notes


def _stop_notes(robot: RobotSpec) -> list[str]:
    """Return a question for each joint with stops, which the MJCF of the user does not get."""
    notes = []
    for i, name in enumerate(robot.joint_names):
        known = robot.servo.finite_of_joint(i, STOP_FIELDS).values()
        stops = " and ".join(f"{stop:.2f}" for stop in known)
        if stops:
            notes.append(
                f"{name} met something at {stops} rad in the recordings; the file keeps its range: "
                "was that a stop?"
            )
    return notes


def _own_model_notes(robot: RobotSpec, facts: dict[str, Any], to: str) -> list[str]:
    """Return what a model of the user's does not get from a URDF or from facts.json alone."""
    notes = []
    if to == "urdf":
        notes.append(_urdf_note(facts))
        notes += _range_notes(robot)
    if to in ("urdf", "json"):
        notes += _mass_notes(robot, facts["payload_mass"])
        notes += _table_notes(robot, "your model")
    if to == "json" and robot.links:
        names = ", ".join(robot.links)
        notes.append(f"masses and inertias of {names} were identified: facts.json (links) has them")
    return notes


def _range_notes(robot: RobotSpec) -> list[str]:
    """Return a note on identified stops, which are not in the <limit> of a URDF, if there are
    some.
    """
    stopped = []
    for i, name in enumerate(robot.joint_names):
        if robot.servo.finite_of_joint(i, STOP_FIELDS):
            stopped.append(name)
    if not stopped:
        return []
    names = ", ".join(stopped)
    return [
        f"identified stops of {names} are not in the file, which keeps its ranges: facts.json "
        "(plain, range) has them"
    ]


def _mass_notes(robot: RobotSpec, payload_mass: float) -> list[str]:
    """Return what of a robot's masses a file of the user's does not get, and where it is.

    Args:
        payload_mass: In each hand, kg.
    """
    notes = []
    masses = []
    for mount in robot.payload_mounts:
        mass = carried(robot, mount, payload_mass)
        if mass:
            masses.append(f"{mass:.4g} kg at {mount.body} ({mount.side})")
    if masses:
        notes.append(
            f"your model does not get {' and '.join(masses)}: add them, with the places in "
            "facts.json (payload_mounts)"
        )
    return notes


def _table_notes(robot: RobotSpec, what: str) -> list[str]:
    """Return a note on the table, which something does not get, if the robot has one.

    Args:
        what: What does not get it, such as "your model".
    """
    if robot.scene.table is None:
        return []
    height = robot.scene.table.height
    return [f"{what} does not get the table (height {height:.3f} m): it is in facts.json (table)"]


def _servo_model_notes(terms: ListOf[str], to: str) -> list[str]:
    """Return a note on the terms of a robot's servo model that an engine lacks, if there are
    some.
    """
    lacking = [term for term in terms if term not in own_terms(to)]
    if not lacking:
        return []
    names = ", ".join(lacking)
    return [f"the servo model ({names}) is not in {to}: the numbers were fitted without it"]


def _ramp_note(robot: RobotSpec, to: str) -> str:
    """Return where the servos' own limits of the speed of targets are."""
    named = zip(robot.joint_names, robot.servo.target_speed, strict=True)
    limits = []
    for name, speed in named:
        if speed:
            limits.append(f"{name} {speed:.3g}")
    ramps = ", ".join(limits)
    if TARGETS[to].edits_mjcf and MUJOCO_HAS_RAMPS:
        return (
            f"servos' own ramps ({ramps} rad/s) are <pid slewmax> of MuJoCo 4: call fill_delays of "
            "mujoco_servos.py after each reset; MJX and older versions do not have them"
        )
    return (
        f"servos' own ramps ({ramps} rad/s) are not in this file: limit targets so, as in "
        "check.npz. MuJoCo 4 has them (--to mjcf)"
    )


def _urdf_note(facts: dict[str, Any]) -> str:
    """Return what a URDF has no place for."""
    servos = facts["plain"].values()
    missing = []
    for field in MISSING_FIELDS:
        if any(servo[field] for servo in servos):
            missing.append(field)
    return (
        f"the file has no place for {', '.join(missing)}: they are in facts.json (plain), kp and "
        "kd for your controller; files that it names stay where they were"
    )


def export_model(model: GapModel, run: Path, folder: Path, payload_mass: float = 0.0) -> float:
    """Write a model's simulator for mjlab and Isaac Lab, and the model as a torch.export program.

    Returns:
        Largest difference between program and artifact, rad.

    Raises:
        ModelError: There is no simulator beside the model, the payload is larger than in training,
            `delta_step` refuses the model, or the program differs by more than 1e-5 rad.
    """
    from gaponet.export.torch_program import export_program

    model.require_payload(payload_mass, can_extrapolate=False)
    robot = model.simulator()
    dt = control_period(robot, model.card.get("dt") or [robot.dt])
    with lock_folder(folder, FOLDER_KIND):
        difference = export_program(model, run, folder, payload_mass)
        past = {
            "depth": (model.config.history - 1) * model.config.stride + 1,
            "parity_rad": difference,
        }
        facts = simulator_facts(robot, dt, payload_mass)
        facts |= {"model": past, "payload_seen": model.card.get("payload_seen")}
        _write_scene(robot, folder / ROBOT, payload_mass, dt=dt)
        _write_scene(robot, folder / "robot_without_servos.xml", payload_mass, servos=False, dt=dt)
        _write_shipped(folder, "torch", facts)
    return difference


def export_networks(
    model: GapModel, run: Path, folder: Path, data: str | None = None, payload_mass: float = 0.0
) -> ExportedFolder:
    """Write a run as actuator networks.

    Each joint has .onnx (Newton), .pt (mjlab, Isaac Lab) and .pt2 (torch.export).

    Args:
        run: Run with the motions that the networks are fitted to and tested on.
        data: Dataset with these motions; default the one in the run's configuration.
        payload_mass: In each hand, kg; recordings with another payload are not used.

    Raises:
        UsageError: No recording was made with this payload, the robot's gains and its control
            period.
    """
    from gaponet.export.actuator_net import read_run_recordings, write_networks

    model.require_payload(payload_mass, can_extrapolate=False)
    robot = model.simulator()
    train, val = read_run_recordings(run, data, robot, payload_mass)
    dt = control_period(robot, (recording.dt for recording in train))
    train = at_rate(train, dt)
    motions = check_motions(val, robot, dt)
    if not motions:
        raise UsageError(
            f"{run}: its recordings at {1 / dt:.4g} Hz are for training alone; no motion of this "
            "rate is left to compare with"
        )
    facts = simulator_facts(robot, dt, payload_mass) | {
        "file": ROBOT,
        "virtual": train[0].meta.virtual,
        "delta_max": model.config.delta_max,
    }
    with lock_folder(folder, FOLDER_KIND):
        _write_scene(robot, folder / ROBOT, payload_mass, servos=False, dt=dt)
        errors = write_networks(train, motions, model.corrector(robot), robot, folder, facts)
        facts["error_mrad"] = {form: 1e3 * error for form, error in errors.items()}
        _write_motions(folder / CHECK, motions)
        _write_shipped(folder, "actuator-net", facts)
    notes = []
    if not facts["actuator_net"]["gain"]:
        notes.append(
            "the run's correction depends on posture, which a joint's network does not get: these "
            "are the servos alone; try torch"
        )
    if facts["law"]:
        notes.append(f"the servo model ({', '.join(facts['law'])}) is not in actuator networks")
    virtual = train[0].meta.virtual
    return ExportedFolder(folder / ROBOT, errors, len(motions), virtual, False, tuple(notes))


def _write_scene(
    robot: RobotSpec, file: Path, payload_mass: float, servos: bool = True, dt: float | None = None
) -> None:
    """Write the simulator as one MJCF, without its servos where an engine adds them itself."""
    text = mjcf_text(robot, dt or robot.dt, payload_mass)
    write_text(file, text if servos else ACTUATORS.sub("", text))


def _write_motions(file: Path, motions: ListOf[Sequence]) -> None:
    """Write check.npz, which `Check` of mujoco_servos.py reads."""
    arrays: dict[str, Any] = {
        "count": np.array(len(motions)),
        "names": np.array([motion.meta.motion for motion in motions]),
    }
    for i, motion in enumerate(motions):
        arrays |= {
            f"ctrl_{i}": motion.ctrl,
            f"qpos_{i}": motion.qpos,
            f"qvel_{i}": motion.qvel,
            f"dt_{i}": np.array(motion.dt),
        }
    with atomic_write(file) as temporary, temporary.open("wb") as opened:
        np.savez_compressed(opened, **arrays)


def _write_shipped(folder: Path, to: str, facts: dict[str, Any]) -> None:
    """Write facts.json, the helper file and the check of an engine; none of them needs gaponet."""
    helper = TORCH_HELPER if TARGETS[to].needs_torch else MUJOCO_HELPER
    helpers = {helper}
    for name, file in TARGETS[to].files.items():
        of_file = helper
        if file == NEWTON_CHECK:  # Newton's environment has no torch
            of_file = MUJOCO_HELPER
        helpers.add(of_file)
        text = (SHIPPED / file).read_text(encoding="utf-8")
        write_text(folder / name, without_gaponet(text, of_file))
    for name in helpers:
        write_text(folder / f"{name}.py", helper_text(name))
    write_text(folder / FACTS, json.dumps(facts, indent=1, ensure_ascii=False) + "\n")


def _error_in_mujoco(
    file: Path, facts: dict[str, Any], motions: ListOf[Sequence], robot: RobotSpec, form: str
) -> float:
    """Return the mean |error| of the written file in plain MuJoCo, rad."""
    op = robot.operated_index
    low, high = robot.qpos_range.T
    errors = []
    for s in motions:
        motion = {"ctrl": np.clip(s.ctrl, low, high), "qpos": s.qpos, "qvel": s.qvel, "dt": s.dt}
        model = mujoco.MjModel.from_xml_path(str(file))  # play changes its step
        played = mujoco_servos.play(model, facts, motion, facts["prefix"], form)
        errors.append(mean_error(s.qpos[:, op], played[:, op]))
    return float(np.mean(errors))
