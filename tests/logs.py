"""Small logs in the formats that gaponet reads, written by the tests themselves."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.data.store import Dataset
from gaponet.robot.spec import RobotSpec

SERVO_NAMES = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw")
SO101 = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
PERIOD_US = 20060.0  # the public SO-101 logs' own


def wave(
    rows: int, n: int, dt: float = 0.02006, amplitude: float = 0.3, hertz: float = 0.5
) -> np.ndarray:
    """Targets (rows, n): a sine of another phase and pace for every joint."""
    t = np.arange(rows)[:, None] * dt
    return amplitude * np.sin(2 * np.pi * hertz * t * (1 + 0.37 * np.arange(n)) + np.arange(n))


FOLLOWING_ERROR = (
    2e-5  # of the distance from home; a servo never repeats its commands to the last digit
)


def late(ctrl: np.ndarray, steps: int) -> np.ndarray:
    """Nearly the same `steps` rows later, first row held: what a good servo does.

    Without steps, a copy.
    """
    if not steps:
        return ctrl.copy()
    delayed = np.concatenate([np.repeat(ctrl[:1], steps, axis=0), ctrl[:-steps]])
    return (1 - FOLLOWING_ERROR) * delayed


def write_sage(
    folder: Path,
    ctrl: np.ndarray,
    qpos: np.ndarray,
    tau: np.ndarray | None = None,
    names: tuple[str, ...] = SERVO_NAMES,
    time: np.ndarray | None = None,
    qvel: np.ndarray | None = None,
) -> Path:
    """One motion folder; time in µs, (rows,)."""
    folder.mkdir(parents=True, exist_ok=True)
    time = 7.1 + PERIOD_US * np.arange(len(ctrl)) if time is None else time
    (folder / "joint_list.txt").write_text("\n".join(names) + "\n")
    (folder / "event.csv").write_text(
        "type,timestamp,event\nEVENT,0,CONTROL_MODE_ENABLE\nEVENT,7.1,MOTION_START\n"
    )
    numbers = lambda row: '"[' + ", ".join(repr(float(x)) for x in row) + ']"'  # noqa: E731
    qvel = np.zeros_like(qpos) if qvel is None else qvel
    tau = np.zeros_like(qpos) if tau is None else tau
    control = [f"CONTROL,{t},{numbers(u)}" for t, u in zip(time, ctrl, strict=True)]
    state = [
        f"STATE_MOTOR,{t},{numbers(q)},{numbers(v)},{numbers(f)}"
        for t, q, v, f in zip(time, qpos, qvel, tau, strict=True)
    ]
    (folder / "control.csv").write_text("\n".join(["type,timestamp,positions", *control]) + "\n")
    (folder / "state_motor.csv").write_text(
        "\n".join(["type,timestamp,positions,velocities,torques", *state]) + "\n"
    )
    return folder


def write_so101(folder: Path, rows: int = 60, lag: int = 2) -> Path:
    """One motion of an SO-101 in SAGE's form; the gripper in 0..1."""
    ctrl = wave(rows, 6)
    ctrl[:, 5] = 0.5 + ctrl[:, 5]
    return write_sage(folder, ctrl, late(ctrl, lag))


