"""GapModel: what ships. A folder with model.onnx (normalisers inside) and card.json.

Needs onnxruntime, never torch.
"""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NotRequired

import numpy as np
from annotated_types import Interval, Len
from typing_extensions import TypedDict

from gaponet.base.arrays import Array
from gaponet.base.errors import ModelError, UsageError
from gaponet.base.structure import Json, Name, Number, Sha256, read_format, read_json, validated
from gaponet.nn.config import ModelConfig
from gaponet.nn.loop import DeltaCorrector, DeltaLoop
from gaponet.nn.onnx_network import Network, OnnxNetwork
from gaponet.robot.folder import has_stored_robot, load_stored_robot, stored_robot_holder
from gaponet.robot.spec import RobotSpec

if TYPE_CHECKING:
    pass

WEIGHTS, CARD, FORMAT = "model.onnx", "card.json", 1
RECORDED_TOLERANCE = 0.02  # relative, of gains
# Switches of earlier versions that cards still name, and the value that they would have today.
RETIRED = {
    "payload_predictor": True, "context": "none", "branch": "unstacked", "branch_history": True, "fno_width": 32,
    "fno_layers": 3, "fno_modes": 4, "coupling": "posture", "transformer_width": 64, "transformer_layers": 2,
    "transformer_heads": 4,
}  # fmt: skip
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
        "qpos_range": [
            [float(x) if np.isfinite(x) else None for x in robot.qpos_range[i]] for i in robot.operated_index
        ],
        "simulator": model_hash(robot),
        "model": asdict(config),
    } | facts


class _SensorR2(TypedDict):
    """How well the sensor predictor explains what it was not fitted to."""

    mean: Number
    by_joint: dict[str, Number]


class _Stages(TypedDict):
    """What training got to: rounds of the warm start, done and planned; updates of PPO, and whether it began anew."""

    warm_start_rounds: tuple[int, int]
    ppo_updates: int
    ppo_anew: NotRequired[bool]


class _Card(TypedDict):
    """The fields of a card.json that something is decided by; others stand beside them."""

    format: int
    robot: Name
    joint_names: Annotated[tuple[Name, ...], Len(1, 500)]
    kp: tuple[float, ...]
    kd: tuple[float, ...]
    simulator: str
    model: dict[str, Json]
    qpos_range: NotRequired[tuple[tuple[float | None, float | None], ...]]
    dt: NotRequired[tuple[Annotated[float, Interval(ge=1e-4, le=1)], ...]]
    payload_seen: NotRequired[Annotated[tuple[Annotated[float, Interval(ge=0, le=100)], ...], Len(1)]]
    units: NotRequired[tuple[str, ...]]
    recorded: NotRequired[dict[Literal["kp", "kd"], tuple[float, ...] | None]]
    virtual: NotRequired[bool]
    simulator_only: NotRequired[bool]
    interrupted: NotRequired[bool]
    stages: NotRequired[_Stages]
    dataset_hash: NotRequired[str]
    seed: NotRequired[int]
    hours: NotRequired[float]
    steps: NotRequired[int]
    seconds: NotRequired[float]
    excess_delay: NotRequired[float]
    parity_rad: NotRequired[float]
    motions: NotRequired[dict[str, tuple[str, ...]]]
    val_mpjae: NotRequired[dict[Literal["model", "nominal", "start", "added", "error"], Number]]
    sensor_r2: NotRequired[_SensorR2 | None]
    versions: NotRequired[dict[str, str]]
    sha256: NotRequired[dict[str, Sha256]]


def _require_answer(network: Network, width: int, shape: tuple[int, ...], largest: float, file: Path) -> None:
    """Refuse a network that does not answer (k, width) numbers with (k, *shape) finite ones up to `largest` (rad)."""
    try:
        answers = [network(np.zeros((k, width), np.float32)) for k in (1, 2)]
        fits = all(a.shape == (k, *shape) for k, a in enumerate(answers, 1))
        fits = fits and all(np.isfinite(a).all() and np.abs(a).max() <= largest + 1e-3 for a in answers)
        reason = f"{width} numbers in do not give {shape} finite ones up to {largest:g} rad out"
    except Exception as error:  # whatever a stranger's network does
        fits, reason = False, f"it does not run: {' '.join(str(error).split())[:120]}"
    if not fits:
        raise ModelError(f"{file}: does not fit its card ({reason}); copy or train the model again")


