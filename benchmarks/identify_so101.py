"""What named causes leave of the real SO-101's gap: docs/results/identify_so101.md.

    python benchmarks/identify_so101.py DATASET WORK            # fits (minutes), then validation motions
    python benchmarks/identify_so101.py DATASET WORK --test     # the test motions, looked at once
    python benchmarks/identify_so101.py DATASET WORK --page     # tables of both
    python benchmarks/identify_so101.py DATASET WORK --recover  # a simulated arm with known servos: what comes back

DATASET: gaponet import of the public logs. Whole motions in free run, 5 arm joints, ± standard error over motions.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from gaponet.data.sequence import Sequence
from gaponet.data.split import split_entries
from gaponet.data.store import Dataset
from gaponet.metrics import horizon, runs, standard_error
from gaponet.robot import IDENTIFIED, RobotSpec, Table, load_robot
from gaponet.robot_folder import save_robot
from gaponet.sim.identify import Identified, identify
from gaponet.sim.replay import replay
from gaponet.sim.touching import tip_heights

KNOWN = {"kp": 15.0, "damping": 1.1, "frictionloss": 0.1, "armature": 0.028, "delay": 0.006, "stribeck": 0.1,
         "stribeck_speed": 0.08, "friction_motor": 0.1}  # fmt: skip
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
            "horizon": {k: 1e3 * v["mpjae"] for k, v in horizon(done).items()},
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


def recover(train: list[Sequence], held: list[Sequence]) -> None:
    """Play the recorded commands on a simulated arm of known servos on a known table; identify it from that."""
    nominal = load_robot("so101")
    arm = replace(nominal.with_servos(dict.fromkeys(nominal.operated, KNOWN)), table=Table(-0.0405, 0.2, 2000.0))
    played = []
    for part in (train, held):
        twins = replay(part, arm)
        played.append([replace(s, qpos=t.qpos, qvel=t.qvel) for s, t in zip(part, twins, strict=True)])
    fit = identify(played[0], nominal, played[1], progress=tell)
    print(json.dumps(facts(fit)), fit.robot.table)
    for j, i in zip(nominal.operated, nominal.operated_index, strict=True):
        values = {f: float(getattr(fit.robot, f)[i]) for f in ("kp", *IDENTIFIED)}
        print(j, {f: f"{values[f]:.4g} ± {fit.std[j].get(f, np.nan):.2g} ({values[f] / v - 1:+.1%})"
                  for f, v in KNOWN.items()}, f"offset {values['offset']:.4f}, zero {values['zero']:.4f}")  # fmt: skip


def main() -> None:
    """Fit, then judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--test", action="store_true")
    parser.add_argument("--recover", action="store_true")
    parser.add_argument("--page", action="store_true", help="print the tables of what was measured")
    args = parser.parse_args()
    if args.page:
        page(args.work)
        return
    args.work.mkdir(parents=True, exist_ok=True)
    data = Dataset(args.dataset)
    parts = {name: data.sequences(entries) for name, entries in split_entries(data).items()}
    if args.recover:
        recover(parts["train"], parts["val"])
        return
    part = "test" if args.test else "val"
    found = rows(fitted(args.work, parts["train"], parts["val"]), parts[part])
    (args.work / f"{part}.json").write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
