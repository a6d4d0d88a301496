"""Reading and checking of a run folder's files about its training and its newest evaluation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, NotRequired

import numpy as np
from annotated_types import Interval, Len, Predicate
from typing_extensions import TypedDict

from gaponet.base.arrays import Array
from gaponet.base.errors import ModelError
from gaponet.base.structure import Count, Json, Number, parse_json, read_json, read_npz
from gaponet.evaluation.methods import IDENTIFIED, METHODS

REPAIR_HINT = "give a complete run folder of gaponet train, or evaluate again"
Method = Annotated[str, Predicate(lambda name: name.removeprefix(IDENTIFIED) in METHODS)]
GROUPS = ("by_joint", "by_payload", "by_horizon", "by_motion", "by_independent_motion")


def _is_number(text: str) -> bool:
    try:
        return bool(np.isfinite(float(text)))
    except ValueError:
        return False


class _Error(TypedDict):
    mpjae: Number  # rad


class _JointError(_Error):
    static: Number
    dynamic: Number


Joints = Annotated[dict[str, _JointError], Len(1)]
Motions = Annotated[dict[str, _Error], Len(1)]
Payloads = Annotated[dict[Annotated[str, Predicate(_is_number)], _Error], Len(1)]
Horizons = dict[Annotated[str, Predicate(lambda time: time == "whole" or _is_number(time))], _Error]
# Metrics of one method, in total and by group. Every metric that the report shows stands here, so
# that the report of a run without it asks for another evaluation.
Scores = TypedDict(
    "Scores",
    {
        "mpjae": Number,
        "rmse": Number,
        "q_dis": Number,
        "static": Number,
        "dynamic": Number,
        "large_0.05": Number,
        "large_0.1": Number,
        "correlation": Number,
        "by_joint": Joints,
        "by_payload": Payloads,
        "by_horizon": Annotated[Horizons, Len(1)],
        "by_motion": Motions,
        "by_independent_motion": Motions,
    },
)


class _Shown(TypedDict):
    motion: str
    unit_id: str
    payload_mass: Annotated[float, Interval(ge=0, le=100)]
    dt: Annotated[float, Interval(ge=1e-4, le=1)]


class _Artifact(TypedDict):
    weights: str
    seed: Json


class _Delta(TypedDict):
    max: Number


class _Metrics(TypedDict):
    methods: dict[Method, Scores]
    ratio_to_nominal: dict[Method, Number]
    dataset: str
    sequences: Count
    motions: list[str]
    unseen: bool
    virtual: bool
    robot: str
    simulator_hash: str
    simulators: NotRequired[dict[Method, str]]
    delta: dict[Method, _Delta]
    artifacts: dict[Method, _Artifact]
    shown: NotRequired[Annotated[list[_Shown], Len(0, 100)]]
    moves: NotRequired[dict[str, Count]]
    date: NotRequired[str]
    command: NotRequired[str]


class _PPO(TypedDict):
    num_envs: int
    epochs: int
    std: float


class _Model(TypedDict):
    kind: Method


class _Config(TypedDict):
    model: _Model
    ppo: _PPO
    seed: int
    robot: str
    dataset: str
    dataset_hash: str
    command: NotRequired[str]


class _Validation(TypedDict):  # one line of progress.jsonl
    stage: str
    steps: Count
    seconds: float
    val_mpjae: Number
    nominal_mpjae: Number


def read_config(run: Path) -> dict[str, Any]:
    """Read config.json of a run.

    Raises:
        ModelError: The file is missing or damaged; the message names file and field. All functions
            here raise it.
    """
    return dict(read_json(_Config, run / "config.json", ModelError, REPAIR_HINT, allow_extra=True))


def read_metrics(run: Path) -> dict[str, Any]:
    """Read metrics.json of a run.

    Every method has the groups of the nominal one; absent numbers are NaN.
    """
    file = run / "metrics.json"
    metrics: dict[str, Any] = {
        **read_json(_Metrics, file, ModelError, REPAIR_HINT, allow_extra=True)
    }
    methods = metrics["methods"]
    if "nominal" not in methods or not set(methods) <= set(metrics["ratio_to_nominal"]):
        raise ModelError(
            f"{file}: methods: nominal is missing, or a method has no ratio to it; {REPAIR_HINT}"
        )
    for name, scores in methods.items():
        for group in GROUPS:
            if set(scores.get(group, ())) != set(methods["nominal"].get(group, ())):
                raise ModelError(
                    f"{file}: methods.{name}.{group}: should have what nominal has; {REPAIR_HINT}"
                )
        if "whole" not in scores["by_horizon"]:
            raise ModelError(f"{file}: methods.{name}.by_horizon.whole: is missing; {REPAIR_HINT}")
    return metrics


def read_trajectories(run: Path, metrics: dict[str, Any], joints: int) -> dict[str, Array]:
    """Read trajectories.npz of a run: ROW/METHOD, ROW/recorded and ROW/command, (T, joints) rad."""
    file = run / "trajectories.npz"
    arrays = read_npz(file, ModelError, REPAIR_HINT)
    for row in range(len(metrics.get("shown", []))):
        names = [f"{row}/{name}" for name in ("recorded", "command", *metrics["methods"])]
        if not _have_one_shape(arrays, names, joints):
            raise ModelError(
                f"{file}: sequence {row} has arrays of {joints} joints missing or of other sizes; "
                f"{REPAIR_HINT}"
            )
    for array in arrays.values():
        if array.dtype != np.float32 or not np.isfinite(array).all():
            raise ModelError(f"{file}: holds NaN or other types than float32; {REPAIR_HINT}")
    return arrays


def _have_one_shape(arrays: dict[str, Array], names: list[str], joints: int) -> bool:
    """Return True if all these arrays are there and are (T, joints), with one T of at least 2."""
    shapes = set[tuple[int, ...]]()
    for name in names:
        if name not in arrays or arrays[name].ndim != 2:
            return False
        shapes.add(arrays[name].shape)
    if len(shapes) != 1:
        return False
    rows, columns = shapes.pop()
    return rows >= 2 and columns == joints


def read_progress(run: Path) -> list[dict[str, Any]]:
    """Read the validations of a run; an incomplete last line is skipped."""
    file = run / "progress.jsonl"
    if not file.is_file():
        return []
    complete = file.read_bytes().split(b"\n")[:-1]
    validations = []
    for number, line in enumerate(complete, 1):
        if line.strip():
            where = f"{file}:{number}"
            read = parse_json(_Validation, line, where, ModelError, REPAIR_HINT, allow_extra=True)
            validations.append(dict(read))
    return validations


class _Floor(TypedDict):
    both: Number


class _Panel(TypedDict):
    left: dict[Method, Number]
    floor: _Floor


class _Gap(_Panel):
    by_joint: dict[str, _Panel]
    virtual: bool
    unseen: bool
    sequences: Count
    robot: str


def read_gap(run: Path) -> dict[str, Any] | None:
    """Read gap.json of a run; None if there is none."""
    file = run / "gap.json"
    again = "make it again with gaponet gap DATASET --run RUN"
    if not file.is_file():
        return None
    gap = read_json(_Gap, file, ModelError, again, allow_extra=True)
    steps = list(gap["left"])
    if not steps or any(list(panel["left"]) != steps for panel in gap["by_joint"].values()):
        raise ModelError(f"{file}: by_joint: should have the steps of left; {again}")
    return dict(gap)
