"""Coverage of the standard errors and prediction bands, and verdicts of gaponet check.

    python benchmarks/uncertainty.py virtual WORK --robots 100 --form FORM   two-joint arms
    python benchmarks/uncertainty.py real ROBOT DAY OTHER_DAY WORK           datasets of two days
    python benchmarks/uncertainty.py table WORK                              tables of the arms

An arm is VIRTUAL and drawn from the fleet `hard`. With the form "right", only its gain, damping,
dry friction, delay and encoder noise are hidden; it has the physics step of its file, and delays
of whole steps. With "step", its own steps are 1 ms long, those of the file 5 ms. With "wrong", all
effects of the fleet are hidden. `gaponet identify` fits eight motions of 15 s; three more are the
validation set. Then the arm plays eight other motions per day: on some days nothing changed, on
the others one parameter did. ROBOT was identified from the training motions of DAY. The results
are in docs/results/know.md.
"""

from __future__ import annotations

import json
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import NORMAL_90, Row, append_row, command_line, print_table, read_rows
from draws import log_uniform
from virtual_arms import play_virtual

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.data.split import split_entries
from gaponet.data.store import Dataset
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.replay import replay
from gaponet.sysid.evidence.drift import Drift, drift
from gaponet.sysid.evidence.evidence import estimate_uncertainty
from gaponet.sysid.identify import identify
from gaponet.sysid.options import IdentifyOptions
from gaponet.sysid.uncertainty import ParameterUncertainty
from gaponet.virtual.fleet import load_fleet, sample_unit
from gaponet.virtual.physics import Physics
from gaponet.virtual.virtual_robot import VirtualRobot

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from arm import write_arm

MOTIONS = 8  # of a day
VALIDATION_MOTIONS = 3  # of the second day
ROWS = 750  # of a motion
GROUP = 50  # arms that are simulated together
WINDOWS = 12  # of a fit
RIGHT = ("gain", "damping", "friction", "delay", "encoder")  # effects of the form that is fitted
TRAIN, VAL, SAME = range(3)  # numbers of days
DAYS = (
    "train",
    "val",
    "same",
    "friction +20 %",
    "zero +5 mrad",
    "delay +5 ms",
    "backlash 8 mrad",
    "30 K warmer",
)
ANOTHER = "another robot"
MOVED_FIELD = {
    "friction +20 %": "frictionloss",
    "zero +5 mrad": "offset",
    "delay +5 ms": "delay",
    "backlash 8 mrad": "play",
}
ARM_FRICTION = 0.05  # N·m, of the arm's file
ARM_DAMPING = 0.5  # N·m·s/rad
ARM_ARMATURE = 0.02  # kg·m²
FORMS = ("right", "step", "wrong")
# Standard errors: of the table of identify, which knows the physics step; in uncertainty.json.
KINDS = ("printed", "stored")


# ---- VIRTUAL arms


def commands(seed: int, dt: float) -> np.ndarray:
    """Draw commands of two joints, (ROWS, 2) rad: sines on moves between rests."""
    rng = np.random.default_rng([seed, 77])
    time_s = np.arange(ROWS) * dt
    waves = np.zeros((ROWS, 2))
    for hertz in log_uniform(rng, 0.1, 1.5, (3, 2)):
        size = rng.uniform(0.05, 0.25, 2) / (1 + 2 * hertz)
        phases = rng.uniform(0, 6, 2)
        waves += size * np.sin(2 * np.pi * hertz * time_s[:, None] + phases)
    stops = np.cumsum(rng.uniform(0.8, 2.5, 12))
    places = rng.uniform(-0.5, 0.5, (13, 2))
    corners = np.r_[0, np.repeat(stops, 2) + np.tile([0, 0.5], 12)]
    ways = np.zeros((ROWS, 2))
    for j in range(2):
        at_corners = np.r_[places[0, j], np.repeat(places[:, j], 2)[1:25]]
        ways[:, j] = np.interp(time_s, corners, at_corners)
    return ways + waves


def changed(unit: Physics, what: str) -> Physics:
    """Return the unit on that day; the friction of the arm's file counts as the unit's own."""
    if what == "friction +20 %":
        return replace(unit, friction=1.2 * (unit.friction + ARM_FRICTION) - ARM_FRICTION)
    if what == "delay +5 ms":
        return replace(unit, delay=unit.delay + 5e-3)
    if what == "backlash 8 mrad":
        return replace(unit, backlash=unit.backlash + np.array([0.0, 8e-3]))
    if what == "30 K warmer":
        return replace(unit, warmth=unit.warmth + 30.0)
    return unit


