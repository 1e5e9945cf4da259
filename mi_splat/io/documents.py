"""Bytes, text, JSON and PNG files that appear whole or not at all, and digests of
files.
"""

import contextlib
import ctypes
import errno
import fcntl
import hashlib
import io
import json
import os
import re
import secrets
import shutil
import stat
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mi_splat.io.errors import SplatFileError, from_os_error

LOCK = ".mi-splat.lock"
"""Name of the file in a folder that a process has for itself; see
`mi_splat.io.folders`.
"""
ASIDE = ".mi-splat.aside"
"""Name of the file in a folder that is being replaced; see `publish`."""
# AT_FDCWD, RENAME_EXCHANGE, RENAME_SWAP
_HERE = -100
_LINUX_EXCHANGE = 2
_MACOS_SWAP = 2
_TEMPORARY = re.compile(r"\.[0-9a-f]{16}\.tmp")
_YOUNG = 60.0
"""Seconds in which a temporary file is left alone, since its maker may not have come to
lock it.
"""
_SYNCED_AT_ONCE = 8


def is_temporary(name: str) -> bool:
    """Whether a file name is that of a temporary file or of a lock: what only running
    programs need.
    """
    return name in (LOCK, ASIDE) or _TEMPORARY.fullmatch(name) is not None


def try_lock(descriptor: int) -> bool | None:
    """Lock an open file for this process until it is closed; False if another one has
    it, None without locks there.
    """
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EACCES, errno.EAGAIN, errno.EWOULDBLOCK):
            return False
        return None
    return True


def sweep_temporary(folder: str | os.PathLike[str]) -> int:
    """Remove the temporary files and folders that killed programs left in a folder;
    running ones hold locks on them.
    """
    removed = 0
    with contextlib.suppress(OSError):
        for entry in list(os.scandir(folder)):
            with contextlib.suppress(OSError):
                if _TEMPORARY.fullmatch(entry.name) and _is_abandoned(entry):
                    (
                        shutil.rmtree(entry)
                        if entry.is_dir(follow_symlinks=False)
                        else os.unlink(entry)
                    )
                    removed += 1
    return removed


