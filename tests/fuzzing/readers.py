"""What strangers send: logs in every format, column maps, motion files, recipes.

Each is read as a user would.
"""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from arm import write_arm
from logs import arm_columns, arm_sequence, late, stock, table_text, wave, write_bam, write_so101
from motion_files import write_motion
from strange_logs import (
    write_aloha,
    write_asap,
    write_bag,
    write_gaponet,
    write_mat,
    write_npz,
    write_pace,
)

from fuzzing.harness import AbsurdError, Target
from fuzzing.mutate import Files
from gaponet.data.importer import ImportRequest, import_logs
from gaponet.data.store import Dataset
from gaponet.data.writers import export
from gaponet.motion.files import read_motion
from gaponet.motion.motion import Motion
from gaponet.motion.recipe import load_recipe, takes
from gaponet.robot.spec import RobotSpec, load_robot

PLACE = tempfile.TemporaryDirectory(
    prefix="fuzz-"
)  # deleted when the process that imported this ends
ROWS = 40
MOST_ROWS = 25 * ROWS  # a file may be doubled by a change, and doubled again
BOUNDS = {"qvel": 1e3, "qacc": 1e6, "tau": 1e3, "tau_eq": 1e6, "temperature": 400.0}


@functools.cache
def so101() -> RobotSpec:
    return load_robot("so101")


@functools.cache
def bench() -> RobotSpec:
    return load_robot("xl330_bench")


@functools.cache
def arm() -> RobotSpec:
    return write_arm(Path(PLACE.name) / "arm")


def written(write: Callable[[Path], object]) -> Callable[[], Files]:
    """The files that a function writes into a folder."""

    def files() -> Files:
        with tempfile.TemporaryDirectory() as folder:
            write(Path(folder))
            return {
                p.relative_to(folder).as_posix(): p.read_bytes()
                for p in sorted(Path(folder).rglob("*"))
                if p.is_file() and not p.name.startswith(".gaponet")
            }

    return files


def require_sane(dataset: Dataset, robot: RobotSpec, inside: Path) -> None:
    """Raise AbsurdError for a stored sequence that no robot can have recorded."""
    for entry in dataset.entries:
        sequence = dataset.read(entry)
        if not 1e-4 <= sequence.dt <= 1 or not 2 <= len(sequence) <= MOST_ROWS:
            raise AbsurdError(f"{entry.id}: {len(sequence)} rows of {sequence.dt} s")
        source = (
            inside.parent / entry.meta.source.rpartition("#")[0]
            if "#" in entry.meta.source
            else inside.parent / entry.meta.source
        ).resolve()
        if not source.is_relative_to(inside.parent.resolve()) and not entry.meta.virtual:
            raise AbsurdError(f"{entry.id}: read from {source}, outside {inside}")
        for name in entry.channels:
            values = getattr(sequence, name)
            if not np.isfinite(values).all():
                raise AbsurdError(f"{entry.id}: {name} holds NaN")
            if name in ("ctrl", "qpos"):
                low, high = robot.qpos_range.T
                if (
                    (values < np.minimum(low - 1, -3.3)) | (values > np.maximum(high + 1, 3.3))
                ).any():
                    raise AbsurdError(f"{entry.id}: {name} up to {np.abs(values).max()} rad")
            elif np.abs(values).max() > BOUNDS[name]:
                raise AbsurdError(f"{entry.id}: {name} up to {np.abs(values).max()}")


def importing(
    robot: Callable[[], RobotSpec], at: str = "", stated: str = "", **options: object
) -> Callable[..., None]:
    """Import `at` below the folder and look at what was stored."""

    def use(source: Path, out: Path) -> None:
        given = options | (
            {"logs": str(source / str(options["logs"]))} if "logs" in options else {}
        )
        unit = None if stated == "all" else "lab"
        payload = None if stated else 0.0
        report = import_logs(
            source / at, robot(), out, ImportRequest(unit_id=unit, payload_mass=payload, **given)
        )
        require_sane(Dataset(out), robot(), source)
        if len(report.entries) != len(Dataset(out).entries):
            raise AbsurdError(f"{len(report.entries)} imported, {len(Dataset(out).entries)} stored")

    return use


def _tables(folder: Path) -> None:
    columns = arm_columns(ROWS)
    columns |= {
        "qvel.shoulder": np.gradient(columns["qpos.shoulder"], 0.02),
        "tau.elbow": wave(ROWS, 1)[:, 0],
    }
    columns |= {
        "qvel.elbow": np.gradient(columns["qpos.elbow"], 0.02),
        "tau.shoulder": wave(ROWS, 1)[:, 0],
    }
    (folder / "a.csv").write_text(table_text(columns))


def _parquet(folder: Path) -> None:
    pq.write_table(
        pa.table({k: pa.array(v) for k, v in arm_columns(ROWS).items()}), folder / "a.parquet"
    )


def _mapped(folder: Path) -> None:
    theirs = dict(
        zip(["t", "cmd_1", "cmd_2", "pos_1", "pos_2"], arm_columns(ROWS).values(), strict=True)
    )
    (folder / "logs").mkdir()
    (folder / "logs" / "a.csv").write_text(table_text(theirs))
    (folder / "map.toml").write_text(
        'time = "t"\ntime_unit = "s"\nposition_unit = "rad"\n[columns]\n"ctrl.shoulder" = "cmd_1"\n'
        '"ctrl.elbow" = "cmd_2"\n"qpos.shoulder" = "pos_1"\n"qpos.elbow" = "pos_2"\n'
        '[joint_units]\nelbow = "rad"\n'
    )


