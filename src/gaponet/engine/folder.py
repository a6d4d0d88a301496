"""What a user of another engine takes along: facts.json, robot.xml, the action term and, of a model, delta.pt2."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from gaponet.engine import action_term
from gaponet.engine.facts import mjcf_text, simulator_facts
from gaponet.files import write_text, writing
from gaponet.model.artifact import GapModel
from gaponet.robot import RobotSpec

TERM = "gaponet_action.py"
KIND = "engine"


def export_simulator(robot: RobotSpec, folder: Path, dt: float | None = None, payload_mass: float = 0.0) -> None:
    """Write the simulator of a robot: facts.json, robot.xml with its servos, and the action term's file.

    Args:
        folder: Where to.
        dt: Control period, s; default the robot's.
        payload_mass: In each hand, kg.
    """
    _write(simulator_facts(robot, dt or robot.dt, payload_mass), robot, folder)


def export_model(model: GapModel, run: Path, folder: Path, payload_mass: float = 0.0) -> float:
    """Write a model's simulator, as export_simulator does, and the model as a torch.export program.

    Returns:
        Largest difference between program and artifact, rad.

    Raises:
        ModelError: The simulator does not lie beside the model, the payload is beyond those trained on, the model is
            one that DeltaStep is not for, or the program differs by more than 1e-5 rad.
    """
    from gaponet.engine.program import export_program

    model.require_payload(payload_mass)
    robot = model.simulator()
    rates = model.card.get("dt") or [robot.dt]
    dt = robot.dt if any(abs(rate / robot.dt - 1) < 0.02 for rate in rates) else rates[0]
    with writing(folder, KIND):
        difference = export_program(model, run, folder)
        past = {"depth": (model.config.history - 1) * model.config.stride + 1, "parity_rad": difference}
        facts = simulator_facts(robot, dt, payload_mass) | {
            "model": past,
            "payload_seen": model.card.get("payload_seen"),
        }
        _write(facts, robot, folder)
    return difference


def _write(facts: dict[str, object], robot: RobotSpec, folder: Path) -> None:
    text = mjcf_text(robot, float(facts["dt"]), float(facts["payload_mass"]))  # type: ignore[arg-type]
    with writing(folder, KIND):
        write_text(folder / action_term.ROBOT, text)
        shutil.copyfile(action_term.__file__, folder / TERM)
        write_text(folder / action_term.FACTS, json.dumps(facts, indent=1, ensure_ascii=False) + "\n")