@dataclass(frozen=True)
class GapModel:
    """A delta-action model and its card.

    `loop` serves a control loop, and remembers its past; the model itself remembers nothing and can be shared.
    deploy.AlignedSim is a simulator with such a loop, `corrector` serves sim.replay.
    """

    path: Path
    card: dict[str, Any]
    config: ModelConfig
    infer: Network

    @classmethod
    def load(cls, path: str | Path, threads: int = 1) -> GapModel:
        """Read an artifact, or the artifact of a run folder.

        Args:
            path: Folder.
            threads: How many onnxruntime uses; 0 for all cores, which pays for hundreds of robots at once.

        Raises:
            ModelError: Missing or damaged file, or one written by a newer version.
        """
        folder = Path(path)
        folder = folder / "model" if (folder / "model" / CARD).is_file() else folder
        for name in (CARD, WEIGHTS):
            if not (folder / name).is_file():
                raise ModelError(f"{path}: no {name}; give a run folder of gaponet train, or an artifact folder")
        card, config = GapModel.read_card(folder / CARD)
        file = folder / WEIGHTS
        network = OnnxNetwork.read(file, threads)
        width, n = config.input_dim(len(card["joint_names"])), len(card["joint_names"])
        _require_answer(network, width, (n,), config.delta_max, file)
        if card.get("sha256", {}).get(WEIGHTS, digest := sha256(file)) != digest:
            raise ModelError(f"{file}: is not of its {CARD}: an export was cut short; run gaponet export RUN again")
        return cls(folder, card, config, network)

    @property
    def qpos_range(self) -> Array:
        """Limits of the operated joints, (n, 2) rad; ±inf where there is none (or the card is an old one)."""
        limits = self.card.get("qpos_range", [[None, None]] * len(self.card["joint_names"]))
        return np.array([[-np.inf if a is None else a, np.inf if b is None else b] for a, b in limits])

    def loop(self, num_envs: int = 1) -> DeltaLoop:
        """The corrections of num_envs robots, with a past of their own: loop.delta(qpos, qvel, ctrl, payload_mass).

        Joints are those of the card (joint_names), in that order.

        Raises:
            ModelError: It asks its simulator, which stands in no control loop.
        """
        if self.config.asks_simulator:
            raise ModelError(
                f"{self.path}: its sensor values are the simulator's answers (sensor_source fixed), for gaponet eval "
                "alone; train with --model.sensor-source predicted"
            )
        return DeltaLoop(self.config, self.qpos_range, num_envs, self.infer)

    def corrects(self, robot: RobotSpec) -> bool:
        """Whether this is the simulator that it was trained in; refuses another robot."""
        from gaponet.sim.model import model_hash

        card = self.card
        if card["robot"] != robot.name or tuple(card["joint_names"]) != robot.operated:
            raise ModelError(
                f"{self.path}: made for {card['robot']} with joints {', '.join(card['joint_names'])}; "
                f"this is {robot.name} with {', '.join(robot.operated)}. Use the robot the model was trained for"
            )
        return bool(card["simulator"] == model_hash(robot))

    def require(self, robot: RobotSpec, dt: float | None = None) -> None:
        """Refuse a robot, simulator, gains or rate the model was not trained on."""
        from gaponet.sim.model import model_hash

        if not self.corrects(robot):
            trained, asked = self.card["simulator"], model_hash(robot)
            raise ModelError(
                f"{self.path}: trained in simulator {trained}, but robot '{robot.name}' in {robot.folder} is {asked} "
                "(MJCF, gains or limits differ, or it is of before friction held); use the robot folder that the run "
                "keeps, or train again"
            )
        if dt is not None:
            self.require_rate(dt)

    def simulator(self) -> RobotSpec:
        """The simulator that it corrects, as its run or its export keeps it.

        Raises:
            ModelError: The model lies in no run, or in one that keeps another simulator.
        """
        if not has_stored_robot(stored_robot_holder(self.path)):
            raise ModelError(
                f"{self.path}: trained in simulator {self.card['simulator']}, which does not lie beside it; "
                "commands cannot be transferred to another simulator or rate; give the run folder, or an export (--out)"
            )
        kept = load_stored_robot(stored_robot_holder(self.path), self.card["robot"])
        self.require(kept)
        return kept

    @property
    def heaviest(self) -> float:
        """Largest payload in its training data, kg; where an old card does not say, the largest it can be told."""
        return float(max(self.card.get("payload_seen", [self.config.payload_max])))

    def require_payload(self, payload_mass: Array | float, extrapolate: bool = False) -> None:
        """Refuse payloads (kg) that are none, or lie beyond those trained on unless `extrapolate`."""
        mass = np.asarray(payload_mass, float)
        if not (np.isfinite(mass) & (mass >= 0)).all():
            raise UsageError(f"payload_mass is {payload_mass}; give kg, 0 when empty")
        least = min(self.card.get("payload_seen", [0.0]))
        beyond = mass[(mass > self.heaviest * (1 + 1e-6)) | (mass < least * (1 - 1e-6))]
        if beyond.size and not extrapolate:
            raise ModelError(
                f"{self.path}: trained with {least:g} to {self.heaviest:g} kg, asked for {beyond.flat[0]:g} kg, where "
                "it only guesses; train on such payloads, or extrapolate (--extrapolate, extrapolate=True)"
            )

    def require_gains(self, joint_names: tuple[str, ...], kp: Array, kd: Array) -> None:
        """Refuse a real robot whose servos have other gains (n) than those the training data were recorded with."""
        for name, gains in (("kp", kp), ("kd", kd)):
            recorded = self.card.get("recorded", {}).get(name)
            for joint, was in zip(self.card["joint_names"], recorded or (), strict=False):
                now = float(gains[joint_names.index(joint)])
                if abs(now - was) > RECORDED_TOLERANCE * max(was, now):
                    raise ModelError(
                        f"{self.path}: its data were recorded with {name} {was:g} of {joint}, the servo has {now:.4g}; "
                        "set the servos as they were, train on recordings with these gains (import with --kp and --kd "
                        "if the data say them wrongly), or extrapolate (--extrapolate)"
                    )

    def require_rate(self, dt: float) -> None:
        """Refuse a control period, s, that the model was not trained on."""
        rates = self.card.get("dt", [])
        if rates and min(abs(dt / r - 1) for r in rates) > DT_TOLERANCE:
            seen = ", ".join(f"{1 / r:.1f}" for r in rates)
            raise ModelError(
                f"{self.path}: trained at {seen} Hz, asked to run at {1 / dt:.1f} Hz; run the loop at a trained rate, "
                "or train on logs of this rate"
            )

    def corrector(self, robot: RobotSpec) -> DeltaCorrector:
        """The corrections for sim.replay and AlignedSim; refuses a robot the model was not trained on."""
        self.require(robot)
        return DeltaCorrector(self.infer, self.config, robot)

    def weights_hash(self) -> str:
        """First 12 hex digits of the SHA-256 of model.onnx."""
        return sha256(self.path / WEIGHTS)[:12]

    @staticmethod
    def read_card(file: Path) -> tuple[dict[str, Any], ModelConfig]:
        """A card as it stands in the file, every field of a sensible type and size, and the shape of its model.

        Raises:
            ModelError: Damaged, or written by a newer version.
        """
        mend = "restore it or train again"
        read_format(_Card, file, FORMAT, ModelError, mend)
        card = read_json(dict[str, Any], file, ModelError, mend)
        for field, value in RETIRED.items():
            if (had := card["model"].pop(field, value)) != value:
                raise ModelError(f"{file}: trained with {field} {had}, which is no more; train again without it")
        if card.pop("family", None):
            raise ModelError(f"{file}: trained in a family of simulators, which is no more; see gaponet.Transfer")
        config = validated(ModelConfig, card["model"], f"{file}: model", ModelError, mend)
        n = len(card["joint_names"])
        lists = {name: card.get(name) for name in ("kp", "kd", "qpos_range")}
        for name, values in (lists | {f"recorded.{k}": v for k, v in card.get("recorded", {}).items()}).items():
            if values is not None and len(values) != n:
                raise ModelError(f"{file}: {name}: should have one entry for each of {n} joints; {mend}")
        for low, high in card.get("qpos_range", []):
            if low is not None and high is not None and not low < high:
                raise ModelError(f"{file}: qpos_range: {low} to {high} is no range; {mend}")
        return card, config

    @staticmethod
    def how_trained(card: dict[str, Any]) -> str:
        """What the budget bought, in words; a model that saw no update of PPO is called a supervised start."""
        if "stages" not in card:
            return "by an older gaponet, which did not keep what training got to"
        (done, planned), updates = card["stages"]["warm_start_rounds"], card["stages"]["ppo_updates"]
        warm = (
            f"{done} of {planned} rounds of the supervised start"
            if done < planned
            else f"supervised start ({done} rounds)"
        )
        if not planned and updates:
            return f"{updates} updates of PPO from the untrained network, no supervised start"
        if card["stages"].get("ppo_anew"):
            return f"{warm}, worse than no correction; {updates} updates of PPO from the untrained network"
        return f"{warm}, {updates} updates of PPO" if updates else f"{warm}, no PPO"


def sha256(file: Path) -> str:
    """SHA-256 of a file's content, 64 hex digits."""
    return hashlib.sha256(file.read_bytes()).hexdigest()
