"""Files that appear whole or not at all, and the temporary ones that killed programs left behind."""

from __future__ import annotations

import contextlib
import os
import platform
import re
import secrets
import shutil
import stat
import time
from collections.abc import Iterator
from typing import BinaryIO

from mi_splat.errors import message
from mi_splat.io.errors import SplatFileError, from_os_error

_HOST = re.sub(r"[^A-Za-z0-9-]", "-", platform.node()) or "host"
_TEMPORARY = re.compile(r"\.(?:(?P<host>[A-Za-z0-9-]+)\.(?P<process>\d+)\.)?[0-9a-f]{16}\.tmp")
_STALE_SECONDS = 24 * 3600.0
"""Age from which a temporary file of another machine counts as left behind."""


def temporary_name() -> str:
    """A name for a temporary file or folder, which says what process of what machine it belongs to."""
    return f".{_HOST}.{os.getpid()}.{secrets.token_hex(8)}.tmp"


def is_temporary(name: str) -> bool:
    """Whether a file name is one that `temporary_name` makes."""
    return _TEMPORARY.fullmatch(name) is not None


def sweep_temporary(folder: str | os.PathLike[str]) -> int:
    """Remove the temporary files and folders that killed programs of this project left in a folder.

    Left behind are those whose process has ended. Of another machine's it cannot be known; they go after a day.

    Args:
        folder: Where; one that is not there holds none.

    Returns:
        How many were removed.
    """
    removed = 0
    with contextlib.suppress(OSError):
        for entry in list(os.scandir(folder)):
            with contextlib.suppress(OSError):
                if _is_stale(entry):
                    shutil.rmtree(entry.path) if entry.is_dir(follow_symlinks=False) else os.unlink(entry.path)
                    removed += 1
    return removed


def _is_stale(entry: os.DirEntry[str]) -> bool:
    found = _TEMPORARY.fullmatch(entry.name)
    if found is None:
        return False
    if found["host"] == _HOST:
        return not _runs(int(found["process"]))
    return time.time() - entry.stat(follow_symlinks=False).st_mtime > _STALE_SECONDS


def _runs(process: int) -> bool:
    if os.name == "nt":  # there, signal 0 would end the process
        return True
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Write a file so that a crash, a kill or a full disk leaves the old file or the new one, never a part.

    The bytes go to a temporary file in the same folder, reach the disk, and take the name `path` in one step. The mode
    of a file that was there is kept; a symbolic link is followed. When the body raises, the temporary file is removed.

    Args:
        path: The file to write.

    Yields:
        The temporary file, open for unbuffered binary writing.

    Raises:
        SplatFileError: The folder is missing or cannot be written, `path` is no regular file, or the disk is full.
    """
    target = os.path.realpath(path)
    temporary = os.path.join(os.path.dirname(target), temporary_name())
    expected = "a file that can be written"
    try:
        mode = _mode(target)
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0)
        descriptor = os.open(temporary, flags, 0o666)
    except OSError as error:
        raise from_os_error(os.fspath(path), expected, error) from error
    try:
        with open(descriptor, "wb", buffering=0) as file:
            yield file
            if mode is not None:
                os.chmod(temporary, mode)
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except OSError as error:
        raise from_os_error(os.fspath(path), expected, error) from error
    finally:
        with contextlib.suppress(OSError):  # the error that led here is the one to report
            os.unlink(temporary)
    _sync_folder(os.path.dirname(target))


def write_all(file: BinaryIO, data: memoryview) -> None:
    """Write every byte of `data` to an unbuffered file, which may take only a part at a time."""
    rest = data.cast("B")
    while rest:
        rest = rest[file.write(rest) :]


def _mode(target: str) -> int | None:
    """Permission bits of the file that will be replaced, None if there is none."""
    try:
        status = os.stat(target)
    except FileNotFoundError:
        return None
    if not stat.S_ISREG(status.st_mode):
        kind = "a folder" if stat.S_ISDIR(status.st_mode) else "a special file"
        raise SplatFileError(message(target, "a regular file or a free name", kind, "save under another name"))
    if not os.access(target, os.W_OK):
        raise SplatFileError(
            message(target, "a file that can be written", "a read-only file", "save under another name")
        )
    return stat.S_IMODE(status.st_mode)


def _sync_folder(folder: str) -> None:
    """Bring the new name to the disk too, where the system can."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
