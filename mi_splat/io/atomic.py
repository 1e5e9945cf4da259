"""Files and folders that appear whole or not at all, and the temporary ones that killed programs left behind."""

import contextlib
import os
import platform
import re
import secrets
import shutil
import stat
import sys
import time
from collections.abc import Iterator
from typing import BinaryIO, Literal

from mi_splat.io.errors import SplatFileError, from_os_error


def _where_processes_have_numbers() -> str:
    """A name for this machine, and for its container where it has one: each counts processes by itself."""
    name = re.sub(r"[^A-Za-z0-9-]", "-", platform.node()) or "host"
    try:
        return f"{name}-{os.stat('/proc/self/ns/pid').st_ino}"
    except OSError:
        return name


HOST = _where_processes_have_numbers()
"""This machine, and its container where it has one: a number of a process means something within it alone."""
_TEMPORARY = re.compile(r"\.(?:(?P<host>[A-Za-z0-9-]+)\.(?P<process>\d+)\.)?[0-9a-f]{16}\.(?:tmp|old)")
LOCK = ".mi-splat.lock"
"""Name of the file in a folder that a process has for itself; see `mi_splat.io.locks`."""
_STALE_SECONDS = 24 * 3600.0
"""Age from which a temporary file of another machine counts as left behind."""


def temporary_name(ending: Literal["tmp", "old"] = "tmp") -> str:
    """A name for a temporary file or folder, which says what process of what machine it belongs to."""
    return f".{HOST}.{os.getpid()}.{secrets.token_hex(8)}.{ending}"


def is_temporary(name: str) -> bool:
    """Whether a file name is one that `temporary_name` makes, or that of a lock: what only running programs need."""
    return name == LOCK or _TEMPORARY.fullmatch(name) is not None


def sweep_temporary(folder: str | os.PathLike[str]) -> int:
    """Remove the temporary files and folders that killed programs of this project left in a folder.

    Left behind are those whose process has ended. Of another machine's it cannot be known; they go after a day. An
    older result that had given up its name, and whose name nothing has taken, gets it back.
    """
    removed = 0
    with contextlib.suppress(OSError):
        for entry in list(os.scandir(folder)):
            with contextlib.suppress(OSError):
                if _is_stale(entry):
                    _remove(entry)
                    removed += 1
    return removed


def _remove(entry: os.DirEntry[str]) -> None:
    if not entry.is_dir(follow_symlinks=False):
        os.unlink(entry.path)
    elif entry.name.endswith(".old"):
        _put_back(entry.path)
    else:
        shutil.rmtree(entry.path)


def _is_stale(entry: os.DirEntry[str]) -> bool:
    match = _TEMPORARY.fullmatch(entry.name)
    if match is None:
        return False
    if match["host"] == HOST:
        return not _runs(int(match["process"]))
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
    of a file that was there is kept; a symbolic link is replaced, and not what it leads to. When the body raises, the
    temporary file is removed.
    """
    target = os.path.abspath(path)
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
    sync_names(os.path.dirname(target))


def write_all(file: BinaryIO, data: memoryview) -> None:
    """Write every byte of `data` to an unbuffered file, which may take only a part at a time."""
    rest = data.cast("B")
    while rest:
        rest = rest[file.write(rest) :]


def replace_folder(new: str | os.PathLike[str], target: str | os.PathLike[str]) -> None:
    """Give a folder the name of another one beside it, which is deleted.

    Linux and macOS exchange the two names in one step on most disks. Elsewhere the older folder first gives up its
    name; after a kill at that point `sweep_temporary` gives it back.
    """
    if _exchange(os.fspath(new), os.fspath(target)):
        shutil.rmtree(new, ignore_errors=True)
        return
    above, name = os.path.split(os.path.abspath(target))
    aside = os.path.join(above, temporary_name("old"))
    os.mkdir(aside)
    try:
        os.rename(target, os.path.join(aside, name))
        os.rename(new, target)
    finally:
        with contextlib.suppress(OSError):  # the error that led here is the one to report
            _put_back(aside)


def _put_back(aside: str) -> None:
    """Give the folder in `aside` its name back if nothing has taken it; delete what is then left."""
    for name in os.listdir(aside):
        target = os.path.join(os.path.dirname(aside), name)
        if not os.path.lexists(target):
            os.rename(os.path.join(aside, name), target)
    shutil.rmtree(aside)


def _exchange(first: str, second: str) -> bool:
    """Exchange the names of two folders in one step; False where the system or the disk cannot, or will not.

    Python has no call for it.
    """
    import ctypes

    names, swap = (os.fsencode(first), os.fsencode(second)), ctypes.c_uint(2)  # RENAME_EXCHANGE and RENAME_SWAP
    try:
        library = ctypes.CDLL(None)
        if sys.platform == "darwin":
            return bool(library.renamex_np(*names, swap) == 0)
        here = -100  # AT_FDCWD
        return bool(library.renameat2(here, names[0], here, names[1], swap) == 0)
    except (AttributeError, OSError, TypeError):  # no such call; no C library of that kind
        return False


def sync_folder(folder: str | os.PathLike[str]) -> None:
    """Bring everything in a folder to the disk, so that it outlasts a power cut, where the system can."""
    for parent, _, files in os.walk(folder):
        for path in (os.path.join(parent, name) for name in files):
            if os.name != "nt" and not os.path.islink(path):  # there, a file has to be open for writing
                _sync(path)
        sync_names(parent)


def sync_names(folder: str | os.PathLike[str]) -> None:
    """Bring the names in a folder to the disk, where the system can."""
    with contextlib.suppress(OSError):
        _sync(folder)


def _sync(path: str | os.PathLike[str]) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _mode(target: str) -> int | None:
    """Permission bits of the file that will be replaced, None if there is none."""
    try:
        status = os.lstat(target)
    except FileNotFoundError:
        return None
    if stat.S_ISLNK(status.st_mode):
        return None
    if not stat.S_ISREG(status.st_mode):
        kind = "a folder" if stat.S_ISDIR(status.st_mode) else "a special file"
        raise SplatFileError.of(target, "a regular file or a free name", kind, "save under another name")
    if not os.access(target, os.W_OK):
        raise SplatFileError.of(target, "a file that can be written", "a read-only file", "save under another name")
    return stat.S_IMODE(status.st_mode)
