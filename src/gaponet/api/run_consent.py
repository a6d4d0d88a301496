"""Consent to move a real robot: typed on the terminal, or given by the caller's program."""

from __future__ import annotations

from collections.abc import Callable

from gaponet.api.run_options import RunOptions
from gaponet.base.errors import UsageError
from gaponet.hw.control.consent import require_consent, require_terminal
from gaponet.hw.control.driver import Driver

Consent = Callable[[str], bool]  # statement of what will happen → True to let it happen
SWITCHED_OFF = {  # by Connection.joints, with topic lowcmd
    "arms": "legs and torso",
    "upper_body": "the legs",
    "all": "at the end of the run all motors",
}
# Where a consent comes from that was asked for.
TYPED = "typed on the terminal"
CALLED = "the caller's function"


class Permission:
    """Permission to move one robot in one run.

    A virtual robot in this process and a dry run need none. Any other robot needs `options.yes`, a
    True from the caller's function, or yes typed on the terminal.
    """

    def __init__(self, driver: str, options: RunOptions, consent: Consent | None) -> None:
        """
        Args:
            driver: Name of the driver.
            consent: Called with each statement that needs consent; it returns True to go on. None:
                the person at the terminal is asked.
        """
        self.driver = driver
        self.options = options
        self.consent = consent

    @property
    def source(self) -> str:
        """Where the consent to a motion comes from, in words for the recording."""
        if self.options.dry_run:
            return "none needed: dry run"
        if self.driver == "virtual":
            return "none needed: virtual robot in this process"
        if self.options.yes:
            return "option yes"
        return TYPED if self.consent is None else CALLED

    @property
    def needed(self) -> bool:
        """True if somebody must be asked before the robot moves."""
        return self.source in (TYPED, CALLED)

    def require_someone_to_ask(self) -> None:
        """Refuse a run whose consent nobody could give, before anything is opened.

        Raises:
            UsageError: There is neither a terminal nor a function.
        """
        if self.needed and self.consent is None:
            require_terminal("--yes (in Python: consent=FUNCTION or RunOptions(yes=True))")

    def require_hung(self) -> None:
        """Refuse topic lowcmd of the unitree driver unless somebody states that the robot hangs.

        This asks before anything is opened, so before there is a plan.

        Raises:
            UsageError: Nobody did.
        """
        options = self.options
        connection = options.connection
        if self.driver != "unitree" or connection.topic != "lowcmd":
            return
        if connection.hangs or options.dry_run:
            return
        off = SWITCHED_OFF[connection.joints]
        if options.yes:
            raise UsageError(
                f"with --topic lowcmd {off} go off, and a robot that stands falls; say --hangs if "
                "it hangs"
            )
        statement = f"With --topic lowcmd {off} go off: a robot that stands falls."
        self._ask(statement, question="Does it hang?", word="it hangs", option="--hangs")

    def require_motion(self, robot: Driver, how: str) -> None:
        """Return if the robot may move; the plan was shown before.

        Args:
            robot: The connected robot.
            how: What it will follow ("as planned").

        Raises:
            UsageError: Nobody consented.
        """
        if not self.needed:
            return
        place = robot.address
        interface = robot.facts.get("interface")
        if interface:  # the same address on another one is another robot
            place = f"{place} on {interface}"
        self._ask(
            f"{place} will move {how}; {len(robot.commanded)} joints are commanded.",
            question="Is the space around it free, and a hand on its own emergency stop?",
            word="yes",
            option="--yes",
        )

    def _ask(self, statement: str, question: str, word: str, option: str) -> None:
        if self.consent is None:
            require_consent(statement, question, word, option)
            return
        answer = self.consent(f"{statement} {question}")
        if answer is not True:
            raise UsageError(f"consent() returned {answer!r}, not True; nothing was commanded")