def _is_abandoned(entry: os.DirEntry[str]) -> bool:
    if time.time() - entry.stat(follow_symlinks=False).st_mtime < _YOUNG:
        return False
    descriptor = os.open(entry, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW)
    try:
        return try_lock(descriptor) is True
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Write a file so that a crash, a kill or a full disk leaves the old file or the
    new one, never a part.

    The mode of a file that was there is kept; a symbolic link is replaced, and not what
    it leads to.
    """
    target = os.path.abspath(path)
    temporary = os.path.join(os.path.dirname(target), _temporary_name())
    expected = "a file that can be written"
    try:
        mode = _mode(target)
        descriptor = os.open(
            temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666
        )
    except OSError as error:
        raise from_os_error(os.fspath(path), expected, error) from error
    try:
        with open(descriptor, "wb", buffering=0) as file:
            try_lock(descriptor)
            yield file
            if mode is not None:
                os.chmod(temporary, mode)
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except OSError as error:
        raise from_os_error(os.fspath(path), expected, error) from error
    finally:
        # the error that led here is the one to report
        with contextlib.suppress(OSError):
            os.unlink(temporary)
    _sync_names(os.path.dirname(target))


def write_all(file: BinaryIO, data: memoryview) -> None:
    """Write every byte of `data` to an unbuffered file, which may take only a part at a
    time.
    """
    rest = data.cast("B")
    while rest:
        rest = rest[file.write(rest) :]


@contextlib.contextmanager
def temporary_folder(parent: Path) -> Iterator[Path]:
    """A new folder that is gone after the block, unless `publish` has given it a name.

    Where the block raises, the folders above it that had to be made are gone, too, if
    nothing else is in them.
    """
    folder = parent / _temporary_name()
    missing = [
        above for above in (parent, *parent.parents) if not os.path.lexists(above)
    ]
    try:
        folder.mkdir(parents=True)
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise from_os_error(
            str(parent), "a folder that can be written", error
        ) from error
    try:
        try_lock(descriptor)
        yield folder
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        with contextlib.suppress(OSError):  # something else is in them
            for above in missing:
                above.rmdir()
        raise
    finally:
        os.close(descriptor)
        shutil.rmtree(folder, ignore_errors=True)


def publish(folder: Path, target: Path, *, replace: bool = False) -> None:
    """Bring a folder to the disk and give it the name of another place beside it, in
    one step.

    A folder that is replaced exchanges its name with the new one, where the disk can do
    that in one step. Elsewhere it waits under a name that nothing else has, with
    `ASIDE` in it, until the new one has its name; after a kill at that point `restore`
    gives it back.
    """
    paths = [
        Path(parent, name)
        for parent, _, names in os.walk(folder)
        for name in (".", *names)
    ]
    # one after the other they take five times as long
    with ThreadPoolExecutor(_SYNCED_AT_ONCE) as pool:
        list(pool.map(_sync, paths))
    if not (replace and target.exists()):
        os.rename(folder, target)
    elif exchange(folder, target):
        shutil.rmtree(folder, ignore_errors=True)
    else:
        _replace(folder, target)
    _sync_names(target.parent)


def _replace(folder: Path, target: Path) -> None:
    aside = target.with_name(f".{target.name}.{secrets.token_hex(8)}.old")
    (target / ASIDE).touch()
    try:
        os.rename(target, aside)
        os.rename(folder, target)
    finally:
        restore(target)


def restore(target: Path) -> None:
    """Give a folder that was to be replaced its name back if nothing has taken it, and
    else delete it.

    Only a folder that `publish` has put aside is touched: it has a name of 16 random
    digits, and holds `ASIDE`.
    """
    pattern = re.compile(rf"\.{re.escape(target.name)}\.[0-9a-f]{{16}}\.old")
    with contextlib.suppress(FileNotFoundError):
        names = [name for name in os.listdir(target.parent) if pattern.fullmatch(name)]
        for aside in (target.with_name(name) for name in names):
            if not (aside / ASIDE).is_file() or aside.is_symlink():
                continue
            if os.path.lexists(target):
                # under its own name it is whole or not there
                temporary = target.with_name(_temporary_name())
                os.rename(aside, temporary)
                shutil.rmtree(temporary, ignore_errors=True)
            else:
                os.rename(aside, target)
    with contextlib.suppress(OSError):
        (target / ASIDE).unlink()


def exchange(first: Path, second: Path) -> bool:
    """Exchange the names of two folders in one step; False where the system or the disk
    cannot.
    """
    names = (os.fsencode(first), os.fsencode(second))
    library = ctypes.CDLL(None, use_errno=True)
    if hasattr(library, "renameat2"):
        status = library.renameat2(_HERE, names[0], _HERE, names[1], _LINUX_EXCHANGE)
    elif hasattr(library, "renamex_np"):
        status = library.renamex_np(*names, _MACOS_SWAP)
    else:
        return False
    return bool(status == 0)


def _temporary_name() -> str:
    return f".{secrets.token_hex(8)}.tmp"


def _sync_names(folder: str | os.PathLike[str]) -> None:
    with contextlib.suppress(OSError):
        _sync(folder)


def _sync(path: str | os.PathLike[str]) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _mode(target: str) -> int | None:
    """Permission bits of the file that will be replaced; None if there is none, or a
    link.
    """
    try:
        status = os.lstat(target)
    except FileNotFoundError:
        return None
    if stat.S_ISLNK(status.st_mode):
        return None
    if not stat.S_ISREG(status.st_mode):
        kind = "a folder" if stat.S_ISDIR(status.st_mode) else "a special file"
        raise SplatFileError.of(
            target, "a regular file or a free name", kind, "save under another name"
        )
    if not os.access(target, os.W_OK):
        raise SplatFileError.of(
            target,
            "a file that can be written",
            "a read-only file",
            "save under another name",
        )
    return stat.S_IMODE(status.st_mode)


def file_name(text: str) -> str:
    """A text, for instance the name of a camera, as a file may be called everywhere."""
    return re.sub(r"[^\w.-]", "_", text)


def save_bytes(
    data: bytes | memoryview, path: str | os.PathLike[str], *, head: bytes = b""
) -> None:
    """Write a file."""
    with atomic_write(path) as file:
        for part in (head, data):
            write_all(file, memoryview(part))


def save_text(text: str, path: Path) -> None:
    """Write a text file."""
    save_bytes(text.encode(), path)


def save_json(values: Any, path: Path, *, indent: int | None = 2) -> None:
    """Write a JSON file; without an indent on one line."""
    save_text(json.dumps(values, indent=indent, allow_nan=False) + "\n", path)


def save_png(pixels: NDArray[np.uint8], path: Path) -> None:
    """Write (H, W, 3) or (H, W, 4) pixels as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG")
    save_bytes(buffer.getvalue(), path)


def sha256(path: Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal."""
    total = hashlib.sha256()
    with path.open("rb") as file:
        while part := file.read(1 << 20):
            total.update(part)
    return total.hexdigest()
