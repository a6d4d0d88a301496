"""gaponet demo: logs → dataset → gap → training → evaluation → report, in one command."""

from __future__ import annotations

import contextlib
import sys
import time
from pathlib import Path

from gaponet import api
from gaponet.cli.gap import gap
from gaponet.cli.options import Json
from gaponet.cli.out import Out, writes
from gaponet.cli.train import evaluate
from gaponet.errors import UsageError
from gaponet.model.config import ModelConfig
from gaponet.progress import bar
from gaponet.robot import load_robot
from gaponet.training.config import TrainConfig, WarmStartConfig

QUICK = WarmStartConfig(rounds=12, num_envs=128, steps=300, gradient_steps=200)  # many small rounds: minutes, not hours


@writes("demo")
def demo(
    data: Path | None = None,
    robot: str = "h1_2",
    out: Path = Path("demo_run"),
    budget: str = "210s",
    mlp_budget: str = "60s",
    json: Json = False,
) -> None:
    """Show the whole way in minutes: on your logs, or on an embedded VIRTUAL robot where there are none.

    Args:
        data: Folder of real logs; default: logs collected from virtual H1-2 robots here and now.
        robot: Robot name or folder.
        out: Folder for dataset, runs and report; a demo that was interrupted there is finished.
        budget: Training time of GAPONet.
        mlp_budget: Training time of the MLP baseline.
    """
    from gaponet.data.store import Dataset
    from gaponet.view.portrait import portrait, prepare

    prepare()
    from gaponet.eval.report import write_report

    screen, began = Out(json), time.monotonic()
    with contextlib.redirect_stdout(sys.stderr if json else sys.stdout):  # stdout is the evaluation's
        holdout = _make_dataset(out / "dataset", data, robot, screen)
        dataset = Dataset(out / "dataset")
        gap(str(out / "dataset"), robot=robot)
    for model, limit in ((ModelConfig(), budget), (ModelConfig(kind="mlp"), mlp_budget)):
        run, resume = out / model.kind, (out / model.kind / "checkpoint.pt").is_file()
        config = TrainConfig(model, warm_start=QUICK)
        api.train(dataset, run, limit, config, robot=robot, holdout_units=holdout, resume=resume)
    evaluate(out / "gaponet", str(out / "dataset"), also=(out / "mlp",), robot=robot, json=json)
    with bar("report") as update:
        path = write_report(out / "gaponet", robot=robot, progress=update, picture=portrait)
    screen.say(f"report: {path}  ({time.monotonic() - began:.0f} s in all)")


def _make_dataset(path: Path, data: Path | None, robot: str, screen: Out) -> tuple[str, ...]:
    """Import logs or collect from the virtual fleet; returns the units to hold out of training."""
    if data is not None:
        from gaponet.cli.logs import import_logs

        import_logs(data, robot, unit_id="lab", payload_mass=0.0, out=path)
        return ()
    if load_robot(robot).name != "h1_2":
        raise UsageError(f"the embedded virtual robots are H1-2; for {robot} give logs with --data DIR")
    from gaponet.cli.collect import collect

    screen.say("No --data given: collecting from VIRTUAL H1-2 robots; nothing below says anything about real ones.")
    collect(robot=robot, fleet="easy", recipe="demo", out=path)
    return ("virtual-4",)
