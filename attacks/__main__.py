"""`python -m attacks`: the same as the console script `mi-splat`."""

import atexit
import contextlib
import os
import sys


def run() -> None:
    """Run a command and exit without tearing down torch, which would take a fifth of a second."""
    status: list[int] = []

    def leave() -> None:
        if status:  # not after an error that is not ours
            with contextlib.suppress(OSError):  # who reads has gone
                sys.stdout.flush()
            os._exit(status[0])

    atexit.register(leave)  # first, so that it is called last
    from attacks.cli import main

    status.append(main())
    sys.exit(status[0])


if __name__ == "__main__":
    run()
