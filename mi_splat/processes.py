"""How this library starts another Python, and what a process does on Ctrl-C and
SIGTERM.
"""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from types import FrameType

INTERRUPTED = 130
TERMINATED = 143
"""Exit statuses of a process that Ctrl-C or SIGTERM has ended."""
_IMPORTING = 0.02  # seconds between two looks at whether an import is over


@contextmanager
def sigterm_as_interrupt() -> Iterator[Callable[[], int | None]]:
    """SIGTERM inside the block does what Ctrl-C would do.

    Neither of them breaks off the import of a module: half of a package cannot be
    imported a second time, and Python only prints what is raised in its own import
    locks. What came is raised when the import is over; a second signal before that ends
    the process.

    Yields:
        The exit status that the last signal asks for; None if none came.
    """
    came: list[int] = []

    def note_interrupt(number: int, frame: FrameType | None) -> None:
        came.append(INTERRUPTED)
        _interrupt(frame, came)

    def note_termination(number: int, frame: FrameType | None) -> None:
        came.append(TERMINATED)
        handler = signal.getsignal(signal.SIGINT)
        # It is ignored in a command that a script has put into the background, and it
        # is another one where a step is finished before the process ends.
        if callable(handler) and handler is not note_interrupt:
            handler(signal.SIGINT, frame)
        else:
            _interrupt(frame, came)

    is_ignored = signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    interrupts: AbstractContextManager[None] = nullcontext()
    if not is_ignored:
        interrupts = _handling(signal.SIGINT, note_interrupt)
    with interrupts, _handling(signal.SIGTERM, note_termination):
        yield lambda: came[-1] if came else None


def _interrupt(frame: FrameType | None, came: Sequence[int]) -> None:
    """Raise KeyboardInterrupt, or see to it that this is done once no module is being
    imported.
    """
    if not _is_importing(frame):
        raise KeyboardInterrupt
    if len(came) > 1:
        os._exit(came[-1])

    def again(number: int, later: FrameType | None) -> None:
        if _is_importing(later):
            signal.setitimer(signal.ITIMER_REAL, _IMPORTING)
        else:
            raise KeyboardInterrupt

    signal.signal(signal.SIGALRM, again)
    signal.setitimer(signal.ITIMER_REAL, _IMPORTING)


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def leave_on_signals() -> None:
    """End this process at once by Ctrl-C or SIGTERM, with their exit statuses and
    without a word.
    """
    statuses = {signal.SIGINT: INTERRUPTED, signal.SIGTERM: TERMINATED}
    for number in statuses:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(
                number, lambda number, frame: os._exit(statuses[signal.Signals(number)])
            )


@contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Ctrl-C inside the block is only noted, so that a step is never left half done; a
    second one stops at once.
    """
    pressed: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        pressed.append(INTERRUPTED)
        if len(pressed) > 1:
            _interrupt(frame, pressed[1:])

    with _handling(signal.SIGINT, note):
        yield lambda: bool(pressed)


@contextmanager
def _handling(
    number: signal.Signals, handler: Callable[[int, FrameType | None], None]
) -> Iterator[None]:
    """Handle a signal inside the block; only the main thread gets signals."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = signal.signal(number, handler)
    try:
        yield
    finally:
        signal.signal(number, previous)


def own_cores() -> list[int]:
    """Numbers of the cores that this process may use; none where the system cannot
    say.
    """
    if not hasattr(os, "sched_getaffinity"):
        return []
    return sorted(os.sched_getaffinity(0))


def share_of_cores(cores: Sequence[int], worker: int, workers: int) -> Sequence[int]:
    """Those of some cores that one of some workers may use."""
    if not cores:
        return ()
    return cores[worker % workers % len(cores) :: workers]


def keep_to(cores: Sequence[int]) -> None:
    """Keep every thread of this process to some cores, and Dr.Jit to as many threads.

    Two threads of Dr.Jit on one core take twice the time of one: they wait for each
    other without sleeping.
    """
    if not cores:
        return
    for thread in os.listdir("/proc/self/task"):
        with contextlib.suppress(ProcessLookupError):  # it has ended meanwhile
            os.sched_setaffinity(int(thread), cores)
    # else it counts the cores when it is imported
    if (drjit := sys.modules.get("drjit")) is not None:
        drjit.set_thread_count(len(cores))


_START = (
    "import sys; sys.path[:] = sys.argv.pop(1).split(sys.argv.pop(1)); import runpy; "
    'runpy.run_module(sys.argv.pop(1), run_name="__main__", alter_sys=True)'
)


def python_command(module: str, *words: str) -> list[str]:
    """A command that runs a module as `python -m` does, with the import path of this
    process.

    `python -m` and `python -c` put the working directory first, where a downloaded
    `queue.py` may lie. `-P` does not, but Python 3.10 does not know it, and `-I`
    ignores the user's PYTHONPATH.
    """
    path = os.pathsep.join(folder for folder in sys.path if folder)
    return [sys.executable, "-c", _START, path, os.pathsep, module, *words]