def play(
    robot: RobotSpec, units: list[Physics], first: int, day: int, timestep: float | None
) -> list[list[Sequence]]:
    """Simulate the motions of one day for every unit.

    Args:
        first: Number of the first unit.
        timestep: Physics step, s; None for that of virtual robots.
    """
    rng = np.random.default_rng([first, day])
    ctrl = []
    rows = []
    warmth = []
    for k, unit in enumerate(units):
        for motion in range(MOTIONS):
            ctrl.append(commands(100_000 * day + 100 * (first + k) + motion, robot.dt))
            rows.append(unit)
            warm = unit.warmth[0] + unit.warmth_spread[0] * rng.standard_normal()
            warmth.append(max(0.0, float(warm)))
    sent = np.stack(ctrl)
    empty = [(0.0, "both")] * len(rows)
    virtual = VirtualRobot(robot, rows, empty, robot.dt, timestep)
    seeds = [1000 * day + i for i in range(len(rows))]
    virtual.reset(sent[:, 0], seeds, np.array(warmth))
    answers = play_virtual(virtual, sent)
    qpos = answers.qpos.astype(np.float32)
    if DAYS[day] == "zero +5 mrad":  # of the first joint, of an encoder that the servo does not use
        qpos[:, :, 0] += 5e-3
    played = []
    for k in range(len(units)):
        logs = []
        for motion in range(MOTIONS):
            i = k * MOTIONS + motion
            meta = SequenceMeta("arm", f"v{first + k}", f"d{day}m{motion}", 0.0, virtual=True)
            log = Sequence(meta, robot.joint_names, robot.dt, sent[i], qpos[i], answers.qvel[i])
            logs.append(log)
        played.append(logs)
    return played


def virtual(work: Path, robots: int, form: str) -> None:
    """Draw, simulate, identify and check arms; append a line each to work/FORM.jsonl, resuming."""
    robot = write_arm(work / "arm")
    file = work / f"{form}.jsonl"
    for first in range(len(read_rows(file)), robots, GROUP):
        last = min(first + GROUP, robots)
        units = _draw_units(robot, first, last, form)
        timestep = robot.timestep if form == "right" else None
        days = []  # day → unit → recordings
        for day, what in enumerate(DAYS):
            on_that_day = [changed(unit, what) for unit in units]
            days.append(play(robot, on_that_day, first, day, timestep))
        for k, unit in enumerate(units):
            another = days[SAME][(k + 1) % len(units)]
            append_row(file, _evaluated(robot, unit, [day[k] for day in days], another))
        print(f"{last} of {robots}", flush=True)


def _draw_units(robot: RobotSpec, first: int, last: int, form: str) -> list[Physics]:
    fleet = load_fleet("hard", robot)
    units = []
    for number in range(first, last):
        unit = sample_unit(robot, fleet.distributions, fleet.seed, 1 + number)
        if form != "wrong":
            unit = replace(unit.only(RIGHT), friction_asymmetry=0 * unit.friction)
        if form == "right":
            steps = np.ceil(unit.delay / robot.timestep - 1e-9)
            unit = replace(unit, delay=steps * robot.timestep)
        units.append(unit)
    return units


def _evaluated(
    robot: RobotSpec, unit: Physics, days: list[list[Sequence]], another: list[Sequence]
) -> Row:
    """Identify one arm and check it on every day."""
    began = time.monotonic()
    train = days[TRAIN]
    val = days[VAL][:VALIDATION_MOTIONS]
    fresh = days[VAL][VALIDATION_MOTIONS:]
    options = IdentifyOptions(windows=WINDOWS, table=False, nthread=1)
    fit = identify(train, robot, val, options=options)
    mine = estimate_uncertainty(fit.robot, train, val, fit.covariance, nthread=1)
    error = absolute_errors(fit.robot, fresh)
    said = {}
    for what, logs in [*zip(DAYS[SAME:], days[SAME:], strict=True), (ANOTHER, another)]:
        found = drift(fit.robot, mine, logs, 1)
        said[what] = {"verdict": found.verdict, "moved": moved_numbers(found)}
    return {
        "z": _deviations(robot, unit, mine, fit.std),
        "inside": list(shares_inside(error, mine).values()),
        "alone": list(shares_by_parameters(error, mine).values()),
        "said": said,
        "seconds": time.monotonic() - began,
    }


