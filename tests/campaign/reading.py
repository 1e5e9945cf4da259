"""The process that reads damaged files: `python -m tests.campaign.reading DESCRIPTOR`.

It is the first of a `ProcessGroup`, which bounds its memory and time. It gets requests
through a pipe: a kind, a seed and the numbers of the mutants that it is to read. It
says each number before it reads, so that who watches it knows which mutant has ended
it, and then what was wrong.
"""

import contextlib
import io
import json
import os
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path
from random import Random
from types import FrameType
from typing import Any

import torch

from mi_splat.errors import MiSplatError
from mi_splat.process_group import connection, inbox, limit_file_size
from tests.campaign.bad import BAD
from tests.campaign.kind import Kind
from tests.campaign.kinds import KINDS
from tests.campaign.mutations import mutant

SECONDS = float(os.environ.get("MI_SPLAT_CPU_SECONDS", "20"))
"""CPU seconds that one mutant may take; the group has a limit of wall time besides."""
FILE_MEGABYTES = 100.0
LONGEST = 4000
"""Characters of a message."""
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_CHANGING = (
    "os.mkdir",
    "os.rename",
    "os.remove",
    "os.rmdir",
    "os.symlink",
    "os.link",
    "os.truncate",
    "os.chmod",
)
_STARTING = (
    "subprocess.Popen",
    "os.system",
    "os.exec",
    "os.posix_spawn",
    "os.fork",
    "socket.connect",
)
_FREE = ("/dev/null", "/proc/self/", "/dev/shm/")


class TooSlowError(BaseException):
    """A mutant took too long; no reader catches it."""


class Watch:
    """What Python does outside of the folder of this process while a mutant is read."""

    def __init__(self, folder: Path) -> None:
        self.folder = os.path.realpath(folder)
        self.may_start = False
        self.seen: list[str] | None = None
        sys.addaudithook(self._hear)

    @contextlib.contextmanager
    def on(self, *, may_start: bool) -> Iterator[list[str]]:
        """Note what happens inside the block."""
        seen: list[str] = []
        self.seen = seen
        self.may_start = may_start
        try:
            yield seen
        finally:
            self.seen = None

    def _hear(self, event: str, arguments: tuple[Any, ...]) -> None:
        if self.seen is None:
            return
        if event in _STARTING and not self.may_start:
            self.seen.append(f"{event} {arguments!r:.200}")
        elif event == "open" and arguments[2] & _WRITING:
            self._check(event, arguments[0])
        elif event in _CHANGING:
            for argument in arguments[:2]:
                self._check(event, argument)

    def _check(self, event: str, name: object) -> None:
        if not isinstance(name, str | bytes | os.PathLike):
            return
        path = os.path.abspath(os.fsdecode(name))
        if (
            not f"{path}/".startswith((f"{self.folder}/", *_FREE))
            and self.seen is not None
        ):
            self.seen.append(f"{event} {path}")


def whole(kind: Kind, folder: Path) -> tuple[Path, bytes]:
    """A valid file of a kind, and what it holds."""
    path = kind.make(folder)
    return path, path.read_bytes()


def mutated(kind: Kind, seed: int, number: int, data: bytes) -> bytes:
    """A mutant, always the same for its kind, seed and number."""
    random = Random(f"{seed} {kind.name} {number}")
    return mutant(data, random, kind.document, kind.packing)


def fault(kind: Kind, path: Path, data: bytes) -> str | None:
    """What a reader raises besides MiSplatError; None for a value or such an error."""
    path.write_bytes(data)
    torch.manual_seed(0)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        with (
            contextlib.redirect_stdout(io.StringIO()),
            contextlib.redirect_stderr(io.StringIO()),
        ):
            kind.read(path)
    except MiSplatError as error:
        return _fault_in_words(error)
    except (Exception, SystemExit, TooSlowError) as error:  # noqa: BLE001
        # these are what is looked for
        return _described(error)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    return None


