"""The offline HTML report about an identified robot or a run: data, errors, figures, warnings,
commands.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup

from gaponet.base.arrays import Array
from gaponet.base.errors import DatasetError, ModelError, UsageError
from gaponet.base.files import write_text
from gaponet.base.progress import Progress, no_progress
from gaponet.data.sequence import SequenceMeta
from gaponet.data.store import Dataset
from gaponet.evaluation.candidate import is_robot, read_origin
from gaponet.evaluation.methods import method, title
from gaponet.evaluation.run_files import (
    REPAIR_HINT,
    read_config,
    read_gap,
    read_metrics,
    read_progress,
    read_trajectories,
)
from gaponet.evaluation.tables import by_group, mrad, mrad_and_degrees, totals
from gaponet.evaluation.verdict import network_gain, verdict
from gaponet.nn.artifact import GapModel
from gaponet.nn.packaged_networks import is_packaged, named_folder
from gaponet.report.page import PageFigure, inline_image, page_figure, render
from gaponet.robot.folder import load_stored_robot
from gaponet.robot.servo_fields import SERVO_FIELDS
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.dataset_robot import dataset_robot
from gaponet.sim.model import require_stored_robot
from gaponet.sysid.uncertainty import ParameterUncertainty, summarize, table_rows

Picture = Callable[[RobotSpec, SequenceMeta, float, dict[str, Array]], bytes]
OPEN_TRAJECTORIES = 3  # motions shown without a click
CARD_FACTS = (
    "dt",
    "payload_seen",
    "units",
    "hours",
    "steps",
    "seconds",
    "seed",
    "excess_delay",
    "parity_rad",
    "motions",
    "versions",
    "dataset_hash",
)


class _Evaluated(NamedTuple):
    """An evaluated run or robot folder."""

    robot: RobotSpec
    own: str  # its method
    card: dict[str, Any] | None  # of its model; None for a robot folder
    config: dict[str, Any]  # of its training; empty for a robot folder
    metrics: dict[str, Any]  # metrics.json
    arrays: dict[str, Array]  # trajectories.npz: ROW/METHOD, …, (T, n operated) rad
    curve: list[dict[str, Any]]  # validations during training; empty for a robot folder
    gap: dict[str, Any] | None  # gap.json, if it is there

    @classmethod
    def read(cls, folder: Path, model: GapModel | None, robot: RobotSpec) -> _Evaluated:
        """Read the folder; ModelError where a file is missing, damaged or incomplete."""
        own = "identified" if model is None else method(model.config.kind, robot)
        card = None if model is None else model.card
        config = {} if model is None else read_config(folder)
        metrics = read_metrics(folder)
        curve = read_progress(folder)
        missing = []
        if card is not None:
            missing += [name for name in CARD_FACTS if name not in card]
        if not _is_complete(metrics, robot) or own not in metrics["methods"]:
            missing.append(f"a whole evaluation of {title(own)}")
        if card is not None:
            missing += _missing_of_training(card, curve)
        if missing:
            raise ModelError(f"{folder}: {', '.join(missing)} is missing; {REPAIR_HINT}")
        arrays = read_trajectories(folder, metrics, len(robot.operated))
        return cls(robot, own, card, config, metrics, arrays, curve, read_gap(folder))


def _missing_of_training(card: dict[str, Any], curve: list[dict[str, Any]]) -> list[str]:
    """Return what a run lacks of its training."""
    missing = []
    if not curve:
        missing.append("progress.jsonl")
    if {"train", "val"} - card.get("motions", {}).keys():
        missing.append("motions")
    return missing


def _is_complete(metrics: dict[str, Any], robot: RobotSpec) -> bool:
    """Return True if an evaluation has all fields that the page shows, of all operated joints."""
    moves = set(metrics.get("moves", ()))
    joints = set(metrics["methods"]["nominal"]["by_joint"])
    has_facts = {"date", "command", "shown"} <= metrics.keys()
    return has_facts and joints <= moves and moves == set(robot.operated)


def write_report(
    run: Path,
    dataset: Path | None = None,
    robot: str | None = None,
    progress: Progress = no_progress,
    picture: Picture | None = None,
) -> Path:
    """Write report.html into a run or robot folder from its newest evaluation.

    Evaluate first if there is none.

    Args:
        dataset: Evaluate on this dataset first. Default: the newest evaluation, or the test motions
            of the dataset that was fitted to.
        robot: Robot name or folder, if not the one that the run stores.
        picture: Draws the robot (view.portrait).

    Raises:
        ModelError: The folder is damaged or incomplete.
        DatasetError: The dataset of an evaluation is not there.
    """
    run = named_folder(run)
    if is_packaged(run):
        raise UsageError(
            f"a report lies beside what it describes, and '{run.name}' lies in the package; "
            f"gaponet eval {run.name} DATASET prints its errors, gaponet gap their causes"
        )
    model = None if is_robot(run) else GapModel.load(run)
    given = None
    if robot is not None:
        given = require_stored_robot(run, load_robot(robot), ModelError, "leave --robot out")
    if model is None:
        spec = load_robot(run)
    else:
        spec = given or load_stored_robot(run, model.card["robot"])
    if dataset is not None or not (run / "trajectories.npz").is_file():
        _evaluate(run, dataset, given, progress)
    evaluated = _Evaluated.read(run, model, spec)
    progress(0, 1, "drawing")
    values = _values(evaluated, picture)
    command = f"gaponet report {shlex.quote(str(run))}"
    path = run / "report.html"
    write_text(path, render("report.html.j2", report_command=command, **values))
    progress(1, 1, "drawing")
    return path


def _evaluate(run: Path, dataset: Path | None, robot: RobotSpec | None, progress: Progress) -> None:
    """Evaluate a folder on a dataset, by default on that which it was fitted to."""
    from gaponet.evaluation.evaluate import evaluate

    origin = read_origin(run) if is_robot(run) else read_config(run)
    fitted_to = "" if origin is None else origin["dataset"]
    place = dataset or run / fitted_to
    try:
        data = Dataset(place)
    except DatasetError as error:
        raise DatasetError(
            f"{error}. Say where the dataset is: gaponet report {run} --dataset DIR"
        ) from None
    robot = robot or dataset_robot(data, run)
    evaluate([run], data, robot, progress=progress).save(run)


def _values(e: _Evaluated, picture: Picture | None) -> dict[str, Any]:
    """Return the values of templates/report.html.j2."""
    from gaponet.report.figures import evaluation as draw

    methods = e.metrics["methods"]
    own_title = title(e.own)
    joint_columns, joint_rows = _by_joint(e)
    shown = e.metrics["shown"]
    figures = draw.trajectories(e.arrays, shown, e.robot.operated, list(methods))
    trajectories = []
    for row, figure in figures.items():
        caption = f" (unit {shown[row]['unit_id']}, {shown[row]['payload_mass']:g} kg)"
        trajectories.append(page_figure(figure, caption, shown[row]["motion"]))
    photo, photo_error = _photo(e, next(iter(figures), None), picture)
    simulators = []
    for name, simulator in e.metrics.get("simulators", {}).items():
        simulators.append(f"{title(name)} {simulator}")
    values: dict[str, Any] = {
        "title": f"{e.robot.name} {own_title}",
        "heading": f"{e.robot.description}: {own_title}",
        "metrics": e.metrics,
        "card": e.card,
        "config": e.config,
        "verdict": " ".join(verdict(methods)),
        "warnings": warnings(e.card, e.own, e.metrics),
        "totals": totals(methods, mrad_and_degrees),
        "best": int(np.argmin([m["mpjae"] for m in methods.values()])),
        "simulators": "; ".join(simulators),
        "adapted_title": title("adapted"),
        "joint_columns": joint_columns,
        "joint_rows": joint_rows,
        "bars": _bars(methods),
        "trajectories": trajectories,
        "open_trajectories": OPEN_TRAJECTORIES,
        "by_motion": by_group(methods, "motion", mrad_and_degrees),
        "waterfall": None,
        "parameters": _parameters(e.robot),
        "photo": photo,
        "photo_error": photo_error,
    }
    if e.gap is not None:
        caption = "Reduction of the mean |error| by each step (hollow: increase)."
        values["waterfall"] = page_figure(draw.waterfall(e.gap), caption)
    if e.card is not None:
        values |= _values_of_training(e.card, e.curve, e.metrics)
    return values


def _bars(methods: dict[str, Any]) -> list[PageFigure]:
    """Return the figures of the errors by joint, horizon and payload."""
    from gaponet.report.figures import evaluation as draw
    from gaponet.report.figures.style import joint_label

    by_joint = draw.by_group(methods, "joint", joint_label)
    by_horizon = draw.by_horizon(methods)
    bars = [
        page_figure(by_joint, "Mean |q_sim − q_robot| of each operated joint."),
        page_figure(by_horizon, "Error in the last half of the time since the common start."),
    ]
    if len(methods["nominal"]["by_payload"]) > 1:
        by_payload = draw.by_group(methods, "payload", "{} kg".format)
        bars.append(page_figure(by_payload, "Payload in each hand."))
    return bars


def _values_of_training(
    card: dict[str, Any], curve: list[dict[str, Any]], metrics: dict[str, Any]
) -> dict[str, Any]:
    """Return the values of the template about the training of a run."""
    from gaponet.report.figures import evaluation as draw

    corrections = [f"{name} {delta['max']:.3f}" for name, delta in metrics["delta"].items()]
    artifacts = []
    for name, artifact in metrics["artifacts"].items():
        artifacts.append(f"{name} {artifact['weights']} (seed {artifact['seed']})")
    caption = "Free run over whole validation motions; the circled model was selected."
    return {
        "training_curve": page_figure(draw.training_curve(curve), caption),
        "how_trained": GapModel.how_trained(card),
        "largest_corrections": ", ".join(corrections),
        "artifacts": ", ".join(artifacts),
        "versions": ", ".join(f"{name} {version}" for name, version in card["versions"].items()),
    }


def _parameters(robot: RobotSpec) -> tuple[list[str], list[list[str]]] | None:
    """Return columns and rows of the identified values with their standard errors; None if the
    robot keeps none.
    """
    known = ParameterUncertainty.load(robot)
    if known is None:
        return None
    summaries = [summarize(known, joint) for joint in known.joints]
    fields = []
    for field in known.fields:
        if any(summary.values[field] for summary in summaries):
            fields.append(field)
    columns = ["joint", *(SERVO_FIELDS[field].heading for field in fields)]
    return columns, table_rows(known, tuple(fields))


def _by_joint(e: _Evaluated) -> tuple[list[str], list[list[str]]]:
    """Return columns and rows: errors of every method, static and dynamic error of the folder's
    own, motions.
    """
    methods = e.metrics["methods"]
    own = title(e.own)
    table = by_group(methods, "joint")
    joints = methods[e.own]["by_joint"]
    rows = []
    for joint, *errors in table.texts():
        moving = e.metrics["moves"][joint]
        moves = f"{moving} of {e.metrics['sequences']}" if moving else "none: stands still"
        static = mrad(joints[joint]["static"])
        dynamic = mrad(joints[joint]["dynamic"])
        rows.append([joint, *errors, static, dynamic, moves])
    return [*table.columns, f"{own} static", f"{own} dynamic", "moves in"], rows


def _photo(e: _Evaluated, row: int | None, picture: Picture | None) -> tuple[Markup | None, str]:
    """Draw the robot in a motion with stored trajectories, of which row is the number.

    Return the photo and "", or None and the reason for its absence.
    """
    metrics = e.metrics
    arrays = e.arrays
    if picture is None or row is None:
        return None, ""
    shown = metrics["shown"][row]
    meta = SequenceMeta(
        robot=e.robot.name,
        unit_id=shown["unit_id"],
        motion=shown["motion"],
        payload_mass=shown["payload_mass"],
        virtual=metrics["virtual"],
    )
    names = dict.fromkeys(("command", "nominal", e.own, "recorded"))
    qpos = {name: arrays[f"{row}/{name}"] for name in names}
    # The command of row t is the target at t + 1.
    qpos["command"] = np.roll(qpos["command"], 1, axis=0)
    qpos["command"][0] = qpos["recorded"][0]
    try:
        return inline_image(picture(e.robot, meta, shown["dt"], qpos), "image/png"), ""
    except UsageError as error:
        return None, str(error)


def warnings(card: dict[str, Any] | None, own: str, metrics: dict[str, Any]) -> list[str]:
    """Return warnings about the evaluation; own is its method, card that of its model if any."""
    found = _warnings_of_data(metrics)
    if card is not None:
        found += _warnings_of_model(card, own, metrics["methods"])
    return found + _warnings_of_joints(own, metrics["methods"])


def _warnings_of_data(metrics: dict[str, Any]) -> list[str]:
    """Warn where the recordings do not show what the page seems to say."""
    found = []
    if metrics["virtual"]:
        found.append(
            "The recordings come from a virtual robot: these numbers say nothing about real "
            "hardware."
        )
    if not metrics["unseen"]:
        found.append(
            "Some recordings were used in training or for choosing the model: not a test result."
        )
    return found


def _warnings_of_joints(own: str, methods: dict[str, Any]) -> list[str]:
    """Warn of joints that became worse."""
    nominal = methods["nominal"]["by_joint"]
    worse = []
    for joint, errors in methods[own]["by_joint"].items():
        if errors["mpjae"] > nominal[joint]["mpjae"]:
            worse.append(joint)
    return [f"Worse than the nominal simulator on: {', '.join(worse)}."] if worse else []


def _warnings_of_model(card: dict[str, Any], own: str, methods: dict[str, Any]) -> list[str]:
    """Warn where a model does not help, or was trained on too little or for too short a time."""
    found = []
    better = []
    for name, scores in methods.items():
        if name not in (own, "adapted") and scores["mpjae"] <= methods[own]["mpjae"]:
            better.append(title(name))
    if better:
        found.append(f"The model does not beat {', '.join(better)}: do not use it.")
    payloads = [float(payload) for payload in methods["nominal"]["by_payload"]]
    found += _warnings_of_coverage(card, payloads)
    done, planned = card.get("stages", {}).get("pretraining_rounds", (0, 0))
    if done < planned:
        is_useless = "identified" in methods and not network_gain(methods, own).helps
        advice = "" if is_useless else "; train longer"
        rounds = f"{done} of {planned} rounds of supervised pre-training"
        found.append(f"Undertrained: the budget ended after {rounds}{advice}.")
    if card.get("interrupted"):
        found.append("Training was interrupted before its budget was out.")
    return found


def _warnings_of_coverage(card: dict[str, Any], payloads: list[float]) -> list[str]:
    """Warn where the training data or the history of a model do not cover what is asked of it.

    Args:
        payloads: Those of the evaluation, kg.
    """
    found = []
    lightest = min(card["payload_seen"])
    heaviest = max(card["payload_seen"])
    outside = [payload for payload in payloads if not lightest <= payload <= heaviest]
    if outside:
        found.append(
            f"Payloads {outside} kg lie outside those trained on ({lightest:g} to {heaviest:g} kg)."
        )
    if len(card["units"]) == 1:
        found.append(
            f"Trained on one unit ({card['units'][0]}): another unit's zero offsets and friction "
            "are unknown to it."
        )
    span = card["model"]["history"] * card["model"]["stride"] * min(card["dt"])  # s
    if card["excess_delay"] > span + 1e-6:
        found.append(
            f"The robot lags the simulator by {card['excess_delay'] * 1e3:.0f} ms, the history "
            f"spans {span * 1e3:.0f} ms: raise --model.history or --model.stride."
        )
    return found
