"""What is particular to one unit, beside a model: a small file per unit in RUN/adaptation/.

No model can know a unit's gain, damping, friction, zero offsets and delay before it has seen the unit. They are fitted
to half a minute of its log, as servo parameters of the simulator under the trained correction (sysid/adapt.py); the
network stays as it is. If nobody weighed what the unit carried, its mass is fitted with them.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from annotated_types import Interval

from gaponet.base.errors import ModelError, UsageError
from gaponet.base.files import lock_folder, write_json
from gaponet.base.structure import read_json
from gaponet.data.sequence import Sequence
from gaponet.data.store import Dataset, Entry
from gaponet.nn.artifact import GapModel
from gaponet.robot.spec import RobotSpec
from gaponet.sysid.adapt import FIELDS, Field, adapt

FOLDERS = ("calibration", "adaptation")  # the former name, and the one that is written


@dataclass(frozen=True)
class Adaptation:
    """One unit's servo parameters.

    Attributes:
        weights: Hash of the model.onnx that they were fitted under.
        servos: Joint → kp N·m/rad, damping N·m·s/rad, frictionloss N·m, offset rad, delay s.
        logs: Content hashes of the recordings used.
        seconds: How many seconds of them.
        before, after: RMS error of the windows fitted, rad.
        payload_mass, payload_std: What the unit carried, kg, and its standard error, where nobody knew; else None.
    """

    unit_id: str
    weights: str
    servos: dict[str, dict[Field, Annotated[float, Interval(ge=-1e6, le=1e6)]]]
    logs: tuple[str, ...]
    seconds: float
    before: float
    after: float
    payload_mass: Annotated[float, Interval(ge=0, le=100)] | None = None
    payload_std: float | None = None

    def robot(self, simulator: RobotSpec) -> RobotSpec:
        """The simulator of this unit."""
        return simulator.with_servos({j: {str(f): x for f, x in servo.items()} for j, servo in self.servos.items()})

    def save(self, run: Path) -> Path:
        """RUN/adaptation/UNIT.json; an earlier one of this unit, of whatever model, is replaced."""
        path = run / FOLDERS[-1] / f"{re.sub(r'[^A-Za-z0-9._-]', '_', self.unit_id)}.json"
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
        unknown_payload: bool = False,
        progress: Callable[[int, int, float], None] = lambda done, total, rms: None,
    ) -> Adaptation:
        """Fit a unit's parameters under a trained model.

        Args:
            model: Its correction is applied while fitting.
            sequences: Recordings of one unit; windows of 8 s are taken from them evenly.
            unknown_payload: Fit the payload's mass too; all recordings carry the same, whatever they say.
            progress: The same as adapt's.
        """
        unit = _one_unit(sequences)
        found = adapt(sequences, simulator, seconds, unknown_payload, model.corrector(simulator), progress)
        servos = {
            j: {f: float(getattr(found.robot, f)[simulator.joint_names.index(j)]) for f in FIELDS}
            for j in simulator.operated
        }
        logs = tuple(s.content_hash() for s in sequences)
        return Adaptation(
            unit, model.weights_hash(), servos, logs, seconds, found.before, found.after, found.payload_mass,
            found.payload_std,
        )  # fmt: skip

    @classmethod
    def load(cls, run: Path, weights: str) -> dict[str, Adaptation]:
        """Unit → adaptation of this model; those of an earlier model in the same folder are refused."""
        found = {}
        for path in sorted(path for name in FOLDERS for path in (run / name).glob("*.json")):
            one = read_json(Adaptation, path, ModelError, "run gaponet adapt again")
            if one.weights != weights:
                raise ModelError(
                    f"{path}: made for another model ({one.weights}); delete it or run gaponet adapt again"
                )
            found[one.unit_id] = one
        return found

    @staticmethod
    def recordings(data: Dataset, model: GapModel, unit: str, motions: tuple[str, ...]) -> list[Entry]:
        """Recordings of a unit: of these motions, else of those that the model was trained on, else all.

        Raises:
            UsageError: No such unit, or none is named and the dataset holds several.
        """
        units = sorted({e.meta.unit_id for e in data.entries})
        if unit not in units and (unit or len(units) != 1):
            raise UsageError(f"--unit {unit or '(none)'}: {data.path} holds units {', '.join(units)}; name one")
        entries = [e for e in data.select(motions) if e.meta.unit_id == (unit or units[0])]
        trained = [e for e in entries if e.meta.motion in model.card["motions"]["train"]]
        return entries if motions else trained or entries


def _one_unit(sequences: ListOf[Sequence]) -> str:
    """The unit whose recordings these are."""
    units = sorted({s.meta.unit_id for s in sequences})
    if len(units) != 1:
        raise UsageError(f"these recordings are of units {', '.join(units) or '(none)'}; give those of one unit")
    return units[0]