def stock(
    folder: Path,
    values: list[np.ndarray] | None = None,
    rows: tuple[int, ...] = (40, 50),
    names: tuple[str, ...] = SO101,
    **changes: object,
) -> Path:
    """A set as lerobot 0.4 writes it for an SO-101: degrees, gripper 0..100, no metadata of
    ours.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    values = (
        [np.full((n, 6), 10.0) + np.arange(n)[:, None] / 10 for n in rows]
        if values is None
        else values
    )
    feature = {"dtype": "float32", "shape": [6], "names": [f"{n}.pos" for n in names]}
    video = {"dtype": "video", "shape": [48, 64, 3], "names": None}
    info = {
        "codebase_version": "v3.0",
        "fps": 30,
        "robot_type": "so101_follower",
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "features": {
            "action": feature,
            "observation.state": feature,
            "observation.images.top": video,
        },
    }
    for place in ("meta/episodes/chunk-000", "data/chunk-000"):
        (folder / place).mkdir(parents=True, exist_ok=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info | changes))
    pq.write_table(
        pa.table({"task_index": [0], "__index_level_0__": ["Pick up!"]}),
        folder / "meta" / "tasks.parquet",
    )
    starts = np.cumsum([0, *map(len, values)])
    pq.write_table(
        pa.Table.from_pylist(
            [
                {
                    "episode_index": i,
                    "tasks": ["Pick up!"],
                    "length": len(v),
                    "data/chunk_index": 0,
                    "data/file_index": 0,
                    "dataset_from_index": int(starts[i]),
                    "dataset_to_index": int(starts[i + 1]),
                    "stats/action/min": [0.0],
                }
                for i, v in enumerate(values)
            ]
        ),
        folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet",
    )
    frame = np.concatenate([np.arange(len(v)) for v in values])
    flat = np.concatenate(values).astype(np.float32)
    pq.write_table(
        pa.table(
            {
                "action": pa.FixedSizeListArray.from_arrays(pa.array(flat.ravel()), 6),
                "observation.state": pa.array((flat - 1).tolist(), pa.list_(pa.float32())),
                "timestamp": (frame / 30).astype(np.float32),
                "frame_index": frame,
                "episode_index": np.repeat(np.arange(len(values)), [len(v) for v in values]),
            }
        ),
        folder / "data" / "chunk-000" / "file-000.parquet",
    )
    return folder


def table_text(columns: dict[str, np.ndarray]) -> str:
    """CSV."""
    rows = zip(*columns.values(), strict=True)
    return (
        "\n".join([",".join(columns), *(",".join(repr(float(x)) for x in row) for row in rows)])
        + "\n"
    )


def arm_columns(rows: int = 60, dt: float = 0.02, lag: int = 2) -> dict[str, np.ndarray]:
    """Columns of a table for the two-joint arm of tests/arm.py, in s and rad."""
    ctrl = wave(rows, 2, dt)
    qpos = late(ctrl, lag)
    columns = {"time": dt * np.arange(rows)}
    columns |= {f"ctrl.{name}": ctrl[:, j] for j, name in enumerate(("shoulder", "elbow"))}
    return columns | {f"qpos.{name}": qpos[:, j] for j, name in enumerate(("shoulder", "elbow"))}


def arm_sequence(
    robot: RobotSpec,
    ctrl: np.ndarray,
    qpos: np.ndarray,
    motion: str = "m",
    payload: float = 0.0,
    **fields: Any,
) -> Sequence:
    """A sequence of any robot at its own rate; qvel is the derivative unless given."""
    notes = fields.pop("notes", {})
    unit = str(fields.pop("unit", "a"))
    meta = SequenceMeta(robot.name, unit, motion, payload, notes=notes)
    qvel = fields.pop("qvel", np.gradient(qpos, robot.dt, axis=0))
    return Sequence(meta, robot.joint_names, robot.dt, ctrl, qpos, qvel, **fields)


def repeated_motions(folder: Path, robot: RobotSpec) -> Dataset:
    """A dataset of four motions by two units, each three times."""
    data = Dataset.create(folder, robot)
    for motion in range(4):
        for unit in ("a", "b"):
            for k in range(3):
                ctrl = wave(120, 2, hertz=0.4 + 0.2 * motion)
                qpos = late(ctrl, 2 + (unit == "b")) + 0.002 * k
                one = arm_sequence(
                    robot, ctrl, qpos, f"m{motion}", unit=unit, payload=0.5 * (unit == "b")
                )
                data.append(replace(one, meta=replace(one.meta, repetition=k)))
    return data


def write_bam(file: Path, rows: int = 60, off: int | None = None, **changes: object) -> Path:
    """One recording of BAM's test bench at firmware gain 400; torque off from row `off` on."""
    ctrl = wave(rows, 1, 0.0053)[:, 0]
    qpos = late(wave(rows, 1, 0.0053), 3)[:, 0]
    entries = [
        {
            "timestamp": 0.0035 + 0.0053 * i,
            "position": q,
            "speed": 0.0,
            "load": 65530,
            "input_volts": 7.3,
            "temp": 39,
            "goal_position": u,
            "torque_enable": off is None or i < off,
        }
        for i, (u, q) in enumerate(zip(ctrl.tolist(), qpos.tolist(), strict=True))
    ]
    head = {
        "mass": 0.49,
        "length": 0.1,
        "kp": 400,
        "vin": 7.4,
        "motor": "xl330",
        "trajectory": "sin_sin",
    }
    file.write_text(json.dumps(head | {"entries": entries} | changes))
    return file
