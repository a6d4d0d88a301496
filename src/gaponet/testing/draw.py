"""`python -m gaponet.testing.draw FLEET ROBOT`: draw a fleet's units again and write them into its file.

Run once after a distribution or the seed was changed; results from before belong to another fleet.
"""

from __future__ import annotations

import sys
import tomllib

from gaponet.base.errors import UsageError
from gaponet.base.files import write_text
from gaponet.base.structure import validated
from gaponet.robot.spec import load_robot
from gaponet.testing.fleet import FLEETS, UNITS, FleetTable, draw, known, to_toml

MARK = "\n# ---- drawn units ----\n"


def main(fleet: str, robot_name: str) -> None:
    """Keep everything above the mark, replace everything below."""
    path = FLEETS / f"{fleet}.toml"
    head = path.read_text(encoding="utf-8").split(MARK)[0]
    table = validated(FleetTable, tomllib.loads(head), path, UsageError)
    seed, laws = table["seed"], known(table["distribution"], path)
    robot = load_robot(robot_name)
    units = {f"virtual-{k}": draw(robot, laws, seed, k) for k in range(1, UNITS + 1)}
    write_text(path, head + MARK + to_toml(robot, units, laws))


if __name__ == "__main__":
    main(*sys.argv[1:])
