"""Every process of gaponet's own is started here: nothing that lies in the folder it is started from is ever run.

Python puts the current folder first on the path of `python -c` and `python -m`, so that a numpy.py among somebody's
logs would be imported. A child is isolated from that (-I) and told where this process finds its modules, since it then
neither reads PYTHONPATH nor looks into the user's own site-packages.
"""

from __future__ import annotations

import os
import sys

SAFE = "PYTHONSAFEPATH"  # what Python asks, from 3.11 on, before it puts the current folder first
BEGIN = (
    "import sys; sys.path[:] = sys.argv.pop(1).split('\\n'); import runpy; "
    "runpy.run_module(sys.argv.pop(1), run_name='__main__', alter_sys=True)"
)


def words(module: str, *given: str) -> list[str]:
    """The command line of a child that runs a module, as `python -m MODULE GIVEN …` would, and never the folder's."""
    return [sys.executable, "-I", "-c", BEGIN, "\n".join(_paths()), module, *given]


def _paths() -> list[str]:
    """Where modules may come from: absolute places, not the current folder, except where gaponet itself lies in it."""
    here, home = _real("."), os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
    return [p for p in sys.path if os.path.isabs(p) and (_real(p) != here or here == _real(home))]


def leave_folder() -> None:
    """Look for no module in the current folder from now on, neither here nor in whatever Python this process starts."""
    os.environ[SAFE] = "1"
    sys.path[:] = _paths()


def _real(path: str) -> str:
    return os.path.normcase(os.path.realpath(path))
