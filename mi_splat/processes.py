"""How this library starts another Python: without the working directory among the folders that modules come from."""

import os
import sys

_START = (
    "import sys; sys.path[:] = sys.argv.pop(1).split(sys.argv.pop(1)); import runpy; "
    'runpy.run_module(sys.argv.pop(1), run_name="__main__", alter_sys=True)'
)


def python_command(module: str, *words: str) -> list[str]:
    """A command that runs a module as `python -m` does, with the import path of this process.

    `python -m` and `python -c` put the working directory first, where a downloaded `queue.py` may lie. `-P` does not,
    but Python 3.10 does not know it, and `-I` ignores the user's PYTHONPATH.
    """
    path = os.pathsep.join(folder for folder in sys.path if folder)
    return [sys.executable, "-c", _START, path, os.pathsep, module, *words]
