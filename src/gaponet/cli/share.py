"""gaponet push, pull."""

from __future__ import annotations

from typing import Annotated

import tyro

from gaponet.base.text import remove_credentials
from gaponet.cli.options import Flag, Folder, Json, like
from gaponet.cli.out import Out
from gaponet.share import move

Address = Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="ADDRESS")]


@like(move.push)
def push(
    path: Folder, address: Address, private: Flag = False, replace: Flag = False, prune: Flag = False,
    json: Json = False,
) -> None:  # fmt: skip
    """Put a dataset or a run onto the Hugging Face Hub or a bucket."""
    screen = Out(json)
    moved, shown = move.push(path, address, private, replace, prune), remove_credentials(address)
    screen.say(f" of {moved.files} files, {moved.size / 1e6:,.1f} MB, is now at {shown}", moved.kind)
    if prune:
        screen.say(f"{moved.pruned} files of earlier pushes were deleted")
    screen.say(f"Back: gaponet pull {shown} {path.name}")
    screen.result({"kind": moved.kind, "address": shown, "files": moved.files, "bytes": moved.size,
                   "pruned": moved.pruned})  # fmt: skip


@like(move.pull)
def pull(address: Address, out: Folder, json: Json = False) -> None:
    """Fetch a dataset or a run, every file checked by its hash."""
    screen = Out(json)
    moved = move.pull(address, out)
    if moved.files:
        screen.say(f" of {moved.files} files, {moved.size / 1e6:,.1f} MB; all hashes are right: {out}", moved.kind)
    else:
        screen.say(f"nothing is there that {out} lacks")
    screen.result({"kind": moved.kind, "path": str(out), "files": moved.files, "bytes": moved.size})
