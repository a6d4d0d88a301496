"""Identified robots and trained networks for other programs."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, get_args

from typing_extensions import TypeIs

from gaponet.api.opening import Place
from gaponet.api.results import ExportResult
from gaponet.base.errors import UsageError
from gaponet.base.files import write_text
from gaponet.base.progress import Progress, no_progress
from gaponet.base.result_table import ResultTable
from gaponet.base.structure import require_choice
from gaponet.evaluation.tables import mrad
from gaponet.nn.packaged_networks import (
    is_packaged,
    is_packaged_network,
    named_folder,
    require_run_folder,
)
from gaponet.robot.by_name import identified_catalogue
from gaponet.robot.card import RobotCard
from gaponet.robot.folder import STORED_ROBOT, has_stored_robot
from gaponet.robot.spec import load_robot

if TYPE_CHECKING:
    from gaponet.export.export_folder import ExportedFolder
    from gaponet.export.randomization import Engine, Randomization, Scope

RobotTarget = Literal["mjcf", "envhub", "urdf", "mjlab", "isaaclab", "newton", "json"]
NetworkTarget = Literal["onnx", "torch", "actuator-net"]
RANDOMIZATION_TARGET: Final = "randomization"
LEROBOT_TARGET: Final = "lerobot"
RANDOMIZATION_FILE = "randomization.json"
POLICY_FILE = "policy_postprocessor.json"  # of a LeRobot policy
POLICY_STEP = "gaponet_correct"
LEROBOT_FPS = 30.0
JUDGED_UNITS = {  # sets of units whose errors are compared → heading
    "exported": "exported",
    "units": "units",
    "one by one": "single numbers of the ranges",
    "by hand": "± 20 % by hand",
}


def export_robot(
    robot: Place,
    *,
    to: RobotTarget,
    out: Place | None = None,
    data: str | None = None,
    into: Place | None = None,
    prefix: str = "",
    payload_mass: float = 0.0,
    progress: Progress = no_progress,
) -> ExportResult:
    """Write an identified robot, or the simulator of a run, for another program.

    Args:
        robot: Robot folder, name of an identified robot of the package (give `out`), or run folder
            of `train`.
        to: mjcf (plain MuJoCo), envhub (an environment of LeRobot's EnvHub in MuJoCo), mjlab,
            isaaclab and newton, each with a check.py that needs no gaponet; urdf (damping,
            friction, effort limits); json (the numbers).
        out: Folder to write. Default: a folder in the robot or run that has the name of the target.
        data: Dataset with which the export is measured, and to which plain servos are fitted if the
            engine cannot play the servo model. Default: the dataset of the identification, or else
            simulated motions of the robot.
        into: For mjcf, envhub and urdf: a file of the user's, of which an edited copy is written.
            Default: the robot's file; urdf has none.
        prefix: Prefix that joint names have in that file.
        payload_mass: Payload in each hand, kg.

    Raises:
        RobotError: The file cannot be edited.
        UsageError: No recording was made with this payload and the robot's gains.
    """
    from gaponet.export import export_folder as files
    from gaponet.export.plain_servos import read_recordings

    require_choice("to", to, get_args(RobotTarget))
    holder = named_folder(robot)
    require_run_folder(
        holder,
        f"--to {to}",
        "its simulator is a robot of the package, with the gain_scale that gaponet robot networks "
        "shows: export that",
    )
    require_out(holder, out)
    if prefix and into is None:
        raise UsageError(
            f"--prefix {prefix}: is of joints in a file of yours; give that file with --into"
        )
    spec = load_robot(simulator_folder(holder))
    source = None if into is None else files.Source(Path(into), prefix)
    recordings = read_recordings(simulator_folder(holder), data, spec)
    folder = Path(out) if out else holder / to
    made = files.export_robot(spec, to, folder, recordings, source, payload_mass, progress)
    if recordings is None:
        made = replace(made, notes=(*made.notes, *_notes_without_recordings(holder, data)))
    return _exported(made, folder, to, spec.name)


def _notes_without_recordings(holder: Path, data: str | None) -> list[str]:
    """Return the errors that a robot of the package had on its recordings; of another robot, where
    its recordings are no longer.
    """
    from gaponet.export.plain_servos import lost_recordings

    if identified_catalogue().holds(holder):
        card = RobotCard.read(holder)
        return [f"{card.name}, {card.errors()}"]
    lost = lost_recordings(simulator_folder(holder), data)
    if not lost:
        return []
    return [
        f"the robot's recordings are {lost}: motions of its own were simulated to measure it; "
        "--data DATASET says where they are"
    ]


def export_network(
    run: Place,
    *,
    to: NetworkTarget = "onnx",
    out: Place | None = None,
    data: str | None = None,
    payload_mass: float = 0.0,
) -> ExportResult:
    """Write the trained network of a run for another program.

    Args:
        run: Run folder of `train`, or a network of the package by name; for that give `out`.
        to: onnx (model.onnx and card.json), torch (delta.pt2 with simulator and action term for
            mjlab and Isaac Lab), actuator-net (one network per joint: past of target − position and
            speed in, torque out; the form of mjlab, Newton and Isaac Lab).
        out: Folder to write. Default: a folder in the run that has the name of the target; for onnx
            the run's model folder.
        data: For actuator-net: where the run's recordings are now; default where they were.
        payload_mass: Payload in each hand, kg.

    Raises:
        ModelError, UsageError: The run holds no such model, its payload is beyond those trained on,
            or a network of the package has no `out`, or not what actuator-net needs.
    """
    from gaponet.export.export_folder import export_model, export_networks
    from gaponet.nn.artifact import GapModel

    require_choice("to", to, get_args(NetworkTarget))
    if payload_mass and to == "onnx":
        raise UsageError("payload_mass is for torch and actuator-net; onnx takes it as an input")
    holder = named_folder(run)
    require_out(holder, out)
    if to == "actuator-net":
        instead = "actuator networks are fitted to the recordings of a run: train one"
        require_run_folder(holder, f"--to {to}", instead)
    if to == "onnx":
        return _export_onnx(holder, None if out is None else Path(out))
    model = GapModel.load(holder)
    folder = Path(out) if out else holder / to
    if to == "torch":
        parity = export_model(model, holder, folder, payload_mass)
        return ExportResult(path=folder, to=to, robot=model.card["robot"], parity=parity)
    made = export_networks(model, holder, folder, data, payload_mass)
    return _exported(made, folder, to, model.card["robot"])


def randomization(
    robot: Place,
    *,
    out: Place,
    engine: Engine = "json",
    scope: Scope = "today",
    units: tuple[Place, ...] = (),
    data: str | None = None,
    progress: Progress = no_progress,
) -> tuple[Path, Randomization]:
    """Write sampled units and ranges of an identified robot's parameters, for domain randomisation.

    Of the sampled units, the quarter that follows the robot's recordings best is written. Its error
    is stated beside that of the robot with ± 20 % on each number; units with a larger error are
    refused.

    Args:
        robot: Robot folder that `identify` or `adapt_robot` wrote, or run folder.
        out: Folder.
        engine: Engine whose file is written, which applies a unit of randomization.json.
        scope: today: this robot as last fitted. any-day: over sessions on several days. any-robot:
            over its type.
        units: For any-robot: robot folders of the type.
        data: Dataset whose motions choose and judge the units; default: the dataset of the
            identification.

    Returns:
        The file, and the ranges with sampled units.

    Raises:
        UsageError: The uncertainty, days or robots are missing.
        NoGainError: The units follow the recordings worse than ± 20 % on each number.
    """
    from gaponet.export.plain_servos import read_recordings
    from gaponet.export.randomization import (
        Engine,
        Scope,
        judge_units,
        sample_units,
        write_randomization,
    )
    from gaponet.export.targets import own_terms

    require_choice("engine", engine, get_args(Engine))
    require_choice("scope", scope, get_args(Scope))
    spec = load_robot(simulator_folder(named_folder(robot)))
    made = sample_units(spec, scope, tuple(map(Path, units)), engine=engine)
    made = judge_units(
        made, spec, read_recordings(spec.folder, data, spec), progress, own_terms(engine)
    )
    return write_randomization(made, engine, Path(out)), made


def randomization_tables(made: Randomization, scope: Scope) -> list[ResultTable]:
    """Return the ranges of the parameters, and the errors of the units beside simpler ones."""
    from gaponet.export.randomization import table_rows

    columns, rows = table_rows(made)
    title = f"{made.robot}, {scope}: range of 9 of 10 units"
    tables = [ResultTable(title, tuple(columns), tuple(tuple(row) for row in rows))]
    forms = {"with the servo model": made.judged, "without it": made.plain}
    if made.plain is made.judged:
        forms = {"identified": made.judged}
    errors = []
    for form, judged in forms.items():
        if judged is not None:
            errors.append((form, *(mrad(judged.errors[name]) for name in JUDGED_UNITS)))
    if errors:
        title = "Mean error on validation motions, mrad"
        tables.append(ResultTable(title, ("robot", *JUDGED_UNITS.values()), tuple(errors)))
    return tables


@dataclass(frozen=True, kw_only=True)
class AttachResult:
    """Correction behind a LeRobot policy.

    Attributes:
        file: Processor of the policy.
        steps: Names of its steps.
        config: What the step of gaponet was given; empty if it was removed.
    """

    file: Path
    steps: list[str]
    config: dict[str, object]

    def to_dict(self) -> dict[str, object]:
        return {"file": str(self.file), "steps": self.steps, "config": self.config}


def attach_correction(
    policy: Place,
    holder: Place | None,
    *,
    payload_mass: float = 0.0,
    dynamics: bool = False,
    fps: float = LEROBOT_FPS,
) -> AttachResult:
    """Put the correction of a robot or a run behind a LeRobot policy, in place of an earlier one.

    Args:
        policy: Folder of a policy (pretrained_model) that holds policy_postprocessor.json.
        holder: Robot folder, run folder or name of the package; None removes the correction.
        payload_mass: Payload in each hand, kg.
        dynamics: Feed forward inertia and damping too, for smooth targets.
        fps: Control rate of the policy, Hz.

    Raises:
        UsageError, ModelError: The rate is not one of a robot; the folder holds no LeRobot policy,
            or no robot and no run; robot or network cannot carry the payload; or the network was
            trained at another rate.
    """
    if not 1 <= fps <= 1000:
        raise UsageError(f"fps is {fps:g}; give the control rate of the policy in Hz, 1 to 1000")
    file = Path(policy) / POLICY_FILE
    if not file.is_file():
        raise UsageError(
            f"{policy}: has no {POLICY_FILE}; give the folder that holds a LeRobot policy and its "
            "processors"
        )
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
        steps = [step for step in document["steps"] if step.get("registry_name") != POLICY_STEP]
    except (ValueError, KeyError, TypeError, AttributeError):
        raise UsageError(f"{file}: is no processor of LeRobot") from None
    config: dict[str, object] = {}
    if holder is not None:
        folder = named_folder(holder)
        kind, name = _correction_of(folder)
        _require_startable(kind, folder, payload_mass, 1 / fps)
        config = {kind: name, "payload_mass": payload_mass, "dynamics": dynamics, "fps": fps}
        steps.append({"registry_name": POLICY_STEP, "config": config})
    write_text(file, json.dumps(document | {"steps": steps}, indent=2) + "\n")
    names = [step.get("registry_name", step.get("class", "?")) for step in steps]
    return AttachResult(file=file, steps=names, config=config)


def _require_startable(kind: str, holder: Path, payload_mass: float, dt: float) -> None:
    """Refuse a payload, kg, or a control period, s, with which the step would refuse to start."""
    from gaponet.deploy.compensator import Compensator
    from gaponet.nn.artifact import GapModel

    if kind == "model":
        model = GapModel.load(holder)
        model.require_payload(payload_mass, can_extrapolate=False)
        model.require_rate(dt)
    else:
        Compensator(load_robot(holder), dt=dt).require_payload(payload_mass)


def _correction_of(holder: Path) -> tuple[str, str]:
    """Return the option of the LeRobot step that a folder is for, and the folder as its value.

    Raises:
        UsageError: It holds no robot and no run.
        RobotError: The robot is damaged.
    """
    kind = "model"
    if not is_packaged_network(holder):
        if (holder / "robot.toml").is_file():
            load_robot(holder)
            kind = "known"
        elif not (holder / "model").is_dir():
            raise UsageError(
                f"{holder}: is neither a robot folder of gaponet identify nor a run of gaponet "
                "train"
            )
    return kind, holder.name if is_packaged(holder) else str(holder.resolve())


def is_network_target(to: str) -> TypeIs[NetworkTarget]:
    """Return True if an export is of the network of a run."""
    return to in get_args(NetworkTarget)


def require_network(holder: Path) -> None:
    """Refuse a robot folder where a network is to be exported.

    Raises:
        UsageError: It is one.
    """
    if (holder / "robot.toml").is_file():
        targets = ", ".join(get_args(RobotTarget))
        raise UsageError(f"{holder}: is a robot, which has no network; choose --to of {targets}")


def require_out(holder: Path, out: Place | None) -> None:
    """Refuse to write beside a network or a robot of the package."""
    if is_packaged(holder) and out is None:
        raise UsageError(
            f"'{holder.name}' lies in the package or in the Hub's cache, where nothing is "
            "written; give a folder with --out"
        )


def simulator_folder(holder: Path) -> Path:
    """Return the robot folder of a run or an artifact, or the folder itself."""
    return holder / STORED_ROBOT if has_stored_robot(holder) else holder


def _exported(made: ExportedFolder, folder: Path, to: str, robot: str) -> ExportResult:
    from gaponet.export.targets import TARGETS

    script = folder / "check.py"
    return ExportResult(
        path=made.file or folder,
        to=to,
        robot=robot,
        errors=made.errors,
        motions=made.motions,
        virtual=made.virtual,
        own_motions=made.own_motions,
        notes=tuple(made.notes),
        check=script if script.is_file() else None,
        checked_in=TARGETS[to].checked_in or to,
    )


def _export_onnx(run: Path, out: Path | None) -> ExportResult:
    from gaponet.nn.artifact import CARD, GapModel
    from gaponet.nn.onnx_export import export as write
    from gaponet.nn.onnx_export import sample_inputs, trained_network
    from gaponet.robot.folder import load_stored_robot, save_robot

    if out is not None and is_packaged_network(run):
        return _copy_packaged(run, out)
    path = out or run / "model"
    card, config = GapModel.read_card(run / "model" / CARD)
    net = trained_network(run, config, len(card["joint_names"]))
    parity = write(net, path, card, sample_inputs(net))
    if path != run / "model" and has_stored_robot(run):
        # commands can then be transferred
        save_robot(load_stored_robot(run, card["robot"]), path / STORED_ROBOT)
    return ExportResult(path=path, to="onnx", robot=card["robot"], parity=parity)


def _copy_packaged(network: Path, out: Path) -> ExportResult:
    """Copy a network of the package into a folder of the user's, with its simulator as a robot
    folder.
    """
    import shutil

    from gaponet.base.files import lock_folder
    from gaponet.nn.artifact import GapModel
    from gaponet.nn.network_card import NetworkCard
    from gaponet.robot.folder import PACKAGED_ROBOT_FILE, save_robot

    model = GapModel.load(network)
    robot = model.simulator()
    card = NetworkCard.read(network)
    with lock_folder(out, "run"):
        for file in sorted(network.iterdir()):
            if file.name != PACKAGED_ROBOT_FILE:
                shutil.copyfile(file, out / file.name)
        save_robot(robot, out / STORED_ROBOT)
    parity = card.published.largest_difference_rad
    return ExportResult(path=out, to="onnx", robot=robot.name, parity=parity)
