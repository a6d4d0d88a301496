"""GapModel: a trained model as a folder with model.onnx (normalisers inside) and card.json.

It does not need torch.

The package has some of them by name (nn/packaged_networks.py).
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NotRequired, cast

import numpy as np
from annotated_types import Interval, Len
from typing_extensions import TypedDict

from gaponet.base.arrays import Array
from gaponet.base.errors import ModelError, UsageError
from gaponet.base.structure import Json, Name, Number, Sha256, read_format, read_json, validated
from gaponet.data.sequence import is_same_rate
from gaponet.nn.config import ModelConfig
from gaponet.nn.loop import DeltaCorrector, DeltaLoop
from gaponet.nn.onnx_network import Network, OnnxNetwork
from gaponet.nn.packaged_networks import named_folder
from gaponet.robot.by_name import CARD as CARD
from gaponet.robot.folder import (
    PackagedRobot,
    has_stored_robot,
    load_stored_robot,
    stored_robot_holder,
)
from gaponet.robot.spec import RobotSpec

if TYPE_CHECKING:
    from gaponet.sim.batch import Condition

WEIGHTS = "model.onnx"
FORMAT = 1
# Fields of the card that export also writes into the ONNX file: what the network's inputs and
# outputs mean, and for which robots they hold.
FACTS_IN_NETWORK = (
    "robot",
    "joint_names",
    "kp",
    "kd",
    "qpos_range",
    "dt",
    "payload_seen",
    "recorded",
    "model",
    "context",
)
# Beyond the answers of training, as a share of their range, at which the network is still used.
MAX_DISTANCE = 0.1
MIN_WIDTH_RAD = 1e-4  # narrower ranges of training are taken to be this wide
GAIN_TOLERANCE = 0.02  # relative, between recorded and real gains
MAX_SHOWN = 80  # characters of a value in an error message


def make_card(config: ModelConfig, robot: RobotSpec, **facts: Any) -> dict[str, Any]:
    """Return the card of a model: its inputs, its training data and its limits.

    Args:
        robot: The simulator that the model corrects.
        facts: Further fields, such as dt [s], payload_seen [kg], dataset_hash, units, virtual and
            versions.
    """
    from gaponet.sim.model import model_hash

    ranges = []
    for low, high in robot.qpos_range[robot.operated_index].tolist():
        ranges.append([low if np.isfinite(low) else None, high if np.isfinite(high) else None])
    return {
        "format": FORMAT,
        "robot": robot.name,
        "joint_names": list(robot.operated),
        "kp": robot.servo.kp[robot.operated_index].tolist(),
        "kd": robot.servo.kd[robot.operated_index].tolist(),
        "qpos_range": ranges,
        "simulator": model_hash(robot),
        "model": asdict(config),
    } | facts


class _SensorR2(TypedDict):
    """R² of the sensor predictor on held-out states."""

    mean: Number
    by_joint: dict[str, Number]


class _Stages(TypedDict):
    """Progress of training: completed and planned rounds of pre-training, and PPO updates."""

    ppo_updates: int
    pretraining_rounds: NotRequired[tuple[int, int]]
    ppo_from_untrained: NotRequired[bool]


class _Card(TypedDict):
    """Fields of a card.json that are checked. It may have others."""

    format: int
    robot: Name
    joint_names: Annotated[tuple[Name, ...], Len(1, 500)]
    kp: tuple[float, ...]
    kd: tuple[float, ...]
    simulator: str
    model: dict[str, Json]
    qpos_range: NotRequired[tuple[tuple[float | None, float | None], ...]]
    dt: NotRequired[tuple[Annotated[float, Interval(ge=1e-4, le=1)], ...]]
    payload_seen: NotRequired[
        Annotated[tuple[Annotated[float, Interval(ge=0, le=100)], ...], Len(1)]
    ]
    units: NotRequired[tuple[str, ...]]
    recorded: NotRequired[dict[Literal["kp", "kd"], tuple[float, ...] | None]]
    virtual: NotRequired[bool]
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
    context: NotRequired[dict[Literal["nominal", "low", "high"], tuple[float, ...]]]
    sha256: NotRequired[dict[str, Sha256]]


def _require_output(
    network: Network, inputs: int, outputs: int, largest: float, file: Path
) -> None:
    """Refuse a network whose output for inputs (k, inputs) is not (k, outputs), finite, and at
    most `largest` rad.
    """
    reason = f"{inputs} numbers in do not give {outputs} finite ones up to {largest:g} rad out"
    fits = True
    try:
        for rows in (1, 2):
            delta = network(np.zeros((rows, inputs), np.float32))
            fits = fits and delta.shape == (rows, outputs) and _is_within(delta, largest + 1e-3)
    except Exception as error:  # an unknown network can raise anything
        fits = False
        reason = f"it does not run: {' '.join(str(error).split())[:120]}"
    if not fits:
        raise ModelError(f"{file}: does not fit its card ({reason}); copy or train the model again")


def _is_within(delta: Array, largest: float) -> bool:
    """Return True if all corrections are finite and at most `largest` rad."""
    return bool(np.isfinite(delta).all() and np.abs(delta).max() <= largest)


def _contradiction(card: dict[str, Any], config: ModelConfig) -> str:
    """Return which field of a card has the wrong length or an impossible value; "" if none has."""
    return (
        _list_of_other_length(card)
        or _context_of_other_length(card, config)
        or _impossible_range(card)
    )


def _list_of_other_length(card: dict[str, Any]) -> str:
    n = len(card["joint_names"])
    lists = {name: card.get(name) for name in ("kp", "kd", "qpos_range")}
    for name, values in card.get("recorded", {}).items():
        lists[f"recorded.{name}"] = values
    for name, values in lists.items():
        if values is not None and len(values) != n:
            return f"{name}: should have one entry for each of {n} joints"
    return ""


def _context_of_other_length(card: dict[str, Any], config: ModelConfig) -> str:
    if not config.context:
        return ""
    numbers = config.context_dim(len(card["joint_names"]))
    answers = card.get("context", {})
    for name in ("nominal", "low", "high"):
        if len(answers.get(name, ())) != numbers:
            return f"context.{name}: should have {numbers} numbers"
    return ""


def _impossible_range(card: dict[str, Any]) -> str:
    for low, high in card.get("qpos_range", []):
        if low is not None and high is not None and not low < high:
            return f"qpos_range: {low} to {high} is no range"
    return ""


def facts_in_network(card: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a card that are stored in the ONNX file, as JSON reads them."""
    facts = {name: card[name] for name in FACTS_IN_NETWORK if name in card}
    return cast(dict[str, Any], json.loads(json.dumps(facts)))


