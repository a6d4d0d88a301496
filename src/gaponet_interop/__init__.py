"""The part at the edge: other people's log and dataset formats, vendors' models, engines, and places to share through.

What it offers to gaponet (gaponet.parts); nothing is imported here.
"""

COMMANDS = {
    "start": "gaponet_interop.cli.start:start",
    "export": "gaponet_interop.cli.export:export",
    "robot": "gaponet_interop.cli.robot:robot",
    "replay": "gaponet_interop.cli.replay:replay",
    "torque": "gaponet_interop.cli.torque:torque",
    "attach": "gaponet_interop.cli.attach:attach",
    "push": "gaponet_interop.cli.share:push",
    "pull": "gaponet_interop.cli.share:pull",
    "prune": "gaponet_interop.cli.share:prune",
}
FORMATS = {
    name: f"gaponet_interop.formats.{name}" for name in ("lerobot", "bam", "rosbag", "hdf5", "mat", "pace", "asap")
}
WRITERS = {name: f"gaponet_interop.writers.{name}" for name in ("lerobot", "asap", "mcap")}
PROVIDES = {
    "dataset behind an address": "gaponet_interop.share.stream:Streamed",
    "strangers' pickles": "gaponet_interop.formats.pickles:load",
}
