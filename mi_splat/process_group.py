"""A process that is watched together with all that it starts: they share limits, and
they end together.

The process leads a session of its own, so that one signal reaches its whole group. Its
temporary files lie in a folder that is removed with it, and when the process that
watches it ends, it ends its group itself.
"""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import re
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

from mi_splat.processes import python_command

_Message = TypeVar("_Message")

_MEMBER = "mi_splat.group_member"  # what its first process runs
_LOOK = 0.1  # seconds between two looks at the memory of a group
# seconds in which a process that has closed its pipe may end by itself
_LAST_BREATH = 2.0
_MOMENT = 0.01  # seconds between two looks at processes that were killed
_SHOWN = 2000  # characters of what a process said last
# and not TMPDIR: what it names is deleted, and must be ours
GROUP_FOLDER = "MI_SPLAT_GROUP_FOLDER"


class GroupEndedError(Exception):
    """A group has ended or has broken a limit; the text says how."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What a process and all that it starts may use together; None is without a
    limit.
    """

    seconds: float | None = None
    megabytes: float | None = None  # resident, 1e6 bytes each


class ProcessGroup:
    """A Python module that runs in a session of its own, at the other end of a pipe.

    The module gets the words, and then the number of the descriptor of its end of the
    pipe; see `inbox`.

    Attributes:
        pipe: This end of the pipe.
        folder: Folder for the temporary files of the group.
    """

    def __init__(
        self, module: str, *words: str, environment: Mapping[str, str] | None = None
    ) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="mi-splat-"))
        self._output = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the group
        self._looked = 0.0
        self._closing = threading.Lock()
        self._is_closed = False
        folder = str(self.folder)
        self.pipe, end = Pipe()
        with end:
            self._process = subprocess.Popen(
                python_command(_MEMBER, module, *words, str(end.fileno())),
                env={
                    **os.environ,
                    **(environment or {}),
                    "TMPDIR": folder,
                    GROUP_FOLDER: folder,
                },
                stdin=subprocess.DEVNULL,
                stdout=self._output,
                stderr=self._output,
                start_new_session=True,
                pass_fds=[end.fileno()],
            )

    @property
    def is_running(self) -> bool:
        """Whether the first process of the group has not ended."""
        return self._process.poll() is None

    def wait(self, limits: Limits, since: float) -> None:
        """Wait until the pipe has a message, or its end.

        Args:
            limits: What the group may use meanwhile.
            since: When its time began, as `time.monotonic` counts.

        Raises:
            GroupEndedError: A limit was broken, or the pipe is gone.
        """
        while True:
            self._check(limits, since)
            try:
                if self.pipe.poll(_LOOK):
                    return
            except OSError as error:
                raise self.ended() from error

    def _check(self, limits: Limits, since: float) -> None:
        now = time.monotonic()
        if limits.seconds is not None and now - since > limits.seconds:
            raise GroupEndedError(f"ran longer than {limits.seconds:g} s")
        if limits.megabytes is None or now - self._looked < _LOOK:
            return
        self._looked = now
        used = self.megabytes()
        if used > limits.megabytes:
            raise GroupEndedError(
                f"used {used:,.0f} MB of memory, more than {limits.megabytes:,.0f}"
            )

    def megabytes(self) -> float:
        """Resident memory of all processes of the group together, in 1e6 bytes."""
        return sum(members(self._process.pid).values()) / 1e6

    def is_alone(self) -> bool:
        """Whether the group has no other process than its first one."""
        return members(self._process.pid).keys() <= {self._process.pid}

    def ended(self) -> GroupEndedError:
        """How a process that has closed its pipe ended, and what it said last."""
        self._wait()
        self.kill()
        self._wait()
        status = self._process.returncode
        if status is None:
            return GroupEndedError("does not end, not even by SIGKILL")
        if status >= 0:
            how = f"ended with status {status}"
        else:
            how = f"ended by {signal.Signals(-status).name}"
        self._output.seek(max(0, self._output.seek(0, os.SEEK_END) - _SHOWN))
        said = self._output.read().decode("utf-8", "replace").strip()
        return GroupEndedError(f"{how}: {said}" if said else how)

    def kill(self) -> None:
        """End every process of the group at once."""
        if self._is_closed:  # its number may be that of another group by now
            return
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)

    def _wait(self) -> None:
        """Give the first process time to end: one that waits for a disk that hangs
        cannot be killed at once.
        """
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_LAST_BREATH)

    def _wait_for_others(self) -> None:
        """Give processes that were killed time to go: a busy machine takes a while."""
        deadline = time.monotonic() + _LAST_BREATH
        while members(self._process.pid) and time.monotonic() < deadline:
            time.sleep(_MOMENT)

    def close(self) -> None:
        """End the group, and remove what it leaves."""
        with self._closing:
            if self._is_closed:
                return
            self.kill()
            self._is_closed = True
            self._wait()
            self._wait_for_others()
            self.pipe.close()
            self._output.close()
        shutil.rmtree(self.folder, ignore_errors=True)


