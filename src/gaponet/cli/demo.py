"""gaponet demo: the paper in small on VIRTUAL robots, or with --real the identification of a real
arm."""

from __future__ import annotations

import contextlib
import sys
import time
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from gaponet import api
from gaponet.api.opening import test_motions
from gaponet.api.options import CollectOptions
from gaponet.api.paper import DEMO, paper_experiment
from gaponet.api.results import GapResult
from gaponet.api.start import Step, measure_error, steps_from_logs
from gaponet.base.errors import UsageError
from gaponet.base.installation import install_command
from gaponet.base.progress import progress_bar, progress_bars
from gaponet.cli.experiment import share_bar, show_paper_result
from gaponet.cli.gap import show_steps
from gaponet.cli.options import Flag, Json
from gaponet.cli.out import Out, writes
from gaponet.evaluation.tables import mrad

if TYPE_CHECKING:
    from gaponet import Dataset

FLEET = "firm"
RECIPE = "demo"
NEEDED_MODULES = ("torch", "onnx", "onnxruntime")
REAL_ROBOT = "so101"


@writes("demo")
def demo(out: Path = Path("demo_run"), real: Flag = False, json: Json = False) -> None:
    """The paper in small on VIRTUAL robots; --real identifies a real arm.

    The experiment records three units of an H1-2 and an unseen fourth with 0 and 3 kg, shows how
    far the simulator is from them, identifies the robot, trains GAPONet and an MLP on three units,
    and measures both on the fourth. Lengths are counted in control steps, so that every machine
    gets the same result. It takes seven minutes on two cores; an interrupted demo continues.

    With --real it takes the public recordings of a real SO-101 arm, measures the simulator's error,
    identifies the arm, draws what each cause removes, and exports the result for MuJoCo. It needs
    no torch. The recordings come from the network once (9 MB), or from the folder in the
    environment variable GAPONET_DATA.

    Args:
        out: Folder for datasets and results.
        real: Identify a real arm.
    """
    screen = Out(json)
    with contextlib.redirect_stdout(sys.stderr if json else sys.stdout):
        run = identify_real_arm if real else run_paper_in_small
        result = run(screen, out)
    screen.result(result)


def identify_real_arm(screen: Out, out: Path) -> dict[str, object]:
    """Identify the SO-101 of the public recordings; return errors and places for --json."""
    from gaponet.api.share import public_recordings  # it imports MuJoCo, which is too early above

    began = time.monotonic()
    with progress_bar("fetching") as update:
        logs, origin = public_recordings(update)
    screen.say(f"{origin}.", "Recordings: ")
    folder = out / REAL_ROBOT
    robot = folder / "identified"
    unit = {"unit_id": REAL_ROBOT, "payload_mass": "0"}
    steps = steps_from_logs(logs, REAL_ROBOT, unit, folder, {}, "mjcf")
    read, _, measure, fit, causes, export, _ = steps

    _announce(screen, 1, read)
    dataset = _imported(logs, folder / "data")
    motions = test_motions(dataset)
    screen.say(
        f": the simulator gets the commands alone, on {len(motions)} motions that stay out of the "
        f"fit  ({measure.line} takes all {len(dataset)} recordings)",
        f"2 {measure.title}",
    )
    with progress_bar("gap") as update:
        nominal = api.gap(dataset, motions=motions, progress=update)
    _show_errors_by_joint(screen, nominal)
    _announce(screen, 3, fit)
    with progress_bar("identifying") as update:
        api.identify(dataset, out=robot, progress=update)
    _announce(screen, 4, causes)
    with progress_bar("gap") as update:
        after = api.gap(dataset, run=robot, progress=update)
    show_steps(screen, after.table)
    picture = robot / "gap.png"
    screen.say(f"picture: {picture}")
    _announce(screen, 5, export)
    with progress_bar("exporting") as update:
        exported = api.export_robot(robot, to="mjcf", progress=update)
    screen.say(
        f"{mean_error(after, 'nominal')} → {mean_error(after, 'identified')} mrad on motions that "
        f"the fit never saw ({time.monotonic() - began:.0f} s in all); the robot for MuJoCo: "
        f"{exported.path}",
        "Result: ",
    )
    screen.next(f"gaponet robot show {robot}; for your robot gaponet start MODEL LOGS")
    return {
        "origin": origin,
        "nominal_rad": after.methods["nominal"]["mpjae"],
        "identified_rad": after.methods["identified"]["mpjae"],
        "motions": motions,
        "robot": str(robot),
        "picture": str(picture),
        "export": str(exported.path),
    }


