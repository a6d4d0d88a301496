"""gaponet push, pull."""

from __future__ import annotations

from typing import Annotated

import tyro

from gaponet.api import share
from gaponet.cli.options import Flag, Folder, Json, like
from gaponet.cli.out import Out

Address = Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="ADDRESS")]


@like(share.push)
def push(
    path: Folder,
    address: Address,
    private: Flag = False,
    replace: Flag = False,
    licence: str = "",
    trained_on: str = "",
    json: Json = False,
) -> None:
    """Put a dataset, a run or a robot onto the Hugging Face Hub."""
    screen = Out(json)
    result = share.push(path, address, private, replace, licence, trained_on)
    size = f"{result.files} files, {result.size / 1e6:,.1f} MB"
    screen.say(f" of {size}, is now at {address}", result.kind)
    screen.say(f"Back: gaponet pull {address} {path.name}")
    screen.result(
        {"kind": result.kind, "address": address, "files": result.files, "bytes": result.size}
    )


@like(share.pull)
def pull(address: Address, out: Folder, json: Json = False) -> None:
    """Fetch a dataset, a run or a robot, every file checked by its hash."""
    screen = Out(json)
    result = share.pull(address, out)
    if result.files:
        screen.say(
            f" of {result.files} files, {result.size / 1e6:,.1f} MB; all hashes are right: {out}",
            result.kind,
        )
    else:
        screen.say(f"nothing is there that {out} lacks")
    screen.result(
        {"kind": result.kind, "path": str(out), "files": result.files, "bytes": result.size}
    )
