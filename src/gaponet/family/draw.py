"""A family: what simulators a model is trained in, and the members drawn from it."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from annotated_types import Interval

from gaponet.arrays import Array
from gaponet.errors import UsageError
from gaponet.robot import RobotSpec
from gaponet.structure import load_toml, validated

if TYPE_CHECKING:
    from gaponet.sim.batch import BatchSim, Condition

FOLDER = Path(__file__).parent
SOFT = 0.1  # of a factor: below it, less makes hardly a difference; 0 is drawn as any other
Factor = Annotated[float, Interval(ge=0, le=100)]
Factors = tuple[Factor, Factor]
OF_JOINTS = ("kp", "damping", "frictionloss", "armature")


@dataclass(frozen=True)
class Family:
    """Least and greatest factor of each of the nominal simulator's numbers; delay in s beyond the nominal one's."""

    kp: Factors = (1.0, 1.0)
    damping: Factors = (1.0, 1.0)
    frictionloss: Factors = (1.0, 1.0)
    armature: Factors = (1.0, 1.0)
    mass: Factors = (1.0, 1.0)
    delay: tuple[Annotated[float, Interval(ge=0, le=1)], Annotated[float, Interval(ge=0, le=1)]] = (0.0, 0.0)
    unladen: Annotated[float, Interval(ge=0, le=1)] = 0.0
    """Share of the simulators that do not have the robot's payload."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, tuple) and value[0] > value[1]:
                raise UsageError(f"{field.name}: {value[0]:g} to {value[1]:g} is no range; write the least first")
        for name in ("kp", "armature", "mass"):
            if not getattr(self, name)[0]:
                raise UsageError(f"{name}: a factor of 0 makes no simulator; give more")


def load_family(name_or_path: str | Path) -> Family:
    """A family of the package by name, or a file.

    Raises:
        UsageError: No such family, or the file is not one; with the file and what is wrong.
    """
    path, table = load_toml("family", FOLDER, name_or_path)
    return validated(Family, table, path, UsageError)


def scale(factor: Any) -> Any:
    """A factor on a scale from below 0 to above: nearly its logarithm, but finite at 0; 1 is 0."""
    return np.log((factor + SOFT) / (1 + SOFT))


@dataclass(frozen=True)
class Members:
    """Simulators of a family.

    Attributes:
        kp, damping, frictionloss, armature: Factors of the operated joints', (num, n).
        mass: Factor of all links', (num,).
        delay: Beyond the nominal simulator's, s, (num,).
        laden: Whether it has the robot's payload, (num,) bool.
    """

    kp: Array
    damping: Array
    frictionloss: Array
    armature: Array
    mass: Array
    delay: Array
    laden: Array

    @classmethod
    def draw(cls, family: Family, num: int, n: int, seed: int) -> Members:
        """num members for n operated joints; factors are uniform in `scale`, in half of them one for all joints."""
        rng = np.random.default_rng((seed, 0xFA))

        def draws(name: str, *shape: int) -> Array:
            low, high = (scale(x) for x in getattr(family, name))
            share = rng.random(shape)
            if len(shape) > 1:
                share[::2] = share[::2, :1]
            return np.exp(low + (high - low) * share) * (1 + SOFT) - SOFT

        joints = {name: draws(name, num, n) for name in OF_JOINTS}
        delay = rng.uniform(*family.delay, num)
        return cls(**joints, mass=draws("mass", num), delay=delay, laden=rng.random(num) >= family.unladen)

    def __getitem__(self, ids: Any) -> Members:
        return Members(**{f.name: getattr(self, f.name)[ids] for f in fields(self)})

    def __len__(self) -> int:
        return len(self.mass)

    def robot(self, nominal: RobotSpec) -> RobotSpec:
        """The nominal simulator with room for the longest delay; `put` makes it the members."""
        if nominal.has_law:
            raise UsageError(f"{nominal.folder}: a family is drawn around servos without a law; take the nominal robot")
        return replace(nominal, delay=nominal.delay + self.delay.max()) if self.delay.any() else nominal

    def conditions(self, told: ListOf[Condition]) -> list[Condition]:
        """Of the simulators, where the robots' are `told`."""
        return [c if own else c._replace(payload_mass=0.0) for c, own in zip(told, self.laden, strict=True)]

    def put(self, sim: BatchSim, nominal: RobotSpec) -> None:
        """Make every simulation of a batch, built from `robot(nominal)` and `conditions`, its member; once."""
        model, batch, joints = next(iter(sim.models.values())), sim.batch, sim.robot.operated
        dof = np.array([model.joint(j).dofadr[0] for j in joints])
        act = np.array([model.actuator(j).id for j in joints])
        links = [i for i in range(1, model.nbody) if not model.body(i).name.startswith("payload_")]
        gain, bias = batch.expand("actuator_gainprm"), batch.expand("actuator_biasprm")
        gain[:, act, 0] *= self.kp
        bias[:, act, 0] *= self.kp
        bias[:, act, 1] *= self.kp
        bias[:, act, 2] *= self.damping
        for name in ("damping", "frictionloss", "armature"):
            batch.expand(f"dof_{name}")[:, dof] *= getattr(self, name)
        for name in ("body_mass", "body_inertia", "body_subtreemass"):
            field = batch.expand(name)
            field[:, links] *= self.mass.reshape(-1, *[1] * (field.ndim - 1))
        if model.nhistory:
            late = nominal.delay[nominal.index(sim.joint_names)]
            batch.expand("actuator_delay")[:] = late + self.delay[:, None]