def _imported(logs: Path, out: Path) -> Dataset:
    """Import the recordings of the SO-101."""
    with progress_bar("importing") as update:
        imported = api.import_logs(
            logs, robot=REAL_ROBOT, out=out, unit_id=REAL_ROBOT, payload_mass=0.0, progress=update
        )
    return imported.dataset


def _show_errors_by_joint(screen: Out, nominal: GapResult) -> None:
    """Print the error of the nominal simulator by joint."""
    by_joint = nominal.methods["nominal"]["by_joint"]
    rows = [[joint, mrad(errors["mpjae"])] for joint, errors in by_joint.items()]
    screen.table("Nominal simulator beside the real robot", ["joint", "mean |error|, mrad"], rows)


def _announce(screen: Out, number: int, step: Step) -> None:
    """Print what comes next, and the command that does it."""
    screen.say(f"  ({step.line})", f"{number} {step.title}")


def mean_error(result: GapResult, method: str) -> str:
    """Return the mean |error| of a method, mrad."""
    return mrad(result.methods[method]["mpjae"])


def run_paper_in_small(screen: Out, out: Path) -> dict[str, object]:
    """Run the paper's experiment in small; return page and sentences for --json."""
    if any(find_spec(module) is None for module in NEEDED_MODULES):
        raise UsageError(f"the demo trains networks: {install_command('train')}; --real needs none")
    began = time.monotonic()
    dataset = out / "dataset"
    experiment = out / "experiment"
    screen.say("Nothing below says anything about real robots: all are VIRTUAL.")
    command = f"gaponet collect --fleet {FLEET} --recipe {RECIPE} --out {dataset}"
    screen.say(f": three robots and an unseen fourth, 0 and 3 kg  ({command})", "1 Record")
    with progress_bar("recordings") as update:
        options = CollectOptions(fleet=FLEET, recipe=RECIPE)
        api.collect(out=dataset, robot="h1_2", options=options, progress=update)
    _announce(screen, 2, measure_error(str(dataset)))
    show_gap_by_payload(screen, dataset)
    command = f"gaponet experiment paper {dataset} --out {experiment}"
    screen.say(
        f": GAPONet and an MLP on three robots, both measured on the fourth  ({command})",
        "3 The paper's experiment, in small",
    )
    result = paper_experiment(
        dataset, out=experiment, options=DEMO, open_bar=share_bar, open_bars=progress_bars
    )
    shown = ("figure3_labels", "table1_labels", "claims_labels")
    show_paper_result(screen, result, shown)
    screen.say(f"the page: {result.page}  ({time.monotonic() - began:.0f} s in all)")
    screen.next(f"gaponet experiment paper {dataset} --out paper_run: all methods, a night")
    return {"page": str(result.page), "sentences": result.sentences}


def show_gap_by_payload(screen: Out, dataset: Path) -> None:
    """Print the error of the nominal simulator by payload."""
    with progress_bar("gap") as update:
        gap = api.gap(str(dataset), progress=update)
    by_payload = gap.methods["nominal"]["by_payload"]
    rows = []
    for mass in sorted(by_payload, key=float):
        rows.append([f"{float(mass):g} kg", f"{1e3 * by_payload[mass]['mpjae']:.2f}"])
    screen.table("Nominal simulator, VIRTUAL robots", ["payload in each hand", "MPJAE, mrad"], rows)
