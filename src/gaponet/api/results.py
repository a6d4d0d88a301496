"""Results of the public functions: one frozen class each.

`to_dict` returns plain dictionaries, lists, numbers and text. It is what the command of the same
name prints with `--json`. Angles are in rad, torques in N·m, times in s, masses in kg.
"""

from __future__ import annotations

import math
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
    from gaponet.evaluation.verdict import NetworkGain
    from gaponet.export.rollout import RolloutPrediction
    from gaponet.hw.control.plan import Plan
    from gaponet.hw.control.recording import Recording
    from gaponet.motion.motion import Motion
    from gaponet.nn.artifact import GapModel
    from gaponet.nn.config import ModelKind
    from gaponet.robot.spec import RobotSpec, ServoType
    from gaponet.sysid.acceptance import Identified
    from gaponet.sysid.evidence.drift import Drift, ParameterChange
    from gaponet.sysid.torque_motors import TorqueDrivenFit
    from gaponet.sysid.uncertainty import ParameterUncertainty

__all__ = [
    "AdaptResult",
    "CheckResult",
    "EvalResult",
    "ExciteResult",
    "ExportResult",
    "GapResult",
    "IdentifyResult",
    "PairResult",
    "ReplayResult",
    "RunResult",
    "TorqueResult",
    "TrainResult",
]
MIN_MOVEMENT_RAD = 1e-6  # of a target, so that a joint counts as moved
# mpjae rad, q_dis rad·s, …, and by_joint, by_payload, by_unit, by_motion, by_horizon
Metrics = dict[str, Any]


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
        table: Everything that `to_dict` returns. Of an identified robot or a run it holds the error
            after each cause, the floor, and the same by joint and payload.
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
        errors: nominal and identified → mean |error| of each motion that was not fitted, (motions,)
            rad.
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

    def standard_errors(self) -> dict[str, float]:
        """Return nominal and identified → standard error of `val_mpjae` over motions, rad; NaN for
        one motion.
        """
        from gaponet.sim.metrics import standard_error

        return {name: standard_error(errors) for name, errors in self.errors.items()}

    def values(self) -> dict[str, dict[str, float]]:
        """Operated joint → servo field → value, SI; fields without information are left out."""
        robot = self.robot
        found: dict[str, dict[str, float]] = {}
        for joint, i in zip(robot.operated, robot.operated_index, strict=True):
            found[joint] = {}
            for name, value in robot.servo.of_joint(i).items():
                stated = name == "effort_limit" and name not in self.fit.std[joint]
                if np.isfinite(value) and not stated:
                    found[joint][name] = value
        return found

    def rows(self, fields: list[str]) -> list[list[str]]:
        """Return a row for each operated joint: its name, then each servo field with its standard
        error.

        Values are in the unit of the field's heading.
        """
        from gaponet.robot.servo_fields import SERVO_FIELDS
        from gaponet.sysid.uncertainty import JointSummary

        rows = []
        for joint, values in self.values().items():
            errors = self.fit.std[joint]
            row = [joint]
            for name in fields:
                if name not in values or (name == "stribeck_speed" and not values["stribeck"]):
                    row.append("")
                elif errors.get(name):
                    row.append(JointSummary(values, errors).cell(name))
                else:
                    row.append(f"{values[name] * SERVO_FIELDS[name].factor:.3g}")
            rows.append(row)
        return rows

    def servo_types(self) -> list[ServoType]:
        """Return the servo types of the operated joints, each once."""
        robot = self.robot
        types = dict.fromkeys(robot.servo.types[i] for i in robot.operated_index)
        return [servo for servo in types if servo is not None]

    def to_dict(self) -> dict[str, Any]:
        fit = self.fit
        terms = {}
        for term in fit.comparisons:
            gain, error = term.gain
            terms[term.name] = {"gain": gain, "standard_error": error, "kept": term.accepted}
        return {
            "chosen": fit.chosen,
            "taken_from": dict(self.taken_from),
            "joints": self.values(),
            "std": fit.std,
            "val_mpjae": self.val_mpjae,
            "val_standard_error": self.standard_errors(),
            "terms": terms,
            "table": vars(self.robot.scene.table) if self.robot.scene.table else None,
            "links": {body: vars(link) for body, link in self.robot.links.items()},
            "touching": list(fit.table_fit.motions) if fit.table_fit else [],
            "warnings": list(fit.warnings),
            "findings": list(fit.findings),
            "undetermined": fit.undetermined,
            "seconds": self.seconds,
            "robot": str(self.folder),
            "doctor": self.doctor.to_dict(),
        }


