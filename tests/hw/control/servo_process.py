"""Six servos on a pseudo-terminal in a process of their own. They say their port in a line; to each line that they are
given they answer with one of JSON: the torque enable of each servo."""

from __future__ import annotations

import json
import os
import select
import sys
import tty
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from servos import Servos


def main() -> None:
    """Until stdin ends."""
    servos, (master, slave) = Servos(), os.openpty()
    tty.setraw(slave)
    print(os.ttyname(slave), flush=True)
    while True:
        ready, _, _ = select.select([0, master], [], [])
        if master in ready:
            os.write(master, servos.answer(os.read(master, 4096)))
        if 0 in ready:
            if not os.read(0, 100):
                return
            print(json.dumps([servos.get(s, "torque") for s in range(1, 7)]), flush=True)


if __name__ == "__main__":
    main()
