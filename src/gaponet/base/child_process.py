"""Command lines of child processes that never import modules from the current folder.

Python puts the current folder first on the path of `python -c` and `python -m`: a numpy.py beside
somebody's logs would be imported. A child runs isolated (-I). It receives this process's module
path, because an isolated Python ignores PYTHONPATH and the user's site-packages.
"""

from __future__ import annotations

import os
import sys

SAFE_PATH_VARIABLE = "PYTHONSAFEPATH"  # from 3.11 on, it keeps the current folder off Python's path
RUN_MODULE = (
    "import sys; sys.path[:] = sys.argv.pop(1).split('\\n'); import runpy; "
    "runpy.run_module(sys.argv.pop(1), run_name='__main__', alter_sys=True)"
)


def module_command(module: str, *arguments: str) -> list[str]:
    """Return the command line of `python -m MODULE ARGUMENTS …`, without modules of the current
    folder.
    """
    return [sys.executable, "-I", "-c", RUN_MODULE, "\n".join(_module_path()), module, *arguments]


def exclude_current_folder() -> None:
    """Import no module from the current folder from now on, here and in every Python that this
    process starts.
    """
    os.environ[SAFE_PATH_VARIABLE] = "1"
    sys.path[:] = _module_path()


def _module_path() -> list[str]:
    """Return sys.path without relative entries and the current folder, unless gaponet itself is
    installed there.
    """
    current = _real(".")
    home = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
    absolute = [path for path in sys.path if os.path.isabs(path)]
    if current == _real(home):
        return absolute
    return [path for path in absolute if _real(path) != current]


def _real(path: str) -> str:
    return os.path.normcase(os.path.realpath(path))
