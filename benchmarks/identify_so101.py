"""Error of the real SO-101 by identified causes: docs/results/identify_so101.md.

    python benchmarks/identify_so101.py DATASET WORK            # fits (minutes), then the validation motions
    python benchmarks/identify_so101.py DATASET WORK --test     # the test motions
    python benchmarks/identify_so101.py DATASET WORK --page     # tables of both

DATASET: gaponet import of the public logs. Rollouts over whole motions, 5 arm joints, ± standard error over motions.
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
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.metrics import runs, standard_error, summary
from gaponet.sim.replay import replay
from gaponet.sysid.fit import Identified
from gaponet.sysid.identify import identify
from gaponet.sysid.table_contact import tip_heights

CONTACT_HEIGHT_M = -0.014  # a tip below may touch the table, by forward kinematics without zeros


def fitted(folder: Path, train: list[Sequence], validation: list[Sequence]) -> dict[str, RobotSpec]:
    """Fit the simulators of the table, unless WORK holds them."""
    found = {"nominal": load_robot("so101")}
    for name, terms in (("classic", ()), ("law", ("stribeck", "load"))):
        place = folder / name
        if not (place / "robot.toml").is_file():
            began = time.monotonic()
            fit = identify(train, load_robot("so101"), validation, terms=terms, progress=print_progress)
            save_robot(fit.robot, place)
            result = facts(fit) | {"seconds": time.monotonic() - began}
            (folder / f"{name}.json").write_text(json.dumps(result, indent=1) + "\n")
        robot = load_robot(place)
        found[name] = replace(robot, table=None, zero=np.zeros(len(robot.joint_names)))
        found[f"{name} + table"] = robot
    return found


def print_progress(done: float, total: float, note: str) -> None:
    """Print every twentieth step."""
    if done % 20 == 0:
        print(f"{done:.0f} of {total:.0f}: {note}", flush=True)


def facts(fit: Identified) -> dict[str, object]:
    """Return the tested terms, the table and the standard errors of a fit."""
    terms = {t.name: {"mrad": 1e3 * t.gain[0], "standard_error": 1e3 * t.gain[1], "kept": t.kept} for t in fit.tried}
    touch = fit.touch
    table = None if touch is None else {
        "before": (1e3 * touch.before).tolist(), "after": (1e3 * touch.after).tolist(), "kept": touch.kept,
        "motions": touch.motions,
    }  # fmt: skip
    return {"terms": terms, "table": table, "std": fit.std, "warnings": fit.warnings}


def rows(simulators: dict[str, RobotSpec], sequences: list[Sequence]) -> list[dict[str, object]]:
    """Measure each simulator: all rows, rows with and without contact, by joint, horizon and motion, mrad."""
    robot = load_robot("so101")
    heights = tip_heights(sequences, robot)
    low = [(h < CONTACT_HEIGHT_M)[1:] for h in heights]
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
    """Print the tables of the page from the stored measurements."""
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


def main() -> None:
    """Fit, then measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--test", action="store_true")
    parser.add_argument("--page", action="store_true", help="print the tables of what was measured")
    args = parser.parse_args()
    if args.page:
        page(args.work)
        return
    args.work.mkdir(parents=True, exist_ok=True)
    data = Dataset(args.dataset)
    parts = {name: data.sequences(entries) for name, entries in split_entries(data).items()}
    part = "test" if args.test else "val"
    found = rows(fitted(args.work, parts["train"], parts["val"]), parts[part])
    (args.work / f"{part}.json").write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