def _deviations(
    robot: RobotSpec,
    unit: Physics,
    mine: ParameterUncertainty,
    printed: dict[str, dict[str, float]],
) -> dict[str, dict[str, list[float]]]:
    """Return the deviations from the truth in standard errors: kind → field → joints."""
    op = robot.operated_index
    none = 0.0 * op
    truth = {
        "kp": robot.servo.kp[op] * unit.kp_scale * unit.kt_scale,
        "damping": ARM_DAMPING + unit.damping,
        "frictionloss": ARM_FRICTION + unit.friction,
        "delay": unit.delay + none,
        "armature": ARM_ARMATURE + none,
        "offset": none,
    }
    z: dict[str, dict[str, list[float]]] = {kind: {f: [] for f in truth} for kind in KINDS}
    for i, joint in enumerate(robot.operated):
        estimate, covariance = mine.si(joint)
        for field, true in truth.items():
            k = mine.fields.index(field)
            stored = float(np.sqrt(covariance[k, k]))
            away = estimate[field] - float(true[i])
            z["printed"][field].append(away / printed[joint][field])
            z["stored"][field].append(away / stored)
    return z


def absolute_errors(robot: RobotSpec, logs: list[Sequence]) -> np.ndarray:
    """Return |error| of the operated joints in all rows of the rollouts but the first, (rows,
    n).
    """
    errors = []
    for log, simulated in zip(logs, replay(logs, robot), strict=True):
        errors.append(np.abs(simulated.qpos - log.qpos)[1:, robot.operated_index])
    return np.concatenate(errors)


def shares_inside(error: np.ndarray, mine: ParameterUncertainty) -> dict[str, float]:
    """Return joint → share of the errors (rows, n) rad inside the 90 % band."""
    shares = {}
    for i, (joint, known) in enumerate(mine.joints.items()):
        shares[joint] = float((error[:, i] <= known.residual_p90).mean())
    return shares


def shares_by_parameters(error: np.ndarray, mine: ParameterUncertainty) -> dict[str, float]:
    """Return joint → share of the errors within what the uncertain parameters alone explain."""
    shares = {}
    for i, (joint, known) in enumerate(mine.joints.items()):
        shares[joint] = float((error[:, i] <= NORMAL_90 * known.parameter_rms).mean())
    return shares


def moved_numbers(found: Drift) -> list[tuple[str, str, float, float]]:
    """Return joint, field, change and change in standard errors of the numbers that moved."""
    return [(m.joint, m.field, m.by, m.sigmas) for m in found.moved]


# ---- a real robot


def real(folder: Path, day: Path, other: Path, work: Path) -> None:
    """Evaluate bands and verdicts of a robot, identified from the training set of the first day."""
    data = Dataset(day)
    parts = split_entries(data, ())
    train = data.sequences(parts["train"])
    val = data.sequences(parts["val"])
    test = data.sequences(parts["test"])
    robot, mine = _with_uncertainty(folder, train, val, work)
    error = absolute_errors(robot, test)
    inside = shares_inside(error, mine)
    alone = shares_by_parameters(error, mine)
    bands = {joint: known.residual_p90 for joint, known in mine.joints.items()}
    all_inside = float((error <= [*bands.values()]).mean())
    lines = []
    for joint, band in bands.items():
        shares = (f"{100 * share:.0f} %" for share in (inside[joint], alone[joint]))
        lines.append((joint, f"{1000 * band:.1f}", *shares))
    lines.append(("all joints", "", f"{100 * all_inside:.1f} %", ""))
    columns = ("test motions", "band, mrad", "samples inside", "inside by the parameters alone")
    print_table(columns, lines)
    there = Dataset(other)
    later = there.sequences(there.entries)
    verdicts = []
    for name, logs in _parts_of_days(train, val + test, later).items():
        began = time.monotonic()
        found = drift(robot, mine, logs)
        line = {
            "what": name,
            "recordings": len(logs),
            "seconds": found.seconds,
            "verdict": found.verdict,
            "moved": moved_numbers(found),
            "aside": [a.recording for a in found.against],
            "took": time.monotonic() - began,
        }
        verdicts.append(line)
        print(f"{name}: {'; '.join([found.verdict, *_moves(found)])}", flush=True)
    for day_name in ("first day", "other day"):
        said = [line["verdict"] for line in verdicts if str(line["what"]).startswith(day_name)]
        for verdict, count in Counter(said).items():
            print(f"{day_name}: {verdict}, {count} of {len(said)}", flush=True)
    joints = {}
    for joint, known in mine.joints.items():
        joints[joint] = (known.parameter_rms, known.residual_rms, known.residual_p90)
    facts = {
        "inside": inside | {"every joint": all_inside},
        "alone": alone,
        "drift": verdicts,
        "joints": joints,
    }
    (work / "real.json").write_text(json.dumps(facts, indent=1))


