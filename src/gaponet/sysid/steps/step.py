"""What every step of an identification takes and returns."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.robot.spec import RobotSpec
from gaponet.sim.links import LinkResult
from gaponet.sysid.acceptance import Judge, Links
from gaponet.sysid.axes import Values
from gaponet.sysid.problem import JointFit, RobotFit
from gaponet.sysid.search_progress import SearchProgress
from gaponet.sysid.steps.link_fit import LinkFit


@dataclass(frozen=True)
class Fits:
    """What is fitted, and what judges. Lists have an item for each set of fitted recordings.

    Attributes:
        recordings: The sets: of each fold, and then of all recordings if there are several folds.
        given: The robot to start from.
        joints: Fits of every joint by itself.
        judge: Motions that were not fitted.
        progress: Progress and time of the searches.
        nthread: Threads; 0 for all cores.
    """

    recordings: list[list[Sequence]]
    given: RobotSpec
    joints: list[JointFit]
    judge: Judge
    progress: SearchProgress
    nthread: int


@dataclass(frozen=True)
class FitState:
    """Result of the steps so far. Lists have an item for each set of fitted recordings.

    Attributes:
        chosen: Name of the classic candidate that the judge chose.
        values: Its values with the steps that were accepted, (n,) each; the judge compares them.
        base: Values from which the next step is fitted: `values`, but where the given robot was
            chosen those of the best fit.
        robots: Fits in the simulator of the whole robot; their prior is that of the joints' fits.
        together: Whether a fit of all joints together helps.
        links: Links, if they were fitted and accepted; nothing else.
        link_fit: Fit of the links to the last set, and its result.
        gaps: Widths of backlash, rad, and their probabilities, (n,) each, if it was fitted;
            accepted or not.
    """

    chosen: str
    values: list[Values]
    base: list[Values]
    robots: list[RobotFit]
    together: bool
    links: list[Links] = field(default_factory=list)
    link_fit: tuple[LinkFit, LinkResult] | None = None
    gaps: tuple[Array, Array] | None = None

    def after(self, proposed: FitState, *, accepted: bool) -> FitState:
        """Return the proposed state if it is accepted, else this one; what was seen of backlash
        stays known.
        """
        return proposed if accepted else replace(self, gaps=proposed.gaps)


class Step(Protocol):
    """One thing that a simulator may lack.

    A new one is a class in a file of this folder, a line in `_makers_of_steps` of
    sysid/identify.py, and an option in sysid/options.py, which api/options.py passes on. A step
    that fits something else than `values` and `links` also needs a place for it in `FitState`, and
    in what the judge simulates (`Judge.errors`, `RobotRollouts.flat_errors`).

    The steps share the time equally: `propose` may call `SearchProgress.begin_search` once for each
    set of recordings, and no more.
    """

    name: str

    def applies(self, state: FitState) -> bool:
        """Return whether it is worth a search."""

    def propose(self, state: FitState) -> FitState:
        """Return the state with it, fitted."""

    def warnings(self, state: FitState) -> list[str]:
        """Return what the user has to know about it in the final state."""
