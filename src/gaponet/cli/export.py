"""gaponet export."""

from __future__ import annotations

import json as json_text
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from gaponet import api
from gaponet.api.files import NetworkTarget, RobotTarget, require_out
from gaponet.base.errors import UsageError
from gaponet.base.files import write_text
from gaponet.base.progress import progress_bar
from gaponet.cli.options import Flag, Folder, Json, like
from gaponet.cli.out import Out
from gaponet.evaluation.tables import mrad
from gaponet.nn.packaged_networks import is_packaged, is_packaged_network, named_folder
from gaponet.robot.spec import load_robot

if TYPE_CHECKING:
    from gaponet.export.randomization import Engine, Scope

POLICY_FILE, POLICY_STEP = "policy_postprocessor.json", "gaponet_correct"  # of a LeRobot policy
CHECKED_IN = {"mjcf": "MuJoCo", "envhub": "MuJoCo", "actuator-net": "mjlab"}
Holder = Annotated[
    Folder,
    tyro.conf.arg(
        help="Robot folder, run folder of gaponet train, or a name of the package (gaponet robot list, networks).",
        metavar="ROBOT|RUN|NAME",
    ),
]


@like(api.export_robot)
def export(
    robot: Holder, to: RobotTarget | NetworkTarget | Literal["randomization", "lerobot"] = "onnx",
    out: Path | None = None, data: str | None = None, into: Path | None = None, prefix: str = "",
    payload_mass: float = 0.0, engine: Literal["json", "mujoco", "mjlab", "isaaclab"] = "json",
    scope: Literal["today", "any-day", "any-robot"] = "today", units: tuple[Path, ...] = (), dynamics: Flag = False,
    remove: Flag = False, json: Json = False,
) -> None:  # fmt: skip
    """Write an identified robot or a network for another program.

    Args:
        to: Simulator of a robot or a run: mjcf (plain MuJoCo), envhub (an environment of LeRobot's EnvHub in MuJoCo),
            mjlab, isaaclab and newton, each with a check.py that needs no gaponet; urdf (damping, friction, effort
            limits); json (the numbers). Network of a run: onnx (model.onnx and card.json), torch (delta.pt2 with
            simulator and action term for mjlab and Isaac Lab), actuator-net (one network per joint; its inputs are past
            target − position and speed, its output is the torque). randomization: sets of a robot's parameters
            ("units") for training. lerobot: add the correction to the LeRobot policy in --into; LeRobot finds it
            through the plug-in lerobot_robot_gaponet.
        into: For mjcf, envhub and urdf: a file of your own; an edited copy is written (but for urdf, default the
            robot's). For lerobot: folder of a policy (pretrained_model) that holds policy_postprocessor.json.
        engine: For randomization: engine for which a file is written that applies units of randomization.json.
        scope: today: this robot as last fitted. any-day: sessions on several days. any-robot: all robots of its type.
        units: For any-robot: robot folders of the type.
        dynamics: For lerobot: feed forward inertia and damping too; use it for smooth targets only.
        remove: For lerobot: remove the correction.
    """
    screen = Out(json)
    robot = named_folder(robot)
    for words, unused in (
        (
            "--engine, --scope, --units",
            to != "randomization" and (engine != "json" or scope != "today" or units),
        ),
        ("--payload-mass", to == "randomization" and payload_mass),
        ("--out", to == "lerobot" and out),
        (
            "--into and --prefix",
            to not in ("mjcf", "envhub", "urdf", "lerobot") and (into or prefix),
        ),
        ("--data", to in ("onnx", "torch", "lerobot") and data),
    ):
        if unused:
            raise UsageError(f"--to {to} does not use {words}; leave out what you gave")
    if to == "randomization":
        require_out(robot, out)
        _show_ranges(screen, robot, out or robot / "randomization", engine, scope, units, data)
        return
    if to == "lerobot":
        if into is None:
            raise UsageError("--to lerobot: give the folder of a LeRobot policy with --into POLICY")
        _attach(screen, into, None if remove else robot, payload_mass, dynamics)
        return
    if to == "onnx" or to == "torch" or to == "actuator-net":
        if (robot / "robot.toml").is_file():
            engines = "mjcf, mjlab, isaaclab, newton or json"
            raise UsageError(f"{robot}: is a robot, which has no network; --to {engines}")
        made = api.export_network(robot, to=to, out=out, data=data, payload_mass=payload_mass)
    else:
        with progress_bar("exporting") as update:
            made = api.export_robot(
                robot, to=to, out=out, data=data, into=into, prefix=prefix, payload_mass=payload_mass, progress=update
            )  # fmt: skip
    if made.parity is not None:
        screen.say(f"{made.path}: differs by {made.parity:.1e} rad from what was trained")
    else:
        motions = (
            ("VIRTUAL" if made.virtual else "validation") + " motion" + "s" * (made.motions != 1)
        )
        rows = [[form, mrad(error)] for form, error in made.errors.items()]
        screen.table(f"Mean |error| on {made.motions} {motions}", ["form", "mrad"], rows)
        for line in made.notes:
            screen.say(f"  {line}", "warning", "yellow")
        screen.say(f"{made.path}: {made.robot} for {to}")
        if made.check:
            screen.next(f"python {made.check}, in {CHECKED_IN.get(to, to)}")
    screen.result(made.to_dict())