def _with_uncertainty(
    folder: Path, train: list[Sequence], val: list[Sequence], work: Path
) -> tuple[RobotSpec, ParameterUncertainty]:
    """Return an identified robot with its uncertainty, which is estimated if it has none."""
    robot = load_robot(folder)
    stored = ParameterUncertainty.load(robot)
    if stored is not None:
        return robot, stored
    save_robot(robot, work / "robot")
    robot = load_robot(work / "robot")
    mine = estimate_uncertainty(robot, train, val)
    mine.save(work / "robot")
    return robot, mine


def _parts_of_days(
    fitted: list[Sequence], never_fitted: list[Sequence], later: list[Sequence]
) -> dict[str, list[Sequence]]:
    """Return the recordings that are checked together, by their name."""
    parts = {}
    for i in range(2):
        parts[f"first day, never fitted, half {i + 1}"] = never_fitted[i::2]
    for i in range(2):
        parts[f"first day, fitted, half {i + 1}"] = fitted[i::2]
    for i in range(4):
        parts[f"other day, quarter {i + 1}"] = later[i::4]
    return parts


def _moves(found: Drift) -> list[str]:
    texts = []
    for joint, field, change, sigmas in moved_numbers(found):
        moved = f"{1000 * change:+.0f} ms" if field == "delay" else f"{change:+.3g}"
        texts.append(f"{joint}: {field} {moved} ({sigmas:+.1f} standard errors)")
    return texts


# ---- tables


def table(work: Path) -> None:
    """Print the tables of the virtual arms in Markdown."""
    for form in FORMS:
        rows = read_rows(work / f"{form}.jsonl")
        if not rows:
            continue
        print(f"\n{len(rows)} VIRTUAL arms, form {form}")
        _print_deviations(rows)
        for name in ("inside", "alone"):
            print(f"\nsamples {name}: {100 * np.mean([row[name] for row in rows]):.1f} %")
        _print_days(rows)


def _print_deviations(rows: list[Row]) -> None:
    """Print the coverage of both kinds of standard errors, by field."""
    lines = []
    for field in rows[0]["z"]["printed"]:
        shares = []
        medians = []
        for kind in KINDS:
            z = np.abs(np.concatenate([row["z"][kind][field] for row in rows]))
            shares.append(f"{100 * np.mean(z < NORMAL_90):.0f} %")
            medians.append(f"{np.median(z):.2f}")
        lines.append((field, *shares, *medians))
    columns = ["number"]
    columns += [f"in 90 %, {kind}" for kind in KINDS]
    columns += [f"median |z|, {kind}" for kind in KINDS]
    print_table(columns, lines)


def _print_days(rows: list[Row]) -> None:
    """Print the verdicts of each day, and how often the number that was changed is named."""
    lines = []
    for what in rows[0]["said"]:
        said = [row["said"][what] for row in rows]
        count = Counter(one["verdict"] for one in said)
        cells = [what, count["same"], count["drifted"], count["contradictory"], ""]
        if what in MOVED_FIELD:
            named = 0
            for one in said:
                named += any(field == MOVED_FIELD[what] for _, field, *_ in one["moved"])
            cells[-1] = named
        lines.append(cells)
    columns = ("day", "same", "drifted", "contradictory", "the right number named")
    print_table(columns, lines)


def main() -> None:
    """Run one part."""
    parser = command_line(__doc__)
    parser.add_argument("what", choices=("virtual", "real", "table"))
    parser.add_argument("paths", nargs="+", type=Path)
    parser.add_argument("--robots", type=int, default=100)
    parser.add_argument("--form", choices=FORMS, default="wrong")
    args = parser.parse_args()
    args.paths[-1].mkdir(parents=True, exist_ok=True)
    if args.what == "virtual":
        virtual(args.paths[0], args.robots, args.form)
    elif args.what == "real":
        real(*args.paths)
    else:
        table(args.paths[0])


if __name__ == "__main__":
    main()
