"""Adaptation of a trained model to one unit (one physical robot): a file per unit in
RUN/adaptation/.

Units differ in gain, damping, friction, zero offsets and delay. These servo parameters of the
simulator are fitted to half a minute of the unit's log, with the trained correction
(sysid/adapt.py). The network does not change.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

from annotated_types import Interval

from gaponet.base.errors import ModelError, UsageError
from gaponet.base.files import lock_folder, write_json
from gaponet.base.structure import read_json
from gaponet.data.sequence import Sequence
from gaponet.nn.artifact import GapModel
from gaponet.robot.spec import RobotSpec
from gaponet.sysid.adapt import FIELDS, Field, adapt

FOLDER = "adaptation"  # of a run


@dataclass(frozen=True)
class Adaptation:
    """Servo parameters of one unit.

    Attributes:
        weights: Hash of the model.onnx with which they were fitted.
        servos: Joint → kp N·m/rad, damping N·m·s/rad, frictionloss N·m, offset rad, delay s.
        logs: Content hashes of the recordings.
        seconds: Duration of the fitted windows.
        before, after: RMS error of the fitted windows, rad.
        doctor: What the doctor found in the recordings: despite_errors and warnings, a sentence
            each.
    """

    unit_id: str
    weights: str
    servos: dict[str, dict[Field, Annotated[float, Interval(ge=-1e6, le=1e6)]]]
    logs: tuple[str, ...]
    seconds: float
    before: float
    after: float
    doctor: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def robot(self, simulator: RobotSpec) -> RobotSpec:
        """Return the simulator with the parameters of this unit."""
        servos = {}
        for joint, servo in self.servos.items():
            servos[joint] = {str(field): value for field, value in servo.items()}
        return simulator.with_identified(servos)

    def save(self, run: Path) -> Path:
        """Write RUN/adaptation/UNIT.json and return its path.

        It replaces an earlier file of this unit.
        """
        path = run / FOLDER / f"{re.sub(r'[^A-Za-z0-9._-]', '_', self.unit_id)}.json"
        with lock_folder(run, "run"):
            path.parent.mkdir(exist_ok=True)
            write_json(path, asdict(self))
        return path

    @classmethod
    def fit(
        cls,
        model: GapModel,
        simulator: RobotSpec,
        sequences: ListOf[Sequence],
        seconds: float = 30.0,
        progress: Callable[[int, int, float], None] = lambda done, total, rms: None,
    ) -> Adaptation:
        """Fit the parameters of a unit, with the correction of a trained model.

        Args:
            sequences: Recordings of one unit. Windows of 8 s are taken from them evenly.
            progress: Same arguments as in sysid.adapt.

        Raises:
            UsageError: The recordings are of several units.
        """
        units = sorted({s.meta.unit_id for s in sequences})
        if len(units) != 1:
            raise UsageError(
                f"these recordings are of units {', '.join(units) or '(none)'}; give those of one "
                "unit"
            )
        fitted = adapt(sequences, simulator, seconds, model.corrector(simulator), progress)
        servos = {}
        for joint in simulator.operated:
            j = simulator.joint_names.index(joint)
            servos[joint] = {field: float(fitted.robot.servo[field][j]) for field in FIELDS}
        logs = tuple(s.content_hash() for s in sequences)
        weights = model.weights_hash()
        return Adaptation(units[0], weights, servos, logs, seconds, fitted.before, fitted.after)

    @classmethod
    def load(cls, run: Path, weights: str) -> dict[str, Adaptation]:
        """Read all adaptations of a run by unit.

        Raises:
            ModelError: A file is damaged, or belongs to another model than that with these weights.
        """
        adaptations = {}
        for path in sorted((run / FOLDER).glob("*.json")):
            adaptation = read_json(Adaptation, path, ModelError, "run gaponet adapt again")
            if adaptation.weights != weights:
                raise ModelError(
                    f"{path}: made for another model ({adaptation.weights}); delete it or run "
                    "gaponet adapt again"
                )
            adaptations[adaptation.unit_id] = adaptation
        return adaptations