def _require_stored_facts(network: OnnxNetwork, card: dict[str, Any], folder: Path) -> None:
    """Refuse a card that says something else about the network than the network's own file does."""
    try:
        stored = network.stored_facts
    except ValueError as error:
        raise ModelError(f"{folder / WEIGHTS}: {error}; copy or train the model again") from None
    if not stored:
        return
    given = facts_in_network(card)
    for name in FACTS_IN_NETWORK:
        if stored.get(name) != given.get(name):
            raise ModelError(
                f"{folder / CARD}: {name} is {_short(given.get(name))}, but {WEIGHTS} was "
                f"exported with {_short(stored.get(name))}; restore the card, or run gaponet "
                "export RUN again"
            )


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= MAX_SHOWN else text[: MAX_SHOWN - 1] + "…"


@dataclass(frozen=True)
class KnownSimulators:
    """Answers of the simulators of a training.

    Attributes:
        nominal: Of the robot's own simulator, (8n) rad.
        low, high: Smallest and largest, (8n) rad.
    """

    nominal: Array
    low: Array
    high: Array

    @classmethod
    def of(cls, nominal: Array, trained: Array) -> KnownSimulators:
        """Return the range of the robot's own answers, (8n), and those of training, (simulators,
        8n).
        """
        answers = np.vstack([nominal, trained])
        return cls(nominal, answers.min(axis=0), answers.max(axis=0))

    def distance(self, context: Array) -> float:
        """Return how far answers (…, 8n) lie outside those of training: 0 within, 1 a whole width
        of the range away.
        """
        beyond = np.maximum(self.low - context, context - self.high)
        width = np.maximum(self.high - self.low, MIN_WIDTH_RAD)
        return float(np.maximum(beyond / width, 0.0).max())

    def include(self, context: Array) -> bool:
        """Return true if answers (…, 8n) are so close to those of training that the network can be
        used.
        """
        return self.distance(context) <= MAX_DISTANCE

    def to_card(self) -> dict[str, list[float]]:
        """Return the entry of card.json."""
        return {name: np.round(values, 7).tolist() for name, values in vars(self).items()}

    @classmethod
    def from_card(cls, entry: dict[str, Any]) -> KnownSimulators:
        """Read the entry of card.json."""
        return cls(*(np.array(entry[name], np.float32) for name in ("nominal", "low", "high")))