def _show_ranges(
    screen: Out,
    robot: Path,
    out: Path,
    engine: Engine,
    scope: Scope,
    units: tuple[Path, ...],
    data: str | None,
) -> None:
    from gaponet.export.randomization import FILE, table_rows

    with progress_bar("drawing") as update:
        file, made = api.randomization(
            robot, out=out, engine=engine, scope=scope, units=units, data=data, progress=update
        )  # fmt: skip
    screen.table(f"{made.robot}, {scope}: range of 9 of 10 units", *table_rows(made))
    forms = {"with the servo model": made.judged, "without it": made.plain}
    if made.plain is made.judged:
        forms = {"identified": made.judged}
    rows = [
        [form, *(mrad(judged.errors[name]) for name in ("exported", "units", "one by one", "by hand"))]
        for form, judged in forms.items() if judged is not None
    ]  # fmt: skip
    if rows:
        heading = ["robot", "exported", "units", "single numbers of the ranges", "± 20 % by hand"]
        screen.table("Mean error on validation motions, mrad", heading, rows)
    for note in made.notes:
        screen.say(f"  {note}", "note", "cyan")
    if made.unknown:
        names = "; ".join(made.unknown)
        screen.say(
            f"  no log determines these, drawn from the prior range: {names}", "warning", "yellow"
        )
    use = "" if engine == "json" else f"; {file.name} applies them in {engine}"
    screen.say(f"{file.parent / FILE}: {len(next(iter(made.units.values())))} units{use}")
    screen.result(
        {"path": str(file), "scope": scope, "ranges": made.ranges, "unknown": made.unknown}
    )


def _attach(
    screen: Out, policy: Path, holder: Path | None, payload_mass: float, dynamics: bool
) -> None:
    """Put the correction of a robot or a run behind a LeRobot policy, in place of an earlier one; None removes it."""
    file = policy / POLICY_FILE
    if not file.is_file():
        raise UsageError(
            f"{policy}: has no {POLICY_FILE}; give the folder that holds a LeRobot policy and its processors"
        )
    try:
        document = json_text.loads(file.read_text(encoding="utf-8"))
        steps = [step for step in document["steps"] if step.get("registry_name") != POLICY_STEP]
    except (ValueError, KeyError, TypeError, AttributeError):
        raise UsageError(f"{file}: is no processor of LeRobot") from None
    config: dict[str, object] = {}
    if holder is not None and is_packaged_network(holder):
        config = {"model": holder.name, "payload_mass": payload_mass, "dynamics": dynamics}
        steps.append({"registry_name": POLICY_STEP, "config": config})
    elif holder is not None:
        is_robot = (holder / "robot.toml").is_file()
        if is_robot:
            load_robot(holder)
        elif not (holder / "model").is_dir():
            raise UsageError(
                f"{holder}: is neither a robot folder of gaponet identify nor a run of gaponet train"
            )
        config = {
            "known" if is_robot else "model": holder.name
            if is_packaged(holder)
            else str(holder.resolve()),
            "payload_mass": payload_mass,
            "dynamics": dynamics,
        }
        steps.append({"registry_name": POLICY_STEP, "config": config})
    write_text(file, json_text.dumps(document | {"steps": steps}, indent=2) + "\n")
    names = [step.get("registry_name", step.get("class", "?")) for step in steps]
    screen.say(f"{file}: {' → '.join(names) or 'no steps'}")
    screen.result({"file": str(file), "steps": names, "config": config})
