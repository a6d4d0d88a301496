"""`gaponet virtual serve`: a virtual robot on a real bus."""

from __future__ import annotations

import signal
import sys
from typing import Annotated, Literal

import tyro

from gaponet.api.virtual_robot import VirtualOptions, serve_virtual_robot
from gaponet.cli.out import Out

# End it as Ctrl-C does. By name: Windows has only the first.
END_SIGNALS = ("SIGTERM", "SIGHUP", "SIGQUIT")


def virtual(
    action: tyro.conf.Positional[Literal["serve"]],
    options: Annotated[VirtualOptions, tyro.conf.arg(name="")] = VirtualOptions(),  # noqa: B008
) -> None:
    """Serve a VIRTUAL robot on a real bus, for run and record.

    Args:
        action: serve starts the robot.
        options: The robot and its bus.
    """
    screen = Out()

    def report(text: str) -> None:
        screen.say(text)
        sys.stdout.flush()  # whoever started us through a pipe waits for this line

    for number in signal.Signals:
        if number.name in END_SIGNALS:
            signal.signal(number, signal.default_int_handler)
    serve_virtual_robot(options, report=report)