def members(group: int) -> dict[int, int]:
    """Resident bytes of every process of a group by its number."""
    if not os.path.isdir("/proc/self"):
        return _members_by_ps(group)
    page = os.sysconf("SC_PAGE_SIZE")
    found: dict[int, int] = {}
    for name in os.listdir("/proc"):
        if not name.isdecimal():
            continue
        with contextlib.suppress(OSError):  # it has ended meanwhile
            text = Path("/proc", name, "stat").read_bytes()
            # The name of the program, in brackets, may hold blanks and brackets itself.
            state, _parent, its_group, *rest = text[text.rindex(b")") + 2 :].split()
            if int(its_group) == group and state != b"Z":
                found[int(name)] = int(rest[18]) * page
    return found


def _members_by_ps(group: int) -> dict[int, int]:
    command = ["ps", "-axo", "pid=,pgid=,rss="]
    shown = subprocess.run(command, capture_output=True, text=True, check=False).stdout
    rows = [[int(word) for word in line.split()] for line in shown.splitlines()]
    return {
        process: 1024 * size for process, its_group, size in rows if its_group == group
    }


_ENDINGS = "endings.log"  # of a group's folder: how its processes have ended


def log_endings(logger: str) -> None:
    """Write what a logger says of this group where `ending_of` reads it."""
    path = Path(os.environ[GROUP_FOLDER], _ENDINGS)
    logging.getLogger(logger).addHandler(logging.FileHandler(path))


def ending_of(process: int) -> str:
    """How a process of this group has ended, in words; empty if nothing is known."""
    path = Path(os.environ.get(GROUP_FOLDER, ""), _ENDINGS)
    end = time.monotonic() + _LAST_BREATH
    found = ""
    while path.is_file() and not found and time.monotonic() < end:
        lines = path.read_text("utf-8").splitlines()
        found = "\n".join(x for x in lines if re.search(rf"\b{process}\b", x))
        time.sleep(_LOOK)
    if "memory" in found:
        return "used more memory than it may"
    number = re.search(r"by signal (\d+)", found)
    if number is None:
        return found
    return f"ended by {signal.Signals(int(number[1])).name}"


def inbox(receive: Callable[[], _Message]) -> queue.SimpleQueue[_Message]:
    """What comes through the pipe of this process; it ends with its group when nobody
    watches any more.
    """
    messages: queue.SimpleQueue[_Message] = queue.SimpleQueue()

    def listen() -> None:
        while True:
            try:
                messages.put(receive())
            except (EOFError, OSError):
                end_own_group()

    threading.Thread(target=listen, daemon=True).start()
    return messages


def end_own_group() -> None:
    """End this process and all that it started, and remove their temporary files."""
    if os.getpgrp() == os.getpid():  # else whoever started us by hand would end, too
        shutil.rmtree(os.environ.get(GROUP_FOLDER, ""), ignore_errors=True)
        os.killpg(0, signal.SIGKILL)
    os._exit(1)


def limit_file_size(megabytes: float) -> None:
    """Let this process, and those that it will start, write no file longer than so many
    1e6 bytes.
    """
    limit("RLIMIT_FSIZE", round(megabytes * 1e6))


def limit(name: str, most: int) -> None:
    """Set a limit of this process by its name in `resource`, where the system knows
    it.
    """
    import resource

    kind: Any = getattr(resource, name, None)
    if kind is None:
        return
    hard = resource.getrlimit(kind)[1]
    lowest = most if hard == resource.RLIM_INFINITY else min(most, hard)
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(kind, (lowest, lowest))


def connection(number: str) -> Connection:
    """The end of the pipe in the process that was started."""
    return Connection(int(number))
