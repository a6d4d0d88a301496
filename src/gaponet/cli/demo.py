"""gaponet demo: logs → dataset → gap → identification → evaluation → report, in one command; a network on top."""

from __future__ import annotations

import contextlib
import sys
import time
from importlib.util import find_spec
from pathlib import Path

from gaponet import api
from gaponet.base.errors import ModelError, UsageError
from gaponet.base.progress import progress_bar
from gaponet.cli.options import Json
from gaponet.cli.out import Out, writes
from gaponet.cli.show import show_methods
from gaponet.nn.training.config import PretrainingConfig, TrainConfig
from gaponet.report.verdict import verdict
from gaponet.report.view.gl import prepare
from gaponet.robot.spec import load_robot, robot_argument

# Many small rounds: minutes, not hours.
QUICK = PretrainingConfig(rounds=12, num_envs=128, steps=300, gradient_steps=200)


@writes("demo")
def demo(
    data: Path | None = None, robot: str = "h1_2", out: Path = Path("demo_run"), budget: str = "60s",
    network: str = "40s", json: Json = False,
) -> None:  # fmt: skip
    """Run all steps in minutes, on VIRTUAL robots or on your logs.

    Args:
        data: Folder of real logs; default: logs collected from virtual H1-2 robots here and now.
        robot: Robot name or folder.
        out: Folder for dataset, robot, run and report; an interrupted demo continues there.
        budget: Time of the searches of identification.
        network: Training time of a network on top of the identified robot.
    """
    if any(
        find_spec(module) is None
        for module in ("torch", "onnx", "onnxruntime", "matplotlib", "jinja2")
    ):
        raise UsageError("the demo trains and draws: pip install 'gaponet[train,report]'")
    prepare()  # before mujoco is imported
    from gaponet.cli.identify import identify
    from gaponet.report.report import write_report
    from gaponet.report.view.picture import portrait

    screen, began = Out(json), time.monotonic()
    dataset, identified, run = out / "dataset", out / "robot", out / "network"
    with contextlib.redirect_stdout(
        sys.stderr if json else sys.stdout
    ):  # stdout is the evaluation's
        screen.say(
            f": how far is the simulator from the robot?  (gaponet gap {dataset})", "1 Measure"
        )
        holdout = _make_dataset(dataset, data, robot, screen)
        with progress_bar("gap") as update:
            gap = api.gap(str(dataset), robot=robot, progress=update)
        show_methods(screen, gap.to_dict(), ("joint",))
        for sentence in verdict(gap.methods):
            screen.say(sentence)
        screen.say(
            f": which causes explain that?  (gaponet identify {dataset} --out {identified})",
            "2 Identify",
        )
        if not (identified / "robot.toml").is_file():
            identify(str(dataset), identified, budget=budget, robot=robot, holdout_units=holdout)
        words = f"gaponet train {dataset} --model gaponet --robot {robot_argument(identified)} --out {run}"
        screen.say(f": does a network find more?  ({words})", "3 Use")
        try:
            with progress_bar("training gaponet") as update:
                api.train(
                    str(dataset), out=run, budget=network, config=TrainConfig(pretraining=QUICK), robot=identified,
                    holdout_units=holdout, resume=(run / "checkpoint.pt").is_file(), progress=update,
                )  # fmt: skip
        except ModelError:  # a machine with much other work
            screen.say(
                f"{network} were over before a network learned anything; --network 5m gives it more",
                "",
                "yellow",
            )
            run = identified
        with progress_bar("evaluating") as update:
            result = api.evaluate(run, str(dataset), progress=update).to_dict()
        show_methods(screen, result, ("joint", "payload"))
        with progress_bar("report") as update:
            path = write_report(run, progress=update, picture=portrait)
        for sentence in verdict(result["methods"]):
            screen.say(sentence)
        screen.say(f"report: {path}  ({time.monotonic() - began:.0f} s in all)")
        view = f"gaponet view {dataset} --robot {robot_argument(identified)}"
        screen.next(f"gaponet export {identified} --to mjcf; {view}")
    screen.result(result)


def _make_dataset(path: Path, data: Path | None, robot: str, screen: Out) -> tuple[str, ...]:
    """Import logs or collect from the virtual fleet; returns the units to hold out of training."""
    from gaponet.cli.collect import collect
    from gaponet.cli.logs import import_logs

    if data is not None:
        import_logs(data, robot, unit_id="lab", payload_mass=0.0, out=path)
        return ()
    if load_robot(robot).name != "h1_2":
        raise UsageError(
            f"the embedded virtual robots are H1-2; for {robot} give logs with --data DIR"
        )
    screen.say(
        "No --data given: collecting from VIRTUAL H1-2 robots; nothing below says anything about real ones."
    )
    collect(robot=robot, fleet="easy", recipe="demo", out=path)
    return ("virtual-4",)
