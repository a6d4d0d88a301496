"""Results of the public functions: one frozen class each.

`to_dict` returns plain dictionaries, lists, numbers and text. It is what the command of the same name prints with
`--json`. Angles are in rad, torques in N·m, times in s, masses in kg.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gaponet.base.arrays import Array

if TYPE_CHECKING:
    from gaponet.data.checks.gate import GateReport
    from gaponet.data.store import Dataset
    from gaponet.evaluation.evaluate import Evaluation
    from gaponet.export.rollout import RolloutPrediction
    from gaponet.hw.control.plan import Plan
    from gaponet.hw.control.recording import Recording
    from gaponet.motion.motion import Motion
    from gaponet.nn.artifact import GapModel
    from gaponet.nn.config import ModelKind
    from gaponet.robot.spec import RobotSpec
    from gaponet.sysid.acceptance import Identified
    from gaponet.sysid.evidence.drift import Drift, ParameterChange
    from gaponet.sysid.torque_motors import TorqueDrivenFit

__all__ = [
    "AdaptResult", "CheckResult", "EvalResult", "ExciteResult", "ExportResult", "GapResult", "IdentifyResult",
    "PairResult", "ReplayResult", "RunResult", "TorqueResult", "TrainResult",
]  # fmt: skip
MIN_MOVEMENT_RAD = 1e-6  # of a target, so that a joint counts as moved
Metrics = dict[
    str, Any
]  # mpjae rad, q_dis rad·s, …, and by_joint, by_payload, by_unit, by_motion, by_horizon


@dataclass(frozen=True, kw_only=True)
class Measured:
    """Errors of simulators on recordings.

    Attributes:
        methods: Method (nominal; also identified, and a model) → metrics.
    """

    methods: dict[str, Metrics]

    @property
    def mpjae(self) -> dict[str, float]:
        """Method → mean absolute joint position error, rad."""
        return {name: float(metrics["mpjae"]) for name, metrics in self.methods.items()}


@dataclass(frozen=True, kw_only=True)
class PairResult:
    """Recordings with a paired simulation.

    Attributes:
        simulated: Recordings that were simulated now.
        present: Recordings whose simulation was there before.
    """

    dataset: Dataset
    simulated: int
    present: int

    def to_dict(self) -> dict[str, Any]:
        return {
            "dataset": str(self.dataset.path),
            "simulated": self.simulated,
            "present": self.present,
        }


@dataclass(frozen=True, kw_only=True)
class GapResult(Measured):
    """Error of the simulator, in open-loop rollouts of whole motions.

    Attributes:
        table: Everything that `to_dict` returns. Of an identified robot or a run it holds the error after each cause,
            the floor, and the same by joint and payload.
    """

    table: Mapping[str, Any] = field(repr=False)

    @property
    def by_cause(self) -> bool:
        """True if the result says what each identified cause removes."""
        return "left" in self.table

    def to_dict(self) -> dict[str, Any]:
        return dict(self.table)


@dataclass(frozen=True, kw_only=True)
class EvalResult(Measured):
    """Errors of robots and runs on motions of a dataset.

    Attributes:
        unseen: True if no recording was used in training.
        evaluation: Rollouts, commands and corrections of each method.
    """

    unseen: bool
    evaluation: Evaluation = field(repr=False)

    def to_dict(self) -> dict[str, Any]:
        return dict(self.evaluation.result)


@dataclass(frozen=True, kw_only=True)
class IdentifyResult:
    """An identified robot and its error on validation motions.

    Attributes:
        robot: The robot with identified servos, as written to `folder`.
        errors: nominal and identified → mean |error| of each motion that was not fitted, (motions,) rad.
        fit: Standard errors, terms that were tried, warnings.
        seconds: Duration of the fit.
        taken_from: Joint → joint of `like` whose servo was its start.
        doctor: What the doctor found in the recordings.
    """

    robot: RobotSpec
    folder: Path
    errors: Mapping[str, Array]
    fit: Identified = field(repr=False)
    seconds: float
    doctor: GateReport
    taken_from: Mapping[str, str] = field(default_factory=dict)

    @property
    def val_mpjae(self) -> dict[str, float]:
        """nominal and identified → mean over the motions that were not fitted, rad."""
        return {name: float(errors.mean()) for name, errors in self.errors.items()}

    def values(self) -> dict[str, dict[str, float]]:
        """Operated joint → servo field → value, SI; fields without information are left out."""
        from gaponet.robot.servo_fields import SERVO_FIELDS

        robot = self.robot
        return {
            joint: {
                f: float(getattr(robot, f)[i])
                for f in SERVO_FIELDS
                if np.isfinite(getattr(robot, f)[i])
                and (f != "effort_limit" or f in self.fit.std[joint])
            }
            for joint, i in zip(robot.operated, robot.operated_index, strict=True)
        }

    def to_dict(self) -> dict[str, Any]:
        from gaponet.sim.metrics import standard_error

        fit = self.fit
        return {
            "chosen": fit.chosen, "taken_from": dict(self.taken_from), "joints": self.values(), "std": fit.std,
            "val_mpjae": self.val_mpjae,
            "val_standard_error": {name: standard_error(errors) for name, errors in self.errors.items()},
            "terms": {
                c.name: {"gain": c.gain[0], "standard_error": c.gain[1], "kept": c.accepted} for c in fit.comparisons
            },
            "table": vars(self.robot.table) if self.robot.table else None,
            "links": {body: vars(link) for body, link in self.robot.links.items()},
            "touching": list(fit.table_fit.motions) if fit.table_fit else [],
            "warnings": list(fit.warnings), "findings": list(fit.findings), "undetermined": fit.undetermined,
            "seconds": self.seconds, "robot": str(self.folder), "doctor": self.doctor.to_dict(),
        }  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class TorqueResult:
    """An identified torque-driven robot.

    Attributes:
        robot: The robot with identified armature, damping, friction and delay, as written to `folder`.
        before, after: Mean |error| half a second after a recorded state, driven by the recorded torque, rad.
        fit: Values, standard errors and errors by joint.
        doctor: What the doctor found in the recordings.
    """

    robot: RobotSpec
    folder: Path
    before: float
    after: float
    virtual: bool
    fit: TorqueDrivenFit = field(repr=False)
    doctor: GateReport

    def to_dict(self) -> dict[str, Any]:
        from gaponet.robot.servo_fields import PASSIVE_FIELDS

        fit, robot = self.fit, self.robot
        joints = {
            joint: {f: float(getattr(robot, f)[i]) for f in (*PASSIVE_FIELDS, "delay")}
            | {"bias": float(fit.bias[j]), "constant": float(fit.constant[j])}
            for j, (joint, i) in enumerate(zip(robot.operated, robot.operated_index, strict=True))
        }
        return {
            "joints": joints, "std": fit.std, "torque": fit.torque, "windows": fit.windows,
            "angle": {str(h): x for h, x in fit.angle.items()}, "robot": str(self.folder),
            "doctor": self.doctor.to_dict(),
        }  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class TrainResult:
    """A trained model.

    Attributes:
        model: The exported model that was best on validation motions.
        card: What its card.json says: training, data, errors.
        candidates: Kind of network → validation error after its part of the budget, rad; empty if one kind was given.
        doctor: What the doctor found in the recordings.
    """

    model: GapModel
    card: dict[str, Any] = field(repr=False)
    doctor: GateReport
    candidates: Mapping[ModelKind, float] = field(default_factory=dict)

    @property
    def val_mpjae(self) -> dict[str, float]:
        """nominal, start (the simulator without the network) and model → mean error on validation motions, rad."""
        return {name: float(self.card["val_mpjae"][name]) for name in ("nominal", "start", "model")}

    def to_dict(self) -> dict[str, Any]:
        keys = (
            "val_mpjae",
            "steps",
            "seconds",
            "sensor_r2",
            "stages",
            "interrupted",
            "parity_rad",
            "seed",
        )
        kind = self.card["model"]["kind"]
        return {key: self.card[key] for key in keys} | {
            "kind": kind,
            "candidates": dict(self.candidates),
            "doctor": self.doctor.to_dict(),
        }


@dataclass(frozen=True, kw_only=True)
class AdaptResult:
    """Servo parameters of one unit on one day.

    Attributes:
        servos: Operated joint → kp N·m/rad, damping N·m·s/rad, frictionloss N·m, offset rad, delay s.
        before, after: Mean error of whole recordings (robot), or RMS error of the fitted windows (model), rad.
        robot: The adapted robot; None for a model.
        folder: Robot folder or run folder that holds the result.
        recordings: Number of recordings behind `before` and `after`.
        doctor: What the doctor found in the recordings.
    """

    unit_id: str
    servos: Mapping[str, Mapping[str, float]]
    before: float
    after: float
    robot: RobotSpec | None
    folder: Path
    recordings: int
    doctor: GateReport

    def to_dict(self) -> dict[str, Any]:
        return {
            "unit_id": self.unit_id, "before": self.before, "after": self.after,
            "servos": {joint: dict(servo) for joint, servo in self.servos.items()}, "robot": str(self.folder),
            "doctor": self.doctor.to_dict(),
        }  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class CheckResult:
    """Comparison of new logs with an identified robot.

    Attributes:
        verdict: same, drifted, contradictory or different.
        advice: What to do.
        recordings: Number of recordings that were compared.
        drift: Every parameter that changed, with its significance.
    """

    verdict: str
    advice: str
    recordings: int
    drift: Drift = field(repr=False)

    def to_dict(self) -> dict[str, Any]:
        d = self.drift

        def plain(moved: ParameterChange) -> dict[str, Any]:
            return {**vars(moved), "sigmas": moved.sigmas}

        return {
            "verdict": self.verdict, "advice": self.advice, "recordings": self.recordings, "seconds": d.seconds,
            "moved": [plain(m) for m in d.moved], "largest": {j: plain(m) for j, m in d.largest.items()},
            "against": [vars(a) for a in d.against], "threshold": d.threshold, "far": d.far,
        }  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class ReplayResult:
    """Motion that the identified robot would make in rollouts of a policy.

    Attributes:
        joints: Operated joint → errors (rad) and share of time inside the band.
        differ: Joints that leave the band for too long, the worst first.
        rollouts: Targets, rollout, predicted motion and band of each rollout, (T, joints) rad.
        share: Share of the error distribution that the band holds.
        drawn: Number of parameter samples behind the band.
        band_from_recordings: False if the recordings are gone and the band comes from the robot folder.
    """

    robot: RobotSpec
    joints: Mapping[str, Mapping[str, Any]]
    differ: tuple[str, ...]
    rollouts: tuple[RolloutPrediction, ...] = field(repr=False)
    share: float
    drawn: int
    band_from_recordings: bool

    def save(self, path: Path) -> None:
        """Write target, rollout, robot, low and high of each rollout, (T, joints) rad, and dt, s, to an .npz file."""
        from gaponet.base.files import atomic_write

        arrays: dict[str, Any] = {
            "names": np.array([a.name for a in self.rollouts]), "joints": np.array(self.robot.operated)
        }  # fmt: skip
        for k, a in enumerate(self.rollouts):
            series = {"target": a.target, "rollout": a.rollout, "robot": a.robot}
            series |= {
                "low": a.robot - a.half_width,
                "high": a.robot + a.half_width,
                "dt": np.array(a.dt),
            }
            arrays |= {f"{name}_{k}": values for name, values in series.items()}
        with atomic_write(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, **arrays)

    def to_dict(self) -> dict[str, Any]:
        return {
            "robot": self.robot.name, "rollouts": [a.name for a in self.rollouts],
            "joints": {j: dict(s) for j, s in self.joints.items()}, "differ": list(self.differ),
            "band": {"share": self.share, "drawn": self.drawn},
        }  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class ExportResult:
    """Files for another program.

    Attributes:
        path: Folder or file that was written.
        to: Program or format.
        robot: Name of the robot.
        errors: Form of the robot → mean |error| over the motions that judged it, rad; empty for a network.
        motions: Number of those motions.
        virtual: True if no real robot played them.
        notes: What the form leaves out, and what the user has to decide.
        parity: Largest difference between the file and the trained network, rad; None for a robot.
        check: Script that checks the export in the other program without gaponet; None where there is none.
    """

    path: Path
    to: str
    robot: str
    errors: Mapping[str, float] = field(default_factory=dict)
    motions: int = 0
    virtual: bool = False
    notes: tuple[str, ...] = ()
    parity: float | None = None
    check: Path | None = None

    def to_dict(self) -> dict[str, Any]:
        if self.parity is not None:
            return {"path": str(self.path), "to": self.to, "parity_rad": self.parity}
        return {
            "path": str(self.path), "to": self.to, "robot": self.robot, "left": dict(self.errors),
            "notes": list(self.notes),
        }  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class ExciteResult:
    """Motion files to play on a robot.

    Attributes:
        motions: File names in `folder`, in the order of playing.
        minutes: Duration of all motions with all payloads.
        payloads: Payloads, kg in each hand.
        sheet: Instructions to print.
        prediction: Standard errors of an identified robot before and after the motions; else None.
    """

    folder: Path
    motions: tuple[str, ...]
    minutes: float
    payloads: tuple[float, ...]
    sheet: Path
    prediction: Prediction | None = None

    def to_dict(self) -> dict[str, Any]:
        prediction = {} if self.prediction is None else self.prediction.to_dict()
        return {
            "motions": list(self.motions), "minutes": self.minutes, "payloads": list(self.payloads),
            "sheet": str(self.sheet),
        } | prediction  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Standard errors of an identified robot's parameters, before and after further motions.

    Attributes:
        before, after: Joint → servo field → standard error, SI.
        useful_seconds: Playing time after which half a minute more reduces the errors by less than 5 %.
        undetermined: Joint → why its gains stay undetermined.
        played: Payload (kg) and name of each motion.
    """

    before: Mapping[str, Mapping[str, float]]
    after: Mapping[str, Mapping[str, float]]
    useful_seconds: float
    undetermined: Mapping[str, str]
    played: tuple[tuple[float, str], ...]

    def to_dict(self) -> dict[str, Any]:
        return {
            "errors": self.before, "errors_then": self.after, "worth_seconds": self.useful_seconds,
            "open": dict(self.undetermined), "played": [list(pair) for pair in self.played],
        }  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class RunResult:
    """One run on a robot.

    Attributes:
        recording: Readings, commands, events and timing of every control period.
        robot: The robot with its identified values.
        plan: Plan that was shown; None if live targets never had one.
        would_send: Commands of a dry run by joint: range (rad), speed (rad/s) and torque (N·m). Empty otherwise.
        file: MOTION.parquet that was written, or None.
    """

    recording: Recording
    robot: RobotSpec
    plan: Plan | None = None
    would_send: dict[str, dict[str, float]] = field(default_factory=dict)
    file: Path | None = None

    @property
    def motion(self) -> Motion | None:
        """The motion as it was played, within limits; None for live targets."""
        return self.plan.motion if self.plan is not None else None

    @property
    def fault(self) -> str:
        """Kind and reason of the fault that ended the run; empty if there was none."""
        fault = self.recording.fault
        return f"{fault.kind}: {fault.text}" if fault is not None else ""

    @property
    def tracking_error(self) -> dict[str, float]:
        """Joint that moved → mean |measured − target| over the run, rad; measured one period after the command."""
        recording = self.recording
        rows = recording.phase_rows("run")
        if len(rows) < 2:
            return {}
        columns = [recording.joint_names.index(name) for name in recording.commanded]
        target = rows["target"][:, columns]
        measured = rows["qpos"][:, columns]
        errors = np.abs(measured[1:] - target[:-1]).mean(axis=0)
        spans = np.ptp(target, axis=0)
        found = {}
        for joint, error, span in zip(recording.commanded, errors, spans, strict=True):
            if span > MIN_MOVEMENT_RAD:
                found[joint] = float(error)
        return found

    @property
    def mean_tracking_error(self) -> float | None:
        """Mean of `tracking_error` over the joints that moved, rad; None if none did."""
        errors = list(self.tracking_error.values())
        return float(np.mean(errors)) if errors else None

    def to_dict(self) -> dict[str, Any]:
        found = self.recording.summary() | self.tracking()
        if self.file is not None:
            found["file"] = str(self.file)
        return found

    def tracking(self) -> dict[str, Any]:
        """Return the tracking errors as JSON has them: empty if the run had fewer than two periods."""
        if len(self.recording.phase_rows("run")) < 2:
            return {}
        return {"tracking_error_rad": {"mean": self.mean_tracking_error} | self.tracking_error}