def _described(folder: Path) -> None:
    """Strange names, a sheet, a sign, and commands in a file of their own."""
    columns = dict(zip(["t", "a_des", "b_des", "a", "b"], arm_columns(ROWS).values(), strict=True))
    (folder / "x.csv").write_text(table_text({k: v for k, v in columns.items() if "des" not in k}))
    (folder / "x_cmd.csv").write_text(
        table_text({k: v for k, v in columns.items() if len(k) != 1 or k == "t"})
    )
    (folder / "sheet.csv").write_text("file,motion,payload,rep,kp.b\nx,wave,0.1,0,20\n")
    (folder / "logs.toml").write_text(
        'time = "t"\ntime_unit = "s"\nposition_unit = "rad"\n'
        'ctrl = "{joint}_des"\nqpos = "{joint}"\n'
        'ignore = ["t"]\ncommand_file = "{name}_cmd.csv"\nmanifest = "sheet.csv"\n'
        '[names]\na = "shoulder"\n'
        'b = "elbow"\n[signs]\nshoulder = -1\n'
    )


def _export(folder: Path) -> None:
    with tempfile.TemporaryDirectory() as place:
        data = Dataset.create(Path(place) / "data", arm())
        for i in range(2):
            ctrl = wave(ROWS, 2, hertz=0.4 + 0.1 * i)
            data.append(
                arm_sequence(
                    arm(), ctrl, late(ctrl, 2), f"m{i}", 0.1, tau=ctrl, tau_eq=ctrl, qacc=ctrl
                )
            )
        data.set_provenance(licence="CC0-1.0")
        export(data, folder / "set")


def _motions(folder: Path) -> None:
    for suffix in (".txt", ".csv", ".npz"):
        write_motion(
            folder / f"wave{suffix}", Motion("wave", "whole_body", 0.02, wave(ROWS, 2, 0.02)), arm()
        )


def _read_motions(source: Path, out: Path) -> None:
    for file in sorted(source.iterdir()):
        motion = read_motion(file, arm())
        played = motion.sample(0.02)
        if (
            not 1e-4 <= motion.dt <= 1
            or not 2 <= len(played) <= 60 * MOST_ROWS
            or not np.isfinite(played).all()
        ):
            raise AbsurdError(
                f"{file.name}: {len(motion.ctrl)} rows of {motion.dt} s, {len(played)} when played"
            )
        if np.abs(motion.ctrl).max() > 1e3:
            raise AbsurdError(f"{file.name}: commands {np.abs(motion.ctrl).max()} rad")


RECIPE = """payloads = [0.0, 0.3]
units = ["virtual-1"]
rates = [50, 100.0]
motions = ["*-left_*"]
files = ["wave.txt"]
repetitions = 2
variants = 1
payload_side = "both"
"""


def _read_recipe(source: Path, out: Path) -> None:
    recipe = load_recipe(source / "mine.toml")
    for take in takes(recipe, ["chirp-left_elbow", "step-left_elbow"]):
        if not (
            0 <= take.payload <= 100 and 1 <= take.rate <= 10_000 and isinstance(take.unit, str)
        ):
            raise AbsurdError(f"a take of {take}")
        take.seed(0)


TARGETS = (
    Target(
        "sage",
        written(lambda f: write_so101(f / "real" / "so101" / "wave", ROWS)),
        importing(so101),
        2.0,
    ),
    Target("table", written(_tables), importing(arm, position_unit="rad", time_unit="s"), 2.0),
    Target("parquet", written(_parquet), importing(arm, position_unit="rad", time_unit="s"), 1.5),
    Target(
        "logs.toml",
        written(_mapped),
        importing(arm, "logs", logs="map.toml"),
        1.0,
        (".toml", "a.csv"),
    ),
    Target("described", written(_described), importing(arm, stated="payload"), 1.0),
    Target("rosbag", written(lambda f: write_bag(f / "bag", "mcap", rows=20)), importing(arm), 1.5),
    Target(
        "db3",
        written(lambda f: write_bag(f / "bag", "db3", rows=20)),
        importing(arm),
        1.0,
        (".db3", ".yaml"),
    ),
    Target("hdf5", written(write_aloha), importing(arm), 1.0, (".hdf5",)),
    Target("npz", written(write_npz), importing(arm), 1.0, (".npz",)),
    Target("gaponet npz", written(write_gaponet), importing(arm, stated="payload"), 1.0, (".npz",)),
    Target("mat", written(write_mat), importing(arm), 0.05, (".mat",)),
    Target("pt", written(write_pace), importing(arm), 0.7, (".pt",)),
    Target("asap", written(write_asap), importing(arm, allow_pickle=True), 1.0, (".pkl",)),
    Target(
        "lerobot",
        written(lambda f: stock(f / "set", rows=(25, 15))),
        importing(so101, position_unit="deg"),
        2.5,
    ),
    Target(
        "bam",
        written(lambda f: write_bam(f / "a.json", ROWS, 30)),
        importing(bench, stated="payload"),
        1.0,
    ),
    Target("export", written(_export), importing(arm, "set", stated="all", format="lerobot"), 2.0),
    Target("motion", written(_motions), _read_motions, 1.5),
    Target(
        "recipe",
        written(lambda f: (f / "mine.toml").write_text(RECIPE)),
        _read_recipe,
        0.7,
        (".toml",),
    ),
)
