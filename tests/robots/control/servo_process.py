"""Six servos on a pseudo-terminal in a process of their own, which go wrong when told: python servo_process.py.

They say their port in a line. Each line they are given is a way to go wrong, or `ask`, which they answer with a line of
JSON: torque and goal of each servo, and how many goals they heard since they went wrong.
"""

from __future__ import annotations

import json
import os
import random
import select
import sys
import time
import tty
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from servos import Servos

LATE = 0.8  # s
rng = random.Random(1)


def change(servos: Servos, how: str) -> None:
    """Go wrong."""

    def spoil(reply: bytes) -> bytes:
        at = rng.randrange(len(reply))
        return reply[:at] + bytes([reply[at] ^ rng.randrange(1, 256)]) + reply[at + 1 :]

    servos.status[2] = 0
    if how in ("overload", "overheat", "voltage", "sensor"):
        servos.status[2] = {"voltage": 1, "sensor": 2, "overheat": 4, "overload": 32}[how]
    servos.adversary = {
        "dead": lambda servo, reply: b"" if servo == 4 else reply,
        "silent": lambda servo, reply: b"",
        "corrupt": lambda servo, reply: reply[:-1] + bytes([reply[-1] ^ 255]),
        "babble": lambda servo, reply: bytes(rng.randrange(256) for _ in range(600)),
        "lossy": lambda servo, reply: b"" if rng.random() < 0.03 else reply,
        "noisy": lambda servo, reply: spoil(reply) if rng.random() < 0.03 else reply,
    }.get(how, lambda servo, reply: reply)


def main() -> None:
    """Until stdin ends."""
    servos, (master, slave) = Servos(), os.openpty()
    tty.setraw(slave)
    print(os.ttyname(slave), flush=True)
    wrong, since, waiting = "", 0, []
    while True:
        due = max(0.0, waiting[0][0] - time.monotonic()) if waiting else None
        ready, _, _ = select.select([0, master], [], [], due)
        while waiting and waiting[0][0] <= time.monotonic():
            os.write(master, waiting.pop(0)[1])
        if master in ready:
            said = servos.answer(os.read(master, 4096))
            waiting.append((time.monotonic() + (LATE if wrong == "late" else 0.0), said))
        if 0 in ready:
            word = os.read(0, 100).decode().strip()
            if not word:
                return
            if word != "ask":
                wrong, since = word, len(servos.heard)
                change(servos, word)
                continue
            goals = [r for r in servos.heard[since:] if r[4] == 0x83 and r[5] == 42]
            state = {name: [servos.get(s, name) for s in range(1, 7)] for name in ("torque", "goal", "position")}
            print(json.dumps(state | {"goals": len(goals)}), flush=True)


if __name__ == "__main__":
    main()
