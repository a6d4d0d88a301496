"""GapModel: what ships. A folder with model.onnx (normalisers inside) and card.json; needs onnxruntime, not torch."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.errors import ModelError
from gaponet.model.config import ModelConfig
from gaponet.model.corrector import DeltaCorrector
from gaponet.model.inputs import Infer
from gaponet.robot import RobotSpec

Array = np.ndarray

WEIGHTS, CARD, FORMAT = "model.onnx", "card.json", 1
DT_TOLERANCE = 0.02  # a clock of 49.85 Hz is the 50 Hz it was meant to be


def make_card(config: ModelConfig, robot: RobotSpec, **facts: Any) -> dict[str, Any]:
    """The card of a model: how to feed it, what it was trained on, what it must not be used for.

    Args:
        config: Shape of the model.
        robot: Robot and nominal simulator.
        facts: dt [s], payload_seen [kg], dataset_hash, units, virtual, split, versions and whatever else is known.
    """
    from gaponet.sim.model import model_hash

    return {
        "format": FORMAT,
        "robot": robot.name,
        "joint_names": list(robot.operated),
        "kp": [float(robot.kp[i]) for i in robot.operated_index],
        "kd": [float(robot.kd[i]) for i in robot.operated_index],
        "simulator_hash": model_hash(robot),
        "model": asdict(config),
        "simulator_only": config.asks_simulator,  # a bound to compare with, not for a robot
    } | facts


def write_card(path: Path, card: dict[str, Any]) -> None:
    """JSON at full precision, written whole or not at all."""
    from gaponet.data.store import write_text

    write_text(path, json.dumps(card, indent=1, ensure_ascii=False) + "\n")


def infer_session(path: Path, output: str = "delta") -> Infer:
    """An ONNX file as a function of numpy arrays, on one thread; models with learned points also have "offsets"."""
    try:
        import onnxruntime as ort
        from onnxruntime.capi import onnxruntime_pybind11_state as ort_errors
    except ImportError:
        raise ModelError("onnxruntime is not installed; run: pip install 'gaponet[deploy]'") from None
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        session = ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except (ort_errors.InvalidProtobuf, ort_errors.InvalidGraph, ort_errors.Fail, ort_errors.NoSuchFile) as error:
        raise ModelError(
            f"{path}: not a readable ONNX file ({str(error).splitlines()[0]}); train or copy it again"
        ) from None
    return lambda x: session.run([output], {"x": x})[0]


@dataclass(frozen=True)
class GapModel:
    """A delta-action model and its card. `corrector` puts it into a stepping simulator."""

    path: Path
    card: dict[str, Any]
    config: ModelConfig
    infer: Infer

    @classmethod
    def load(cls, path: str | Path) -> GapModel:
        """Read an artifact, or the artifact of a run folder.

        Raises:
            ModelError: Missing or damaged file, or one written by a newer version.
        """
        folder = Path(path)
        folder = folder / "model" if (folder / "model" / CARD).is_file() else folder
        for name in (CARD, WEIGHTS):
            if not (folder / name).is_file():
                raise ModelError(f"{path}: no {name}; give a run folder of gaponet train, or an artifact folder")
        try:
            card = json.loads((folder / CARD).read_text(encoding="utf-8"))
            known = {f.name for f in fields(ModelConfig)}
            shape: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in card["model"].items()}
            version = int(card["format"])
        except (json.JSONDecodeError, KeyError, ValueError, AttributeError) as error:
            raise ModelError(f"{folder / CARD}: damaged ({error}); restore it or train again") from None
        if version > FORMAT or not set(shape) <= known:
            raise ModelError(f"{folder / CARD}: written by a newer gaponet; upgrade to read it")
        return cls(folder, card, ModelConfig(**shape), infer_session(folder / WEIGHTS))

    def require(self, robot: RobotSpec, dt: float | None = None) -> None:
        """Refuse a robot, simulator, gains or rate the model was not trained on."""
        from gaponet.sim.model import model_hash

        card = self.card
        if card["robot"] != robot.name or tuple(card["joint_names"]) != robot.operated:
            raise ModelError(
                f"{self.path}: made for {card['robot']} with joints {', '.join(card['joint_names'])}; "
                f"this is {robot.name} with {', '.join(robot.operated)}. Use the robot the model was trained for"
            )
        if card["simulator_hash"] != model_hash(robot):
            raise ModelError(
                f"{self.path}: trained in simulator {card['simulator_hash']}, but robot '{robot.name}' is now "
                f"{model_hash(robot)} (MJCF, gains or limits changed); train again or use the old robot folder"
            )
        rates = card.get("dt", [])
        if dt is not None and rates and min(abs(dt / r - 1) for r in rates) > DT_TOLERANCE:
            seen = ", ".join(f"{1 / r:.1f}" for r in rates)
            raise ModelError(
                f"{self.path}: trained at {seen} Hz, asked to run at {1 / dt:.1f} Hz; run the loop at a trained rate, "
                "or train on logs of this rate"
            )

    def corrector(self, robot: RobotSpec) -> DeltaCorrector:
        """For sim.replay and the aligned simulator; refuses a robot the model was not trained on."""
        self.require(robot)
        points = infer_session(self.path / WEIGHTS, "offsets") if self.config.learns_points else None
        return DeltaCorrector(self.infer, self.config, robot, points)

    def weights_hash(self) -> str:
        """12 hex digits of model.onnx."""
        return hashlib.sha256((self.path / WEIGHTS).read_bytes()).hexdigest()[:12]
