"""`python -m attacks`: the same as the console script `mi-splat`."""

import atexit
import contextlib
import os
import sys


def run() -> None:
    """Run a command and exit without tearing down torch, which would take a fifth of a
    second.
    """
    _open_closed_streams()
    from mi_splat.processes import INTERRUPTED, leave_on_signals

    leave_on_signals()  # before and after the command, which handles them itself
    status: list[int] = []

    def leave() -> None:
        if status:  # not after an error that is not ours
            # the command has said so already
            with contextlib.suppress(OSError, ValueError):
                sys.stdout.flush()
            os._exit(status[0])

    atexit.register(leave)  # first, so that it is called last
    from attacks.cli import main

    try:
        status.append(main())
    except KeyboardInterrupt:
        # a second one, while the command was saying that it was interrupted
        os._exit(INTERRUPTED)
    sys.exit(status[0])


def _open_closed_streams() -> None:
    """Take the numbers 0 to 2 where they are free, so that no file that is opened later
    is written to as one of them.

    What is written to a standard output that is closed fails, as it should; a standard
    error that is closed is not missed.
    """
    for number, mode in enumerate((os.O_RDONLY, os.O_RDONLY, os.O_WRONLY)):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, mode)
    if sys.stdout is None:
        # to the end of the process
        sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115
    if sys.stderr is None:
        sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115 - likewise


if __name__ == "__main__":
    run()
