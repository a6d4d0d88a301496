"""Options of the public functions. The command line reads the same classes.

The docstring of a field is its command-line help. Options of a run on a robot are in
run_options.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from gaponet.base.errors import UsageError
from gaponet.data.importer import ImportOptions as ImportOptions
from gaponet.nn.config import ModelKind
from gaponet.robot.servo_fields import Term
from gaponet.sysid.options import IdentifyOptions as SearchOptions


@dataclass(frozen=True)
class IdentifyOptions:
    """What an identification fits, to which recordings, and from where it starts."""

    windows: int = 40
    """Number of 8 s rollouts that are fitted, taken evenly from the training motions."""
    terms: tuple[Term, ...] | None = None
    """Terms of the servo model to try; each is accepted only if validation motions improve.
    Default: limit if a joint reaches its stated torque limit; speed if it needs much of that torque
    while it moves fast; stribeck and load; backlash where a gap makes the rollouts better at
    otherwise equal values; temperature where it varies at equal gains and payload."""
    table: bool = True
    """Look for a table under the robot's tips ([[tip]] in robot.toml)."""
    threads: int = 0
    """0 for all cores."""
    budget: str | None = None
    """Time such as 60s or 4m that the fit may take, the table included; default no limit. What does
    not fit into it is left out and named in a warning. Results are the same on every machine only
    without a limit."""
    stops: bool = False
    """Add an end stop to joints that stayed behind several commands; otherwise they are
    reported."""
    masses: bool = False
    """Fit masses, centres of mass and inertias of the links too; accepted as a term is."""
    like: str | Path | None = None
    """Identified robot whose servos are the start and the prior, by joint name, mirrored name
    (left, right) or type of servo: another arm, another unit, another robot."""
    units: tuple[str, ...] = ()
    """Only these, pooled: one set of parameters for all of them; default: all others than
    --holdout-units."""
    holdout_units: tuple[str, ...] = ()
    """Units to leave out, as in training."""
    despite_errors: bool = False
    """Go on although the doctor finds an error in the recordings; the result keeps the errors."""

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
            UsageError: The budget is no time.
        """
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
    """Virtual units: hard, easy, shifted, unnamed, firm (hard at nine times the gains), or a .toml
    file."""
    recipe: str = "small"
    """demo (under a minute), small (about two), simlifter (30 h: 48 min on one core), arm (any
    robot), or a .toml file."""
    payloads: tuple[float, ...] = ()
    """kg per hand instead of the recipe's."""
    units: tuple[str, ...] = ()
    """Units of the fleet instead of the recipe's."""
    seed: int = 0
    """Seed of motions, noise and start states."""
    nproc: int = 0
    """Processes, or jobs at a time; 0 for one per core. More than one starts fresh interpreters: a
    script that calls this needs `if __name__ == "__main__":`."""


@dataclass(frozen=True)
class ExciteOptions:
    """Motions to play on a robot."""

    minutes: float | None = None
    """Total duration of the motions. 10 (default) suffice to identify gains, friction and delay, 40
    to train a good model. For an identified robot (--for) the default is half a minute."""
    payloads: tuple[float, ...] = (0.0,)
    """kg in each hand; every motion is played with each payload. With --for: payloads to choose
    from."""
    rate: float = 50.0
    """Commands per second, Hz."""
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
    network on validation gets the rest, and trees are chosen if they are still better. Default:
    that of the config."""
    holdout_units: tuple[str, ...] = ()
    """Units never trained on; their test motions stay in the test split."""
    resume: bool = False
    """Continue the run in that folder."""
    log: tuple[Literal["tensorboard", "wandb"], ...] = ()
    """Also write the training curve to TensorBoard event files in OUT/tensorboard, or to Weights &
    Biases."""
    despite_errors: bool = False
    """Go on although the doctor finds an error in the recordings; the result keeps the errors."""


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
