"""gaponet demo: the paper in small, from VIRTUAL robots to Figure 3 and Table 1, in one command."""

from __future__ import annotations

import contextlib
import sys
import time
from importlib.util import find_spec
from pathlib import Path

from gaponet import api
from gaponet.base.errors import UsageError
from gaponet.base.progress import progress_bar, progress_bars
from gaponet.cli.experiment import share_bar, show_paper_result
from gaponet.cli.options import Json
from gaponet.cli.out import Out, writes

FLEET = "firm"
RECIPE = "demo"
NEEDED_MODULES = ("torch", "onnx", "onnxruntime", "matplotlib", "jinja2")


@writes("demo")
def demo(out: Path = Path("demo_run"), json: Json = False) -> None:
    """Run the paper's experiment in small, on VIRTUAL robots, in minutes.

    It records three units of an H1-2 and an unseen fourth with 0 and 3 kg, shows how far the simulator is from them,
    identifies the robot, trains GAPONet and an MLP on three units, and measures both on the fourth. Lengths are counted
    in control steps, so that every machine gets the same result. It takes four minutes on two cores; an interrupted
    demo continues.

    Args:
        out: Folder for the dataset and the experiment.
    """
    if any(find_spec(module) is None for module in NEEDED_MODULES):
        raise UsageError("the demo trains and draws: pip install 'gaponet[train,report]'")
    from gaponet.api.paper import paper_experiment
    from gaponet.experiments.paper.options import DEMO

    began = time.monotonic()
    screen = Out(json)
    dataset = out / "dataset"
    experiment = out / "experiment"
    with contextlib.redirect_stdout(sys.stderr if json else sys.stdout):
        screen.say("Nothing below says anything about real robots: all are VIRTUAL.")
        command = f"gaponet collect --fleet {FLEET} --recipe {RECIPE} --out {dataset}"
        screen.say(f": three robots and an unseen fourth, 0 and 3 kg  ({command})", "1 Record")
        with progress_bar("recordings") as update:
            api.collect(out=dataset, robot="h1_2", fleet=FLEET, recipe=RECIPE, progress=update)
        screen.say(f": how far is the simulator?  (gaponet gap {dataset})", "2 Measure the gap")
        show_gap_by_payload(screen, dataset)
        screen.say(
            f": GAPONet and an MLP on three robots, both measured on the fourth  (gaponet experiment paper {dataset} "
            f"--out {experiment})",
            "3 The paper's experiment, in small",
        )
        result = paper_experiment(
            dataset, out=experiment, options=DEMO, open_bar=share_bar, open_bars=progress_bars
        )
        shown = ("figure3_labels", "table1_labels", "claims_labels")
        show_paper_result(screen, result, shown)
        screen.say(f"the page: {result.page}  ({time.monotonic() - began:.0f} s in all)")
        screen.next(f"gaponet experiment paper {dataset} --out paper_run: all methods, a night")
    screen.result({"page": str(result.page), "sentences": result.sentences})


def show_gap_by_payload(screen: Out, dataset: Path) -> None:
    """Print the error of the nominal simulator by payload."""
    with progress_bar("gap") as update:
        gap = api.gap(str(dataset), progress=update)
    by_payload = gap.methods["nominal"]["by_payload"]
    rows = [
        [f"{float(mass):g} kg", f"{1e3 * by_payload[mass]['mpjae']:.2f}"]
        for mass in sorted(by_payload, key=float)
    ]
    screen.table("Nominal simulator, VIRTUAL robots", ["payload in each hand", "MPJAE, mrad"], rows)
