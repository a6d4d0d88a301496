"""Types of every public name, as a user's type checker sees them: `make check` runs mypy on this
file.

It is not a test of pytest, and is never executed.
"""

from pathlib import Path
from typing import assert_type

import mujoco
import numpy as np

import gaponet as gp

robot = gp.load_robot("so101")
assert_type(robot, gp.RobotSpec)
assert_type(gp.__version__, str)
data = gp.Dataset("data")
assert_type(gp.open_dataset("data"), tuple[gp.Dataset, gp.RobotSpec])

with gp.progress_bar("importing") as update:
    imported = gp.import_logs(
        Path("logs"),
        robot="so101",
        out="data",
        unit_id="a",
        payload_mass=0.0,
        options=gp.ImportOptions(time_unit="ms", joint_map={"a1": "elbow"}),
        progress=update,
    )
assert_type(imported, gp.ImportResult)
assert_type(imported.dataset, gp.Dataset)
assert_type(gp.doctor(data), gp.DoctorResult)
assert_type(gp.doctor(data).verdict, str)
assert_type(gp.pair(data, robot=robot), gp.PairResult)
collected = gp.collect(out="data", options=gp.CollectOptions(fleet="firm", recipe="demo"))
assert_type(collected, gp.CollectResult)
further = gp.excite(robot, out="motions", further=True, options=gp.ExciteOptions(minutes=1.0))
assert_type(further, gp.ExciteResult)

assert_type(gp.gap(data), gp.GapResult)
assert_type(gp.gap(data).mpjae, dict[str, float])
assert_type(gp.check("robot", "logs"), gp.CheckResult)
assert_type(gp.replay("rollouts", robot="robot"), gp.ReplayResult)

identified = gp.identify(data, out="robot", options=gp.IdentifyOptions(terms=("stribeck",)))
assert_type(identified, gp.IdentifyResult)
assert_type(identified.robot, gp.RobotSpec)
assert_type(gp.identify_torque(data, out="robot"), gp.TorqueResult)
trained = gp.train(data, out="run", config=gp.TrainConfig(model=gp.ModelConfig(history=4)))
assert_type(trained, gp.TrainResult)
gp.train(data, out="run", budget="1h", options=gp.TrainOptions(model="auto"))
assert_type(trained.model, gp.GapModel)
assert_type(gp.evaluate(trained.model, data), gp.EvalResult)
assert_type(gp.evaluate("run", data).unseen, bool)
assert_type(gp.adapt_robot(robot, "logs", out="today"), gp.AdaptResult)
assert_type(gp.adapt_model("run", data, unit="a"), gp.AdaptResult)

assert_type(gp.export_robot("robot", to="mjcf"), gp.ExportResult)
assert_type(gp.networks(), tuple[gp.NetworkCard, ...])
assert_type(gp.GapModel.load("so101-sage"), gp.GapModel)
assert_type(gp.export_network("run", to="onnx").parity, float | None)
gp.randomization("robot", out="ranges")

sim = gp.AlignedSim(robot)
unladen = gp.AlignedSim(robot, options=gp.AlignedSimOptions(simulator_payload=0.0))
compensator = gp.Compensator(robot)
assert_type(sim, gp.AlignedSim)
assert_type(compensator, gp.Compensator)
follower = gp.Compensator(robot, follow="nominal")
assert_type(gp.apply(robot, mujoco.MjSpec()), gp.Applied)
delta = trained.model.loop().delta(np.zeros(5), np.zeros(5), np.zeros(5), payload_mass=0.0)
options = gp.RunOptions(connection=gp.Connection(port="/dev/ttyACM0"), payload_mass=0.1)
played = gp.run_robot(robot, motion="sweep-elbow_flex", driver="so101", options=options)
assert_type(played, gp.RunResult)
assert_type(played.tracking_error, dict[str, float])
assert_type(played.fault, str)
gp.run_robot("./my_so101", motion=Path("m.csv"), compensate=True, consent=lambda text: True)
classes = (gp.Controller, gp.RemoteRobot, gp.MujocoAligner)


def first_message(error: gp.GAPONetError) -> str:
    return str(error)


absent = gp.no_such_name  # type: ignore[attr-defined]
gp.gap(data, robot)  # type: ignore[call-arg]
gp.gap(data, motion="wave")  # type: ignore[call-arg]
gp.run_robot(robot, "sweep-elbow_flex")  # type: ignore[call-arg]
gp.run_robot(robot, consent=True)  # type: ignore[arg-type]
paper = gp.paper_experiment(data, out="paper_run", options=gp.PaperOptions(seeds=1))
assert_type(paper, gp.PaperResult)
assert_type(paper.page, Path)
