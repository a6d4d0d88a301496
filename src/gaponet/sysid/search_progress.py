"""Progress of an identification's searches, and the time that each may take."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.progress import Progress
from gaponet.sysid.joint_rollouts import ERROR_SCALE_RAD
from gaponet.sysid.problem import MAX_CHAIN_ITERATIONS, SEARCH_ITERATIONS

FIRST_ROBOT_ITERATIONS = 2  # of the whole robot, from both starts
ROBOT_ITERATIONS = 3  # of the whole robot afterwards, from the better one
POLISH_ITERATIONS = 2  # of the whole robot with a term of the servo model
JOINTS_TIME_SHARE = 0.3  # of a time budget
ROBOT_TIME_SHARE = 0.4
STEPS_TIME_SHARE = 0.3
TABLE_ITERATIONS = 20  # of all starts together; only the bar depends on it
# Of a time budget, for standard errors and comparisons after the searches.
END_TIME_SHARE = 0.15


class _PlannedSearch(NamedTuple):
    """A search of an identification: iterations at most, and its share of a time budget."""

    iterations: int
    time_share: float


class SearchProgress:
    """Progress of the searches; and the time that each may take, where the time is limited."""

    def __init__(
        self,
        seconds: float | None,
        steps: int,
        fits: int,
        progress: Progress,
    ) -> None:
        """Begin the time of the searches of so many steps after the classic fit, in so many fits.

        Args:
            seconds: Time for all of them, s; None for no limit.
            steps: Terms of the servo model, and the links.
            fits: Sets of recordings that are fitted.
            progress: Called with iterations done, in all, and what is fitted with its error.
        """
        of_joints = sum(SEARCH_ITERATIONS)
        of_robot = FIRST_ROBOT_ITERATIONS + ROBOT_ITERATIONS + MAX_CHAIN_ITERATIONS
        joints = _PlannedSearch(of_joints, JOINTS_TIME_SHARE)
        robot = _PlannedSearch(of_robot * fits, ROBOT_TIME_SHARE * fits)
        step = _PlannedSearch(of_joints + POLISH_ITERATIONS, STEPS_TIME_SHARE / (steps + 1))
        searches = [joints] * fits + [robot] + [step] * (fits * steps)
        # As much time as of one more step stays for the table.
        for_table = fits * step.time_share
        self._shares = []  # of the time that is left when a search begins
        for i, search in enumerate(searches):
            left = sum(later.time_share for later in searches[i:]) + for_table
            self._shares.append(search.time_share / left)
        iterations = [search.iterations for search in searches]
        self._last_of = np.cumsum(iterations).tolist()  # number of each search's last iteration
        self._total = self._last_of[-1] + TABLE_ITERATIONS
        self._began = time.monotonic()
        self._seconds = None if seconds is None else (1 - END_TIME_SHARE) * seconds
        self._progress = progress
        self._done = 0
        self._search = 0
        self._end = np.inf  # of the present search, s after the beginning
        self.show("inertias along the recordings")

    def show(self, what: str) -> None:
        """Report what comes next."""
        self._progress(min(self._done, self._total), self._total, what)

    def show_iteration(self, what: str) -> None:
        """Report one more iteration."""
        self._done += 1
        self.show(what)

    def begin_search(self) -> None:
        """Begin the next search, which may take its share of the time that is left."""
        elapsed = time.monotonic() - self._began
        left = np.inf
        if self._seconds is not None:
            left = max(self._seconds - elapsed, 0.0)
        self._end = elapsed + self._shares[self._search] * left
        self._done = self._last_of[self._search - 1] if self._search else 0
        self._search += 1

    def begin_table(self) -> None:
        """Begin the search of the table, which may take all the time that is left."""
        self._done = self._total - TABLE_ITERATIONS
        if self._seconds is not None:
            self._end = self._seconds

    def report_table(self, error: float) -> bool:
        """Report an iteration of the table's search and its RMS error, rad; return whether the
        time is over.
        """
        self.show_iteration(f"table: {1e3 * error:.2f} mrad RMS on fitted windows")
        return self.search_is_over()

    def search_is_over(self) -> bool:
        """Return whether the time of the present search is over."""
        return time.monotonic() - self._began > self._end

    def has_time_for(self, seconds: float) -> bool:
        """Return whether so many seconds are left for the present search."""
        return time.monotonic() - self._began + seconds <= self._end

    @property
    def is_limited(self) -> bool:
        """True if the time of all searches is limited."""
        return self._seconds is not None

    def all_is_over(self) -> bool:
        """Return whether the time of all searches is over."""
        return self._seconds is not None and time.monotonic() - self._began > self._seconds

    def reporter(
        self,
        what: str,
        joints: tuple[str, ...],
        rows: Array,
    ) -> Callable[[Array], bool]:
        """Return a function of the costs (n,) of problems of so many rows (n,), which says whether
        to end the search.

        It is called in each iteration.
        """

        def report(cost: Array) -> bool:
            rms = 1e3 * ERROR_SCALE_RAD * np.sqrt(2 * cost / np.maximum(rows, 1))  # (n,) mrad
            worst = int(rms.argmax())
            self.show_iteration(
                f"{what}: {rms.mean():.2f} mrad on fitted windows, {joints[worst]} {rms[worst]:.2f}"
            )
            return self.search_is_over()

        return report
