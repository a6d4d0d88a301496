"""What named causes leave of the real SO-101's gap: docs/results/identify_so101.md.

    python benchmarks/identify_so101.py DATASET WORK            # fits (minutes), then validation motions
    python benchmarks/identify_so101.py DATASET WORK --test     # the test motions, looked at once
    python benchmarks/identify_so101.py DATASET WORK --page     # tables of both
    python benchmarks/identify_so101.py DATASET WORK --recover  # simulated arms with known servos: what comes back

DATASET: gaponet import of the public logs. Whole motions in free run, 5 arm joints, ± standard error over motions.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.data.sequence import Sequence
from gaponet.data.split import split_entries
from gaponet.data.store import Dataset
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import RobotSpec, Table, load_robot
from gaponet.sim.metrics import runs, standard_error, summary
from gaponet.sim.replay import replay
from gaponet.sysid.fit import Identified
from gaponet.sysid.identify import identify
from gaponet.sysid.table_contact import tip_heights

KNOWN = {"kp": 15.0, "damping": 1.1, "frictionloss": 0.1, "armature": 0.028, "delay": 0.006, "stribeck": 0.1,
         "stribeck_speed": 0.08, "friction_motor": 0.1}  # fmt: skip
COUNT = 2 * np.pi / 4096  # rad, of the encoder
TURNING = ("shoulder_pan", "wrist_roll")  # gravity does not see their zeros
SMALL = {"delay": 1e-3, "offset": 1e-3}  # s and rad that count as 5 %
LOW = -0.014  # m: where a tip may touch, by forward kinematics without zeros


def fitted(folder: Path, train: list[Sequence], held: list[Sequence]) -> dict[str, RobotSpec]:
    """The simulators of the table; each fit once, kept in WORK."""
    found = {"nominal": load_robot("so101")}
    for name, terms in (("classic", ()), ("law", ("stribeck", "load"))):
        place = folder / name
        if not (place / "robot.toml").is_file():
            began = time.monotonic()
            fit = identify(train, load_robot("so101"), held, terms=terms, progress=tell)
            save_robot(fit.robot, place)
            told = facts(fit) | {"seconds": time.monotonic() - began}
            (folder / f"{name}.json").write_text(json.dumps(told, indent=1) + "\n")
        robot = load_robot(place)
        found[name] = replace(robot, table=None, zero=np.zeros(len(robot.joint_names)))
        found[f"{name} + table"] = robot
    return found


def tell(done: float, total: float, note: str) -> None:
    """A line now and then."""
    if done % 20 == 0:
        print(f"{done:.0f} of {total:.0f}: {note}", flush=True)


def facts(fit: Identified) -> dict[str, object]:
    """Numbers of a fit."""
    terms = {t.name: {"mrad": 1e3 * t.gain[0], "standard_error": 1e3 * t.gain[1], "kept": t.kept} for t in fit.tried}
    touch = fit.touch
    table = None if touch is None else {
        "before": (1e3 * touch.before).tolist(), "after": (1e3 * touch.after).tolist(), "kept": touch.kept,
        "motions": touch.motions,
    }  # fmt: skip
    return {"terms": terms, "table": table, "std": fit.std, "warnings": fit.warnings}


def rows(simulators: dict[str, RobotSpec], sequences: list[Sequence]) -> list[dict[str, object]]:
    """One row per simulator: all, in contact and out of it, by joint, horizon and motion, mrad."""
    robot = load_robot("so101")
    heights = tip_heights(sequences, robot)
    low = [(h < LOW)[1:] for h in heights]
    out = []
    for name, simulator in simulators.items():
        done = runs(sequences, [t.qpos for t in replay(sequences, simulator, lock_idle=True)], robot)
        size = [1e3 * np.abs(r.error.astype(float)) for r in done]
        motions = np.array([x.mean(dtype=float) for x in size])
        out.append({
            "simulator": name, "mrad": float(motions.mean()), "standard_error": standard_error(motions),
            "low": float(np.concatenate([x[m] for x, m in zip(size, low, strict=True)]).mean()),
            "free": float(np.concatenate([x[~m] for x, m in zip(size, low, strict=True)]).mean()),
            "joints": dict(zip(robot.operated, np.mean([x.mean(axis=0) for x in size], axis=0).tolist(), strict=True)),
            "horizon": {k: 1e3 * v["mpjae"] for k, v in summary(done, robot)["by_horizon"].items()},
            "motions": dict(zip((s.meta.motion for s in sequences), motions.tolist(), strict=True)),
        })  # fmt: skip
        print(json.dumps(out[-1]), flush=True)
    return out


def page(work: Path) -> None:
    """The tables of docs/results/identify_so101.md, from what was measured."""
    found = {part: json.loads((work / f"{part}.json").read_text()) for part in ("val", "test")}
    lines = [
        "| simulator | validation, mrad | tip low | free | test, mrad | of nominal | tip low | free |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    nominal = found["test"][0]["mrad"]
    for val, test in zip(found["val"], found["test"], strict=True):
        cells = [f"{x['mrad']:.2f} ± {x['standard_error']:.2f}" for x in (val, test)]
        low = [[f"{x['low']:.2f}", f"{x['free']:.2f}"] for x in (val, test)]
        row = [test["simulator"], cells[0], *low[0], cells[1], f"{test['mrad'] / nominal:.2f}", *low[1]]
        lines.append(f"| {' | '.join(row)} |")
    for title, key in (("joint", "joints"), ("after, s", "horizon"), ("motion", "motions")):
        names = list(found["test"][0][key])
        lines += ["", f"Test, mrad, by {title.split(',')[0]}:", ""]
        lines += [f"| {title} | {' | '.join(x['simulator'] for x in found['test'])} |"]
        lines += ["| --- |" + " ---: |" * len(found["test"])]
        lines += [f"| {n} | {' | '.join(f'{x[key][n]:.2f}' for x in found['test'])} |" for n in names]
    print("\n".join(lines))


def drawn(robot: RobotSpec, rng: np.random.Generator) -> RobotSpec:
    """An arm of servos and a table that nobody chose."""
    servos = {}
    for joint in robot.operated:
        kp = float(np.exp(rng.uniform(np.log(10), np.log(30))))
        servos[joint] = {
            "kp": kp, "damping": kp * rng.uniform(0.05, 0.1), "frictionloss": kp * rng.uniform(0.003, 0.03),
            "armature": float(np.exp(rng.uniform(np.log(0.012), np.log(0.05)))), "delay": rng.uniform(0, 0.02),
            "offset": rng.normal(0, 0.01), "stribeck": kp * rng.uniform(0.003, 0.015),
            "stribeck_speed": rng.uniform(0.03, 0.15), "friction_motor": rng.uniform(0.02, 0.15),
            "zero": 0.0 if joint in TURNING else rng.normal(0, 0.01),
        }  # fmt: skip
    table = Table(
        rng.uniform(-0.046, -0.035), rng.uniform(0.1, 0.4), float(np.exp(rng.uniform(np.log(1e3), np.log(5e3))))
    )
    return replace(robot.with_servos(servos), table=table)


def recorded(sequences: list[Sequence], arm: RobotSpec, rng: np.random.Generator | None) -> list[Sequence]:
    """The recorded commands played on a simulated arm, read as the real one is read (not at all without rng)."""
    out = []
    for s, twin in zip(sequences, replay(sequences, arm), strict=True):
        qpos, qvel = twin.qpos.astype(float), twin.qvel.astype(float)
        if rng is not None:
            qpos = np.round((qpos + 0.1 * COUNT * rng.standard_normal(qpos.shape)) / COUNT) * COUNT
            qvel = np.round((qvel + 0.03 * rng.standard_normal(qvel.shape)) / (50 * COUNT)) * 50 * COUNT
        out.append(replace(s, qpos=qpos.astype(s.qpos.dtype), qvel=qvel.astype(s.qvel.dtype)))
    return out


def recover(work: Path, train: list[Sequence], held: list[Sequence], seeds: list[int]) -> None:
    """Simulated arms identified from the recorded commands: one of KNOWN servos read exactly (seed 0), others drawn."""
    nominal = load_robot("so101")
    for seed in seeds:
        rng = np.random.default_rng(seed) if seed else None
        known = replace(nominal.with_servos(dict.fromkeys(nominal.operated, KNOWN)), table=Table(-0.0405, 0.2, 2000.0))
        arm = known if rng is None else drawn(nominal, rng)
        began = time.process_time()
        fit = identify(recorded(train, arm, rng), nominal, recorded(held, arm, rng), progress=tell)
        back = []
        for joint, i in zip(nominal.operated, nominal.operated_index, strict=True):
            named = [w for w in fit.warnings if w.startswith(f"{joint}: not determined")]
            for field in (*KNOWN, "offset", "zero"):
                true, found = (float(getattr(r, field)[i]) for r in (arm, fit.robot))
                back.append({
                    "joint": joint, "field": field, "true": true, "found": found, "std": fit.std[joint].get(field),
                    "named": any(f" {field} " in w for w in named),
                })  # fmt: skip
        tables = [None if x is None else vars(x) for x in (arm.table, fit.robot.table)]
        told = facts(fit) | {"back": back, "tables": tables, "seconds": time.process_time() - began}
        (work / f"recover_{seed}.json").write_text(json.dumps(told, indent=1) + "\n")
        print(seed, tables, f"{told['seconds']:.0f} s", flush=True)
    recovered(work)


def recovered(work: Path) -> None:
    """The table of what came back, over all arms that were tried."""
    files = sorted(work.glob("recover_*.json"))
    told = [json.loads(f.read_text()) for f in files]
    for title, part in (("KNOWN, read exactly", told[:1]), ("drawn, read as the real one", told[1:])):
        print(f"\n{title}, {len(part)} arms:\n")
        print("| parameter | median deviation | within 5 % | within ± 2 | named | neither |")
        print("| --- |" + " ---: |" * 5)
        rows = [r for t in part for r in t["back"] if r["std"] is not None]
        for field in (*KNOWN, "offset", "all"):
            mine = [r for r in rows if field in (r["field"], "all")]
            if mine:
                print(f"| {field} | {' | '.join(counts(mine))} |")
    print("\n| arm | height, mm | friction | stiffness, N/m | zero of shoulder_lift, mrad |")
    print("| --- |" + " ---: |" * 4)
    for file, t in zip(files, told, strict=True):
        true, found = t["tables"]
        zero = next(r for r in t["back"] if (r["joint"], r["field"]) == ("shoulder_lift", "zero"))
        if found is None:
            print(f"| {file.stem} | not kept |")
            continue
        cells = [
            f"{k * v:.3g} for {k * w:.3g}"
            for k, v, w in (
                *((1e3 if f == "height" else 1.0, found[f], true[f]) for f in ("height", "friction", "stiffness")),
                (1e3, zero["found"], zero["true"]),
            )
        ]
        print(f"| {file.stem} | {' | '.join(cells)} |")


def counts(rows: list[dict[str, Any]]) -> list[str]:
    """Cells of a row: how far off, and how often right, covered by the interval, named, none of the three."""
    off = np.array([r["found"] - r["true"] for r in rows])
    size = np.array([SMALL.get(r["field"], abs(r["true"]) / 20) for r in rows])
    right, covered = np.abs(off) <= size, np.abs(off) <= 2 * np.array([r["std"] for r in rows])
    named = np.array([r["named"] for r in rows])
    share = [f"{100 * np.mean(x):.0f} %" for x in (right, covered, named, ~(right | covered | named))]
    return [f"{5 * np.median(np.abs(off) / size):.1f} %", *share]


def main() -> None:
    """Fit, then judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--test", action="store_true")
    parser.add_argument("--recover", type=int, nargs="*", help="seeds of arms, 0 for the KNOWN one; default 0 to 4")
    parser.add_argument("--page", action="store_true", help="print the tables of what was measured")
    args = parser.parse_args()
    if args.page:
        page(args.work)
        recovered(args.work)
        return
    args.work.mkdir(parents=True, exist_ok=True)
    data = Dataset(args.dataset)
    parts = {name: data.sequences(entries) for name, entries in split_entries(data).items()}
    if args.recover is not None:
        recover(args.work, parts["train"], parts["val"], args.recover or list(range(5)))
        return
    part = "test" if args.test else "val"
    found = rows(fitted(args.work, parts["train"], parts["val"]), parts[part])
    (args.work / f"{part}.json").write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
