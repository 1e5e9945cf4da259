"""Locks: files that one process has at a time, so that two jobs never write into the same folder.

The system gives a lock up when its process ends, however it ends; the file is removed at the end of the block, and one
that a kill left behind locks nothing. Disks without locks give none: the block then runs without. (The package
`filelock` says nothing of who has a lock, and its newest version needs Python 3.11.)
"""

import contextlib
import json
import os
import platform
import shlex
import stat
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mi_splat.io.atomic import LOCK, try_lock
from mi_splat.io.errors import SplatFileError, from_os_error
from mi_splat.io.parsing import DocumentReader

_HELD: dict[str, int] = {}
"""Folders that this process has for itself, and the thread that took each."""


class LockedError(SplatFileError):
    """Another process has what was to be locked."""


@contextlib.contextmanager
def locked_folder(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Have a folder for this process alone, made if need be; a thread may take what it has already once more."""
    key = os.path.realpath(folder)
    if _HELD.get(key) == threading.get_ident():
        yield
        return
    missing = [parent for parent in (Path(key), *Path(key).parents) if not os.path.lexists(parent)]
    try:
        os.makedirs(key, exist_ok=True)
    except OSError as error:
        raise from_os_error(os.fspath(folder), "a folder that can be written", error) from error
    try:
        with locked_file(os.path.join(key, LOCK), os.fspath(folder)):
            _check_links(key)
            _HELD[key] = threading.get_ident()
            try:
                yield
            finally:
                del _HELD[key]
    finally:
        with contextlib.suppress(OSError):  # they are not empty
            for parent in missing:
                parent.rmdir()


def check_unlocked(folder: str | os.PathLike[str]) -> None:
    """Raise if another process has a folder for itself."""
    if os.path.lexists(os.path.join(folder, LOCK)):
        with locked_folder(folder):
            pass


@contextlib.contextmanager
def locked_file(file: str, what: str) -> Iterator[None]:
    """Have a file, made if need be, for this process alone; `what` it stands for is named in errors."""
    try:
        descriptor = _locked(file, what)
    except OSError as error:
        raise from_os_error(what, "a folder that can be written", error) from error
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            os.unlink(file)
        os.close(descriptor)


def is_locked(file: str) -> bool:
    """Whether a process has a file; one that a kill left behind is removed."""
    if not os.path.lexists(file):
        return False
    try:
        with locked_file(file, file):
            return False
    except LockedError:
        return True


def _locked(file: str, what: str) -> int:
    """Lock a file and write into it who has it; returns it open."""
    while True:
        try:
            descriptor = os.open(file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o666)
        except OSError as error:
            raise (_foreign(file, "a symbolic link") if os.path.islink(file) else error) from error
        try:
            if try_lock(descriptor) is False:
                do, got = "wait for its end, or pass another folder", f"one in use by {_holder(descriptor)}"
                raise LockedError.of(what, "a folder that no other process writes into", got, do)
            if os.path.samestat(os.fstat(descriptor), os.stat(file)):
                _check_own(descriptor, file)
                os.ftruncate(descriptor, 0)
                os.pwrite(descriptor, json.dumps(_this_process()).encode(), 0)
                return descriptor
        except FileNotFoundError:  # who had it removed it, between two of our calls
            pass
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)


def _check_own(descriptor: int, file: str) -> None:
    """Raise unless a lock is a file that this program made: only such a one is overwritten, and later removed."""
    status = os.fstat(descriptor)
    if not stat.S_ISREG(status.st_mode) or status.st_nlink != 1:
        raise _foreign(file, "a special file or a second name of another file")
    if status.st_size and _record(descriptor) is None:
        raise _foreign(file, "a file of something else")


def _foreign(file: str, got: str) -> SplatFileError:
    return SplatFileError.of(file, "a lock of this program", got, "delete it, or pass another folder")


def _check_links(folder: str) -> None:
    """Raise if a link in a folder leads out of it: what is written below would be written there."""
    for parent, folders, files in os.walk(folder):
        for path in (os.path.join(parent, name) for name in (*folders, *files)):
            if os.path.islink(path) and not Path(os.path.realpath(path)).is_relative_to(folder):
                do = "put what it leads to in its place, or pass another folder"
                raise SplatFileError.of(path, "a file or a folder", "a link that leads out of the folder", do)


def _this_process() -> dict[str, object]:
    name = os.path.basename(sys.argv[0]) if sys.argv else ""
    command = ["mi-splat" if name == "__main__.py" else name, *sys.argv[1:]]
    since = time.strftime("%Y-%m-%d %H:%M:%S")
    return {"host": platform.node(), "process": os.getpid(), "command": shlex.join(command)[:300], "since": since}


def _holder(descriptor: int) -> str:
    """Who has the lock, in words, as far as the file says."""
    if (record := _record(descriptor)) is None:
        return "another process"
    return f"`{record['command']}`, process {record['process']} on {record['host']}, since {record['since']}"


def _record(descriptor: int) -> dict[str, Any] | None:
    """What a lock says of who took it; None if it says nothing of the kind."""
    try:
        record = DocumentReader().json_object(os.pread(descriptor, 4096, 0), "lock")
    except (OSError, ValueError):
        return None
    return record if _this_process().keys() <= record.keys() else None