@dataclass(frozen=True, kw_only=True)
class TorqueResult:
    """An identified torque-driven robot.

    Attributes:
        robot: The robot with identified armature, damping, friction and delay, as written to
            `folder`.
        before, after: Mean |error| half a second after a recorded state, driven by the recorded
            torque, rad.
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

    def row(self, joint: str, *, with_constant: bool) -> list[str]:
        """Return a joint's values with their standard errors and its torque errors, as a row of a
        table.

        Args:
            with_constant: The torque per recorded unit stands in the row too.
        """
        from gaponet.base.text import format_uncertainty
        from gaponet.robot.servo_fields import PASSIVE_FIELDS, SERVO_FIELDS

        fit = self.fit
        j = self.robot.operated.index(joint)
        i = self.robot.operated_index[j]
        row = [joint]
        for name in PASSIVE_FIELDS:
            value = float(fit.robot.servo[name][i])
            factor = SERVO_FIELDS[name].factor
            shown = format_uncertainty(factor * value, factor * fit.std[joint][name])
            row.append(shown if value else "0")
        row += [f"{1e3 * fit.robot.servo.delay[i]:.0f}", f"{fit.bias[j]:+.2g}"]
        if with_constant:
            row.append(format_uncertainty(float(fit.constant[j]), fit.std[joint]["constant"]))
        return [*row, *(f"{errors[j]:.3g}" for errors in fit.torque)]

    def to_dict(self) -> dict[str, Any]:
        from gaponet.robot.servo_fields import PASSIVE_FIELDS

        fit = self.fit
        robot = self.robot
        joints = {}
        for j, (joint, i) in enumerate(zip(robot.operated, robot.operated_index, strict=True)):
            values = robot.servo.of_joint(i, (*PASSIVE_FIELDS, "delay"))
            values["bias"] = float(fit.bias[j])
            values["constant"] = float(fit.constant[j])
            joints[joint] = values
        return {
            "joints": joints,
            "std": fit.std,
            "torque": fit.torque,
            "windows": fit.windows,
            "angle": {str(horizon): errors for horizon, errors in fit.angle.items()},
            "robot": str(self.folder),
            "doctor": self.doctor.to_dict(),
        }


@dataclass(frozen=True, kw_only=True)
class TrainResult:
    """A trained model.

    Attributes:
        model: The exported model that was best on validation motions.
        card: What its card.json says: training, data, errors.
        candidates: Kind of network → validation error after its part of the budget, rad; empty if
            one kind was given.
        doctor: What the doctor found in the recordings.
    """

    model: GapModel
    card: dict[str, Any] = field(repr=False)
    doctor: GateReport
    candidates: Mapping[ModelKind, float] = field(default_factory=dict)

    @property
    def val_mpjae(self) -> dict[str, float]:
        """nominal, start (the simulator without the network) and model → mean error on validation
        motions, rad.
        """
        return {name: float(self.card["val_mpjae"][name]) for name in ("nominal", "start", "model")}

    @property
    def kind(self) -> str:
        """Kind of the network."""
        return str(self.card["model"]["kind"])

    @property
    def how_trained(self) -> str:
        """How the network was trained, in a sentence."""
        return self.model.how_trained(self.card)

    @property
    def gain(self) -> NetworkGain:
        """By how much the network reduces the error of validation motions."""
        from gaponet.evaluation.verdict import NetworkGain

        errors = self.card["val_mpjae"]
        error = errors.get("error", math.nan)
        return NetworkGain("identified", errors["added"], error, errors["start"])

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
        servos: Operated joint → kp N·m/rad, damping N·m·s/rad, frictionloss N·m, offset rad, delay
            s.
        before, after: Mean error of whole recordings (robot), or RMS error of the fitted windows
            (model), rad.
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
            "unit_id": self.unit_id,
            "before": self.before,
            "after": self.after,
            "servos": {joint: dict(servo) for joint, servo in self.servos.items()},
            "robot": str(self.folder),
            "doctor": self.doctor.to_dict(),
        }


@dataclass(frozen=True, kw_only=True)
class CheckResult:
    """Comparison of new logs with an identified robot.

    Attributes:
        verdict: same, drifted, contradictory or different.
        advice: What to do.
        recordings: Number of recordings that were compared.
        drift: Every parameter that changed, with its significance.
        uncertainty: What is known of the robot's parameters.
    """

    verdict: str
    advice: str
    recordings: int
    drift: Drift = field(repr=False)
    uncertainty: ParameterUncertainty = field(repr=False)

    def rows(self) -> list[list[str]]:
        """Return the largest change of each joint, those that changed first, as rows of a table.

        A row has joint, parameter, change, standard errors, effect in mrad, and changed or same.
        """
        from gaponet.sysid.uncertainty import format_change

        changed = {change.joint for change in self.drift.moved}
        others = [c for joint, c in self.drift.largest.items() if joint not in changed]
        rows = []
        for change in (*self.drift.moved, *others):
            by = format_change(change.field, change.by, self.uncertainty, change.joint)
            row = [change.joint, change.field, by, f"{change.sigmas:+.1f}"]
            row += [f"{1e3 * change.moves:.2f}"]
            row += ["changed" if change.joint in changed else "same"]
            rows.append(row)
        return rows

    def to_dict(self) -> dict[str, Any]:
        drift = self.drift
        return {
            "verdict": self.verdict,
            "advice": self.advice,
            "recordings": self.recordings,
            "seconds": drift.seconds,
            "moved": [_plain(change) for change in drift.moved],
            "largest": {joint: _plain(change) for joint, change in drift.largest.items()},
            "against": [vars(found) for found in drift.against],
            "threshold": drift.threshold,
            "far": drift.far,
        }


def _plain(change: ParameterChange) -> dict[str, Any]:
    return {**vars(change), "sigmas": change.sigmas}


@dataclass(frozen=True, kw_only=True)
class ReplayResult:
    """Motion that the identified robot would make in rollouts of a policy.

    Attributes:
        joints: Operated joint → errors (rad) and share of time inside the band.
        differ: Joints that leave the band for too long, the worst first.
        rollouts: Targets, rollout, predicted motion and band of each rollout, (T, joints) rad.
        share: Share of the error distribution that the band holds.
        drawn: Number of parameter samples behind the band.
        band_from_recordings: False if the recordings are gone and the band comes from the robot
            folder.
    """

    robot: RobotSpec
    joints: Mapping[str, Mapping[str, Any]]
    differ: tuple[str, ...]
    rollouts: tuple[RolloutPrediction, ...] = field(repr=False)
    share: float
    drawn: int
    band_from_recordings: bool

    def save(self, path: Path) -> None:
        """Write target, rollout, robot, low and high of each rollout, (T, joints) rad, and dt, s,
        to an .npz file.
        """
        from gaponet.base.files import atomic_write

        arrays: dict[str, Any] = {
            "names": np.array([a.name for a in self.rollouts]),
            "joints": np.array(self.robot.operated),
        }
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
            "robot": self.robot.name,
            "rollouts": [a.name for a in self.rollouts],
            "joints": {j: dict(s) for j, s in self.joints.items()},
            "differ": list(self.differ),
            "band": {
                "share": self.share,
                "drawn": self.drawn,
                "from_recordings": self.band_from_recordings,
            },
        }


@dataclass(frozen=True, kw_only=True)
class ExportResult:
    """Files for another program.

    Attributes:
        path: Folder or file that was written.
        to: Program or format.
        robot: Name of the robot.
        errors: Form of the robot → mean |error| over the motions that judged it, rad; empty for a
            network.
        motions: Number of those motions.
        virtual: True if no real robot played them.
        own_motions: True if they were simulated for the export, because it has no recordings.
        notes: What the form leaves out, and what the user has to decide.
        parity: Largest difference between the file and the trained network, rad; None for a robot.
        check: Script that checks the export in the other program without gaponet; None where there
            is none.
        checked_in: Program in which it runs.
    """

    path: Path
    to: str
    robot: str
    errors: Mapping[str, float] = field(default_factory=dict)
    motions: int = 0
    virtual: bool = False
    own_motions: bool = False
    notes: tuple[str, ...] = ()
    parity: float | None = None
    check: Path | None = None
    checked_in: str = ""

    def to_dict(self) -> dict[str, Any]:
        if self.parity is not None:
            return {"path": str(self.path), "to": self.to, "parity_rad": self.parity}
        return {
            "path": str(self.path),
            "to": self.to,
            "robot": self.robot,
            "left": dict(self.errors),
            "motions": self.motions,
            "virtual": self.virtual,
            "own_motions": self.own_motions,
            "notes": list(self.notes),
        }


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
            "motions": list(self.motions),
            "minutes": self.minutes,
            "payloads": list(self.payloads),
            "sheet": str(self.sheet),
        } | prediction


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Standard errors of an identified robot's parameters, before and after further motions.

    Attributes:
        before, after: Joint → servo field → standard error, SI.
        useful_seconds: Playing time after which half a minute more reduces the errors by less than
            5 %.
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
            "errors": self.before,
            "errors_then": self.after,
            "worth_seconds": self.useful_seconds,
            "open": dict(self.undetermined),
            "played": [list(pair) for pair in self.played],
        }


@dataclass(frozen=True, kw_only=True)
class RunResult:
    """One run on a robot.

    Attributes:
        recording: Readings, commands, events and timing of every control period.
        robot: The robot with its identified values.
        plan: Plan that was shown; None if live targets never had one.
        would_send: Commands of a dry run by joint: range (rad), speed (rad/s) and torque (N·m).
            Empty otherwise.
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
        """Joint that moved → mean |measured − target| over the run, rad; measured one period after
        the command.
        """
        recording = self.recording
        rows = recording.run_rows()
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
        """Return the tracking errors as JSON has them: empty if the run had fewer than two
        periods.
        """
        if len(self.recording.run_rows()) < 2:
            return {}
        return {"tracking_error_rad": {"mean": self.mean_tracking_error} | self.tracking_error}