@dataclass(frozen=True)
class GapModel:
    """Delta-action model and its card. It has no state and can be shared.

    `loop` is for control loops and has a history. `corrector` is for rollouts of sim.replay.
    deploy.AlignedSim is a simulator with a loop.
    """

    path: Path
    card: dict[str, Any]
    config: ModelConfig
    infer: Network

    @classmethod
    def load(cls, path: str | Path, threads: int = 1) -> GapModel:
        """Load a model: of the package by name, or of a run or export folder.

        Args:
            path: Name of a network of the package, such as those of gaponet.networks(), or a
                folder.
            threads: Threads of onnxruntime; 0 for all cores, which is faster for hundreds of robots
                at once.

        Raises:
            ModelError: A file is missing, damaged, or from a newer version; or the card contradicts
                the network in shapes, joints, gains, ranges, rate, payload or largest correction.
            UsageError: The name is that of a network of the package and of a folder in the working
                directory.
        """
        folder = named_folder(path)
        if (folder / "model" / CARD).is_file():
            folder = folder / "model"
        for name in (CARD, WEIGHTS):
            if not (folder / name).is_file():
                raise ModelError(
                    f"{path}: no {name}; give a run folder of gaponet train, or an artifact folder"
                )
        card, config = GapModel.read_card(folder / CARD)
        file = folder / WEIGHTS
        network = OnnxNetwork.read(file, threads)
        n = len(card["joint_names"])
        _require_output(network, config.input_dim(n), n, config.delta_max, file)
        _require_stored_facts(network, card, folder)
        digest = sha256(file)
        if card.get("sha256", {}).get(WEIGHTS, digest) != digest:
            raise ModelError(
                f"{file}: is not of its {CARD}: an export was cut short; run gaponet export RUN "
                "again"
            )
        return cls(folder, card, config, network)

    @property
    def qpos_range(self) -> Array:
        """Limits of the operated joints, (n, 2) rad.

        ±inf where there is none, or the card does not have them.
        """
        no_limits = [[None, None]] * len(self.card["joint_names"])
        limits = np.array(self.card.get("qpos_range", no_limits), float)  # None becomes NaN
        return np.where(np.isnan(limits), (-np.inf, np.inf), limits)

    @property
    def known_simulators(self) -> KnownSimulators | None:
        """Answers of the simulators of training to fixed probes, if the network is told them."""
        if not self.config.context:
            return None
        return KnownSimulators.from_card(self.card["context"])

    @property
    def nominal_context(self) -> Array:
        """Answers of the robot's own simulator to fixed probes at the rate of the first recording,
        (8n) rad.

        (0) if the network is not told them.
        """
        known = self.known_simulators
        return np.zeros(0, np.float32) if known is None else known.nominal

    @property
    def has_one_rate(self) -> bool:
        """True if all control periods of training count as one rate."""
        periods = self.card.get("dt", [])
        return all(is_same_rate(dt, periods[0]) for dt in periods)

    def knows(self, robot: RobotSpec, dt: float) -> bool:
        """Return true if the network was trained for this simulator: in it, or in simulators with
        such answers.

        Raises:
            ModelError: This is another robot.
        """
        if self.is_trained_in(robot):
            return True
        known = self.known_simulators
        return known is not None and known.include(self.context_of(robot, dt))

    def context_of(self, robot: RobotSpec, dt: float) -> Array:
        """Measure a simulator's answers to fixed probes with empty hands, (8n) rad.

        dt is the control period, s.
        """
        from gaponet.sim.batch import Condition

        result: Array = self.contexts_of(robot, [Condition(0.0, "both", dt)])[0]
        return result

    def contexts_of(self, robot: RobotSpec, conditions: list[Condition]) -> Array:
        """Measure answers to fixed probes, (conditions, 8n) rad: with empty hands, or loaded if
        the network is not told the payload.
        """
        from gaponet.sim.context import contexts

        return contexts(robot, conditions, loaded=self.config.context_is_loaded)

    def loop(self, num_envs: int = 1, context: Array | None = None) -> DeltaLoop:
        """Return the control loop of num_envs robots: loop.delta(qpos, qvel, ctrl, payload_mass).

        Joints are those of the card (joint_names), in that order.

        Args:
            context: Answers of the simulators to fixed probes, (num_envs, 8n) or (8n) rad, for a
                network that is told them; default: those of the robot's own simulator at the rate
                of the first recording. At another rate, give `context_of(robot, dt)`.

        Raises:
            ModelError: The model needs its simulator, which a control loop does not have.
        """
        if self.config.needs_simulator:
            raise ModelError(
                f"{self.path}: its sensor values are the simulator's answers (sensor_source "
                "fixed), for gaponet eval alone; train with --model.sensor-source predicted"
            )
        loop = DeltaLoop(self.config, self.qpos_range, num_envs, self.infer)
        if self.config.context:
            loop.network_input.set_context(self.nominal_context if context is None else context)
        return loop

    def is_trained_in(self, robot: RobotSpec) -> bool:
        """Return true if this is the simulator of training.

        Raises:
            ModelError: This is another robot.
        """
        from gaponet.sim.model import model_hash

        card = self.card
        if card["robot"] != robot.name or tuple(card["joint_names"]) != robot.operated:
            raise ModelError(
                f"{self.path}: made for {card['robot']} with joints "
                f"{', '.join(card['joint_names'])}; this is {robot.name} with "
                f"{', '.join(robot.operated)}. Use the robot the model was trained for"
            )
        return bool(card["simulator"] == model_hash(robot))

    def require(self, robot: RobotSpec, dt: float | None = None) -> None:
        """Refuse another simulator, with other gains or limits, or another control period dt, s,
        than in training.
        """
        from gaponet.sim.model import model_hash

        if not self.is_trained_in(robot):
            trained = self.card["simulator"]
            given = model_hash(robot)
            raise ModelError(
                f"{self.path}: trained in simulator {trained}, but robot '{robot.name}' in "
                f"{robot.folder} is {given} (MJCF, gains or limits differ, or it is of before "
                f"friction held); {self._how_to_get_simulator()}"
            )
        if dt is not None:
            self.require_rate(dt)

    def _how_to_get_simulator(self) -> str:
        """Return what to do if a robot is not the simulator of training, for an error."""
        packaged = PackagedRobot.read(self.path)
        if packaged is None:
            return "use the robot folder that the run keeps, or train again"
        version = self.card.get("versions", {}).get("gaponet", "of its training")
        return (
            f"it needs the package's {packaged.name} with gain_scale {packaged.gain_scale:g}, as "
            f"in gaponet {version}: use that robot or that version, or train again"
        )

    def simulator(self) -> RobotSpec:
        """Load the simulator of training: of the run or export folder, or for a network of the
        package of the package.

        Raises:
            ModelError: The folder has no simulator, or another one.
        """
        if not has_stored_robot(stored_robot_holder(self.path)):
            raise ModelError(
                f"{self.path}: trained in simulator {self.card['simulator']}, which does not lie "
                "beside it; commands cannot be transferred to another simulator or rate; give the "
                "run folder, or an export (--out)"
            )
        robot = load_stored_robot(stored_robot_holder(self.path), self.card["robot"])
        self.require(robot)
        return robot

    @property
    def max_payload(self) -> float:
        """Largest payload in the training data, kg.

        The largest possible input if the card does not have it.
        """
        return float(max(self.card.get("payload_seen", [self.config.payload_max])))

    def require_payload(
        self, payload_mass: Array | float, extrapolate: bool = False, can_extrapolate: bool = True
    ) -> None:
        """Refuse payloads, kg, that are not physical, and, unless `extrapolate`, those outside the
        training data.

        Args:
            can_extrapolate: The caller has an option for that, which the error names.
        """
        mass = np.asarray(payload_mass, float)
        if not (np.isfinite(mass) & (mass >= 0)).all():
            raise UsageError(f"payload_mass is {payload_mass}; give kg, 0 when empty")
        least = min(self.card.get("payload_seen", [0.0]))
        beyond = mass[(mass > self.max_payload * (1 + 1e-6)) | (mass < least * (1 - 1e-6))]
        if beyond.size and not extrapolate:
            advice = "train on such payloads"
            if can_extrapolate:
                advice += ", or extrapolate (--extrapolate, extrapolate=True)"
            raise ModelError(
                f"{self.path}: trained with {least:g} to {self.max_payload:g} kg; "
                f"{beyond.flat[0]:g} kg is outside; {advice}"
            )

    def require_gains(self, joint_names: tuple[str, ...], kp: Array, kd: Array) -> None:
        """Refuse a real robot whose servo gains, (n,), differ from those of the training
        recordings.
        """
        for name, gains in (("kp", kp), ("kd", kd)):
            recorded = self.card.get("recorded", {}).get(name)
            for joint, was in zip(self.card["joint_names"], recorded or (), strict=False):
                now = float(gains[joint_names.index(joint)])
                if abs(now - was) > GAIN_TOLERANCE * max(was, now):
                    raise ModelError(
                        f"{self.path}: its data were recorded with {name} {was:g} of {joint}, the "
                        f"servo has {now:.4g}; set the servos as they were, train on recordings "
                        "with these gains (import with --kp and --kd if the data say them "
                        "wrongly), or extrapolate (--extrapolate)"
                    )

    def require_rate(self, dt: float) -> None:
        """Refuse a control period, s, that is not in the training data."""
        rates = self.card.get("dt", [])
        if rates and not any(is_same_rate(dt, rate) for rate in rates):
            seen = ", ".join(f"{1 / r:.1f}" for r in rates)
            raise ModelError(
                f"{self.path}: trained at {seen} Hz, the loop has {1 / dt:.1f} Hz; run it at a "
                "trained rate, or train on logs of this rate"
            )

    def corrector(self, robot: RobotSpec) -> DeltaCorrector:
        """Return the corrections for rollouts of sim.replay.

        Refuse a simulator that the network does not know.
        """
        if not self.knows(robot, robot.dt):
            self.require(robot)
        return DeltaCorrector(self.infer, self.config, robot)

    def weights_hash(self) -> str:
        """Return the first 12 hex digits of the SHA-256 of model.onnx."""
        return sha256(self.path / WEIGHTS)[:12]

    @staticmethod
    def read_card(file: Path) -> tuple[dict[str, Any], ModelConfig]:
        """Read and check a card; return it and the options of its model.

        Raises:
            ModelError: The file is damaged or from a newer version.
        """
        mend = "restore it or train again"
        read_format(_Card, file, FORMAT, ModelError, mend)
        card = read_json(dict[str, Any], file, ModelError, mend)
        config = validated(ModelConfig, card["model"], f"{file}: model", ModelError, mend)
        contradiction = _contradiction(card, config)
        if contradiction:
            raise ModelError(f"{file}: {contradiction}; {mend}")
        return card, config

    @staticmethod
    def how_trained(card: dict[str, Any]) -> str:
        """Describe the completed training stages in words."""
        if "stages" not in card:
            return "by an older gaponet, which did not store the training stages"
        stages = card["stages"]
        done, planned = stages.get("pretraining_rounds", (0, 0))
        updates = stages["ppo_updates"]
        if not planned and updates:
            return (
                f"{updates} updates of PPO from the untrained network, no supervised pre-training"
            )
        rounds = f"{done} rounds" if done >= planned else f"{done} of {planned} rounds"
        pretraining = f"supervised pre-training ({rounds})"
        if stages.get("ppo_from_untrained"):
            return (
                f"{pretraining}, worse than no correction; {updates} updates of PPO from the "
                "untrained network"
            )
        return f"{pretraining}, {updates} updates of PPO" if updates else f"{pretraining}, no PPO"


def sha256(file: Path) -> str:
    """Return the SHA-256 of a file, 64 hex digits."""
    return hashlib.sha256(file.read_bytes()).hexdigest()
