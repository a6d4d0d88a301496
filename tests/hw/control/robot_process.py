"""A virtual H1-2 on the bus in a process of its own, told what to do by lines on stdin, one JSON
answer each.

clear: forget what was heard. heard: the commands since.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

RATE = 100.0  # states per second: machines that run tests are busy


class RobotProcess:
    """The tests' end."""

    def __init__(self, domain: int) -> None:
        command = [sys.executable, __file__, str(domain)]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert self.ask("clear") == "ok"

    def ask(self, line: str) -> Any:
        """Answer to a line."""
        assert self.process.stdin
        assert self.process.stdout
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())

    def kill(self) -> None:
        """As a power cut would."""
        self.process.kill()
        self.process.wait()


def main(domain: int) -> None:
    from gaponet.robot.spec import load_robot
    from gaponet.virtual.fleet import load_fleet
    from gaponet.virtual.unitree_virtual import VirtualH12

    robot = load_robot("h1_2")
    served = VirtualH12(
        robot, load_fleet("easy", robot).unit("virtual-4"), (1.0, "both"), domain, rate=RATE
    )
    threading.Thread(target=served.run, daemon=True).start()
    for line in sys.stdin:
        answer: Any = "ok"
        if line.strip() == "clear":
            time.sleep(0.2)  # what the last controller sent is still on its way
            served.heard = []
        else:
            heard = list(served.heard)
            answer = {"kp": [row["kp"].tolist() for row in heard]}
            answer |= {name: [row[name] for row in heard] for name in ("weight", "time")}
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    sys.path.remove(str(Path(__file__).parent))
    main(int(sys.argv[1]))
