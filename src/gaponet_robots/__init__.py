"""The part that moves robots, real or virtual: motions, drivers, controller, virtual robots, collecting.

What it offers to gaponet (gaponet.parts); nothing is imported here.
"""

COMMANDS = {name: f"gaponet_robots.cli.{name}:{name}" for name in ("excite", "collect", "run", "record", "virtual")}
PROVIDES = {
    "listening to a robot": "gaponet_robots.cli.link:listen",
    "collision shapes": "gaponet_robots.motion.collision:Collision",
    "motions": "gaponet_robots.motion.library:Library",
}
NAMES = {
    "Controller": "gaponet_robots.control.controller:Controller",
    "RemoteRobot": "gaponet_robots.targets.client:RemoteRobot",
}