def _fault_in_words(error: MiSplatError) -> str | None:
    """What is wrong with a message."""
    text = str(error)
    try:
        text.encode()
    except UnicodeEncodeError:
        return f"a message that cannot be printed: {error!r:.300}"
    if "expected " not in text:
        return f"a message that does not say what was expected: {text[:300]!r}"
    if len(text) > LONGEST:
        return f"a message of {len(text)} characters: {text[:300]!r}"
    return None


def _described(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    ours = [
        frame
        for frame in frames
        if "-packages" not in frame.filename and "tests" not in frame.filename
    ]
    last = (ours or list(frames))[-1]
    return (
        f"{type(error).__name__}: {str(error)[:300]!r} in"
        f" {last.filename}:{last.lineno}, {last.name}"
    )


def called(kind: Kind, path: Path) -> set[str]:
    """`module:function` of everything of this project that reads a valid file."""
    found: set[str] = set()

    def note(frame: FrameType, event: str, argument: object) -> None:
        module = frame.f_globals.get("__name__", "")
        if event == "call" and module.startswith(("mi_splat", "attacks")):
            found.add(f"{module}:{frame.f_code.co_name}")

    sys.setprofile(note)
    try:
        with (
            contextlib.redirect_stdout(io.StringIO()),
            contextlib.redirect_stderr(io.StringIO()),
        ):
            kind.read(path)
    finally:
        sys.setprofile(None)
    return found


def files_below(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def main() -> None:
    """Answer requests until nobody watches any more."""
    pipe = connection(sys.argv[1])
    messages = inbox(pipe.recv_bytes)
    folder = Path(tempfile.gettempdir())
    for name in ("HOME", "XDG_CACHE_HOME"):
        os.environ[name] = str(folder)
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    limit_file_size(FILE_MEGABYTES)
    signal.signal(signal.SIGPROF, _too_slow)
    watch = Watch(folder)

    def say(**message: Any) -> None:
        pipe.send_bytes(json.dumps(message).encode())

    say(state="ready")
    while True:
        request = json.loads(messages.get())
        answer(request, watch, folder, say)


def answer(request: dict[str, Any], watch: Watch, folder: Path, say: Any) -> None:
    """Read the mutants of one request."""
    kind = {**KINDS, **BAD}[request["kind"]]
    inside = folder / "kind" / "in"
    shutil.rmtree(inside.parent, ignore_errors=True)
    inside.mkdir(parents=True)
    os.chdir(inside.parent)
    try:
        path, data = whole(kind, inside)
        say(state="made", called=sorted(called(kind, path)))
    except Exception as error:  # noqa: BLE001  # a kind is wrong, and the others go on
        say(
            state="fault",
            number=-1,
            fault=f"a valid file cannot be read: {_described(error)}",
        )
        say(state="done")
        return
    others = {
        file: file.read_bytes()
        for file in inside.rglob("*")
        if file.is_file() and file != path
    }
    before = files_below(folder)
    for number in range(*request["numbers"]):
        say(state="at", number=number)
        with watch.on(may_start=kind.starts) as seen:
            raised = fault(kind, path, mutated(kind, request["seed"], number, data))
        faults = [
            *([raised] if raised else []),
            *(f"outside of its folder: {text}" for text in seen),
        ]
        after = files_below(folder)
        if after != before:
            faults.append(
                f"files that were left or are gone: {sorted(after ^ before)[:5]}"
            )
        faults += [
            f"{file.name} has changed"
            for file, content in others.items()
            if _differs(file, content)
        ]
        for text in faults:
            say(state="fault", number=number, fault=text)
        if len(faults) > (raised is not None):
            shutil.rmtree(inside.parent)
            inside.mkdir(parents=True)
            os.chdir(inside.parent)
            whole(kind, inside)
            before = files_below(folder)
    say(state="done")


def _differs(file: Path, content: bytes) -> bool:
    return not file.is_file() or file.read_bytes() != content


def _too_slow(number: int, frame: FrameType | None) -> None:
    raise TooSlowError(f"more than {SECONDS:g} CPU s")


if __name__ == "__main__":
    main()
