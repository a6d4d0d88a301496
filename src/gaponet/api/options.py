"""Options of the public functions. The command line reads the same classes.

The docstring of a field is its command-line help. Options of a run on a robot are in
run_options.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from gaponet.base.errors import UsageError
from gaponet.base.structure import require_choice
from gaponet.data.importer import ImportOptions as ImportOptions
from gaponet.nn.config import ModelKind
from gaponet.robot.servo_fields import Term
from gaponet.sysid.options import IdentifyOptions as SearchOptions


@dataclass(frozen=True)
class IdentifyOptions:
    """What an identification fits, to which recordings, and from where it starts."""

    windows: int = 40
    """Number of rollouts of 8 s to fit; they are taken evenly from the training motions."""
    terms: tuple[Term, ...] | None = None
    """Effects of the servo model to try, in this order. Each is kept only if it reduces the error
    on validation motions. stribeck: more friction at rest. load: friction that grows with the
    torque of the motor. external: friction that grows with the torque of gravity. limit: largest
    torque. speed: largest torque that falls with speed. min_torque: least torque with which the
    motor turns. encoder: steps in which the servo reads its angle. backlash: play of the gear.
    temperature: effect of temperature on friction and damping. Default: limit if a joint reaches
    its stated torque limit; speed if it needs much of that torque while it moves fast; stribeck and
    load; backlash if a gap in the gear makes the simulated motion better while all else stays
    equal; temperature if it varies at equal gains and payload."""
    table: bool = True
    """Look for a table under the robot's tips ([[tip]] in robot.toml)."""
    threads: int = 0
    """Number of threads; 0 means all cores."""
    budget: str | None = None
    """Time that the whole fit may take, such as 60s or 4m. A warning names what was left out for
    lack of time. Results are the same on every machine only without a limit, which is the
    default."""
    stops: bool = False
    """Add an end stop where a joint stopped several times although its commands went on. Without
    this option such places are only reported."""
    masses: bool = False
    """Also fit masses, centres of mass and inertias of the links. They are kept only if they reduce
    the error on validation motions."""
    like: str | Path | None = None
    """Identified robot from whose servos the fit starts and which is its prior: another arm, unit
    or robot. Joints are matched by name, mirrored name (left, right) or servo type."""
    units: tuple[str, ...] = ()
    """Fit the recordings of these units alone, with one set of parameters for all of them. Default:
    all units but --holdout-units."""
    holdout_units: tuple[str, ...] = ()
    """Units whose recordings are not fitted."""
    despite_errors: bool = False
    """Go on although the doctor finds an error in the recordings. The result then contains the
    error."""

    def seconds(self) -> float | None:
        """Return the budget, s; None without a limit.

        Raises:
            UsageError: It is no time.
        """
        from gaponet.nn.training.config import Budget

        if self.budget is None:
            return None
        seconds = Budget.parse(self.budget).seconds
        if seconds is None:
            raise UsageError(f"--budget {self.budget}: give a time such as 60s or 4m")
        return seconds

    def searches(self) -> SearchOptions:
        """Return the options of the searches for parameters.

        Raises:
            UsageError: The budget is no time, or there is no such term.
        """
        for term in self.terms or ():
            require_choice("terms", term, get_args(Term))
        return SearchOptions(
            windows=self.windows,
            terms=self.terms,
            table=self.table,
            stops=self.stops,
            masses=self.masses,
            seconds=self.seconds(),
            nthread=self.threads,
        )

    def require_none_for_torque(self, dataset: str) -> None:
        """Refuse options that a robot which is driven by torque has no use for.

        Raises:
            UsageError: One of them is given.
        """
        given = (self.like, self.units, self.holdout_units, self.terms, self.stops, self.masses)
        if any(given):
            what = "--like, --units, --holdout-units, --terms, --stops and --masses"
            raise UsageError(f"{dataset} holds a robot that is driven by torque; leave out {what}")


@dataclass(frozen=True)
class CollectOptions:
    """Which motions of which virtual robots are recorded."""

    fleet: str | Path = "hard"
    """Fleet of virtual robots: hard, easy, shifted, unnamed, firm (hard with nine times the gains),
    or a .toml file."""
    recipe: str = "small"
    """Which motions are recorded, with which payloads and units: demo (takes under a minute), small
    (about two minutes), simlifter (30 h of recordings; 48 minutes on one core), arm (for any
    robot), or a .toml file."""
    payloads: tuple[float, ...] = ()
    """Payloads in each hand, kg, instead of those of the recipe."""
    units: tuple[str, ...] = ()
    """Units of the fleet, such as virtual-4, instead of those of the recipe."""
    seed: int = 0
    """Seed of motions, noise and start states."""
    nproc: int = 0
    """Number of processes, or of jobs at a time; 0 means one per core. With more than one, a Python
    script that calls this needs `if __name__ == "__main__":`."""


@dataclass(frozen=True)
class ExciteOptions:
    """Motions to play on a robot."""

    minutes: float | None = None
    """Total duration of the motions. 10 (default) suffice to identify gains, friction and delay, 40
    to train a good model. For an identified robot (--for) the default is half a minute."""
    payloads: tuple[float, ...] = (0.0,)
    """Payloads in each hand, kg. Every motion is played with each of them. With --for: payloads to
    choose from."""
    rate: float = 50.0
    """Rate of the commands, Hz."""
    format: Literal["txt", "csv", "npz"] = "txt"
    """txt (SAGE, 50 Hz), csv (with time) or npz; gaponet run and record play each."""
    seed: int = 0
    """Seed of the random choice of motions."""


@dataclass(frozen=True)
class TrainOptions:
    """Which network is trained, to which units, and how its run is kept."""

    model: ModelKind | Literal["auto"] | None = None
    """gaponet, paper (the paper's literal network), or a baseline: shared_mlp, mlp, trees. auto:
    gaponet, shared_mlp, mlp and, with scikit-learn, trees get a fifth of the budget each. The best
    network on validation gets the rest, and trees are chosen if they are still better. None, in
    Python alone: the kind that config names."""
    holdout_units: tuple[str, ...] = ()
    """Units that are not trained on. Their test motions are still measured."""
    resume: bool = False
    """Continue the run in the folder OUT."""
    log: tuple[Literal["tensorboard", "wandb"], ...] = ()
    """Also write the training curve to TensorBoard event files in OUT/tensorboard, or to Weights &
    Biases."""
    despite_errors: bool = False
    """Go on although the doctor finds an error in the recordings. The result then contains the
    error."""


def parse_joint_map(pairs: tuple[str, ...]) -> dict[str, str] | None:
    """Return ("a=b",) as {"a": "b"}; None for nothing.

    Raises:
        UsageError: A pair is no pair, or a joint of the log has two names.
    """
    names: dict[str, str] = {}
    for pair in pairs:
        logged, equals, own = (part.strip() for part in pair.partition("="))
        if not (logged and equals and own) or "=" in own:
            raise UsageError(f"--map {pair}: write NAME_IN_LOG=NAME_OF_ROBOT")
        names[logged] = own
    if len(names) < len(pairs):
        raise UsageError(f"--map {' '.join(pairs)}: names one joint of the log twice")
    return names or None
