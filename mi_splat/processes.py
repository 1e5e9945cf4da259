"""How this library starts another Python, and what a process does on Ctrl-C and SIGTERM."""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

INTERRUPTED, TERMINATED = 130, 143
"""Exit statuses of a process that Ctrl-C or SIGTERM has ended."""


@contextmanager
def sigterm_as_interrupt() -> Iterator[Callable[[], bool]]:
    """SIGTERM inside the block does what Ctrl-C would do; gives what says whether it came."""
    came: list[int] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        came.append(number)
        handler = signal.getsignal(signal.SIGINT)
        if not callable(handler):  # Ctrl-C is ignored, as in a command that a script has put into the background
            raise KeyboardInterrupt
        handler(signal.SIGINT, frame)

    with _handling(signal.SIGTERM, interrupt):
        yield lambda: bool(came)


@contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Ctrl-C inside the block is only noted, so that a step is never left half done; a second one stops at once."""
    pressed: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        if pressed:
            raise KeyboardInterrupt
        pressed.append(number)

    with _handling(signal.SIGINT, note):
        yield lambda: bool(pressed)


@contextmanager
def _handling(number: signal.Signals, handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Handle a signal inside the block; only the main thread gets signals."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = signal.signal(number, handler)
    try:
        yield
    finally:
        signal.signal(number, previous)


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
