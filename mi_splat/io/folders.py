"""Folders of results that appear whole or not at all."""

import contextlib
import itertools
import json
import os
import platform
import re
import shlex
import stat
import sys
import threading
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mi_splat.errors import InvalidValueError, MiSplatError, one_line
from mi_splat.io.documents import (
    LOCK,
    is_temporary,
    publish,
    restore,
    save_json,
    sha256,
    sweep_temporary,
    temporary_folder,
    try_lock,
)
from mi_splat.io.errors import SplatFileError, from_os_error
from mi_splat.io.parsing import DocumentReader

# Locks: files that one process has at a time, so that two jobs never write into the
# same folder.
#
# The system gives a lock up when its process ends, however it ends; the file is removed
# at the end of the block, and one that a kill left behind locks nothing. Disks without
# locks give none: the block then runs without. (The package `filelock` says nothing of
# who has a lock, and its newest version needs Python 3.11.)

_HELD: dict[str, int] = {}
"""Folders that this process has for itself, and the thread that took each."""


class LockedError(SplatFileError):
    """Another process has what was to be locked."""


@contextlib.contextmanager
def locked_folder(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Have a folder for this process alone, made if need be; a thread may take what it
    has already once more.
    """
    key = os.path.realpath(folder)
    if _HELD.get(key) == threading.get_ident():
        yield
        return
    missing = [
        parent
        for parent in (Path(key), *Path(key).parents)
        if not os.path.lexists(parent)
    ]
    try:
        os.makedirs(key, exist_ok=True)
    except OSError as error:
        raise from_os_error(
            os.fspath(folder), "a folder that can be written", error
        ) from error
    try:
        with locked_file(os.path.join(key, LOCK), os.fspath(folder)):
            check_links(key)
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
def locked_file(file: str, what: str) -> Iterator[Mapping[str, Any] | None]:
    """Have a file, made if need be, for this process alone; `what` it stands for is
    named in errors.

    Yields:
        The record of a process that has ended while it had the file; None if none has.
    """
    try:
        descriptor, left = _locked(file, what)
    except OSError as error:
        raise from_os_error(what, "a folder that can be written", error) from error
    try:
        yield left
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


def _locked(file: str, what: str) -> tuple[int, Mapping[str, Any] | None]:
    """Descriptor of a file that is locked now, and what it said before."""
    while True:
        try:
            descriptor = os.open(
                file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o666
            )
        except OSError as error:
            raise (
                _foreign(file, "a symbolic link") if os.path.islink(file) else error
            ) from error
        try:
            if try_lock(descriptor) is False:
                do = "wait for its end, or pass another folder"
                got = f"one in use by {_holder(descriptor)}"
                raise LockedError.of(
                    what, "a folder that no other process writes into", got, do
                )
            if os.path.samestat(os.fstat(descriptor), os.stat(file)):
                _check_own(descriptor, file)
                left = _record(descriptor)
                os.ftruncate(descriptor, 0)
                os.pwrite(descriptor, json.dumps(_this_process()).encode(), 0)
                return descriptor, left
        except FileNotFoundError:  # who had it removed it, between two of our calls
            pass
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)


def _check_own(descriptor: int, file: str) -> None:
    """Raise unless a lock is a file that this program made: only such a one is
    overwritten, and later removed.
    """
    status = os.fstat(descriptor)
    if not stat.S_ISREG(status.st_mode) or status.st_nlink != 1:
        raise _foreign(file, "a special file or a second name of another file")
    if status.st_size and _record(descriptor) is None:
        raise _foreign(file, "a file of something else")


def _foreign(file: str, got: str) -> SplatFileError:
    return SplatFileError.of(
        file, "a lock of this program", got, "delete it, or pass another folder"
    )


def check_links(folder: str | os.PathLike[str]) -> None:
    """Raise if a link in a folder leads out of it: what is there would be read, or
    written, elsewhere.
    """
    whole = os.path.realpath(folder)
    for parent, folders, files in os.walk(whole):
        for path in (os.path.join(parent, name) for name in (*folders, *files)):
            if os.path.islink(path):
                _check_inside(whole, path)


def _check_inside(folder: str, path: str) -> None:
    if not Path(os.path.realpath(path)).is_relative_to(folder):
        do = "put what it leads to in its place, or pass another folder"
        raise SplatFileError.of(
            path, "a file or a folder", "a link that leads out of the folder", do
        )


def _this_process() -> dict[str, object]:
    name = os.path.basename(sys.argv[0]) if sys.argv else ""
    command = ["mi-splat" if name == "__main__.py" else name, *sys.argv[1:]]
    since = time.strftime("%Y-%m-%d %H:%M:%S")
    return {
        "host": platform.node(),
        "process": os.getpid(),
        "command": shlex.join(command)[:300],
        "since": since,
    }


def _holder(descriptor: int) -> str:
    """Who has the lock, in words, as far as the file says."""
    record = _record(descriptor)
    if record is None:
        return "another process"
    return (
        f"`{record['command']}`, process {record['process']} on {record['host']}, since"
        f" {record['since']}"
    )


def _record(descriptor: int) -> dict[str, Any] | None:
    """What a lock says of who took it; None if it says nothing of the kind."""
    try:
        record = DocumentReader().json_object(os.pread(descriptor, 4096, 0), "lock")
    except (OSError, ValueError):
        return None
    if _this_process().keys() <= record.keys():
        return record
    return None


# manifest.json: the SHA-256 and the length of every file of a result, so that nobody
# changes one unseen.
#
# The SHA-256 of manifest.json itself stands for the whole result: whoever knows it
# knows every byte.

MANIFEST = "manifest.json"
_PART = r"(?!\.)[^/\\:\x00-\x1f]{1,200}"
_NAME = re.compile(rf"(?:{_PART}/){{0,5}}{_PART}")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_DO = "get the result again"


@dataclass(frozen=True, slots=True, kw_only=True)
class Manifest:
    """What manifest.json says."""

    sha256: str  # of manifest.json, hexadecimal: what the result is called by
    # by the name of each file its SHA-256 and its length in bytes
    files: Mapping[str, tuple[str, int]]
    # names of folders beside it that are no part of the result
    without: tuple[str, ...] = ()


def write_manifest(folder: Path, *, without: Collection[str] = ()) -> str:
    """Write manifest.json of all files in a folder of results."""
    files = {
        name: {"sha256": sha256(path), "bytes": path.stat().st_size}
        for name, path in files_in(folder, without)
    }
    save_json({"without": sorted(without), "files": files}, folder / MANIFEST)
    return sha256(folder / MANIFEST)


def files_in(folder: Path, without: Collection[str] = ()) -> Iterator[tuple[str, Path]]:
    """Name and path of every file in a folder of results but manifest.json, in the
    order of the names.
    """
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        left_out = (
            name == MANIFEST or is_temporary(path.name) or name.split("/")[0] in without
        )
        if not left_out and (path.is_symlink() or not path.is_dir()):
            yield name, path


def read_manifest(folder: Path) -> Manifest:
    """What manifest.json in a folder says."""
    path = folder / MANIFEST
    values = DocumentReader(do=_DO).read_json(path)
    files = values.get("files")
    without = values.get("without")
    if not (isinstance(files, dict) and isinstance(without, list)):
        raise InvalidValueError.of(
            str(path), "files, and folders without", "something else", _DO
        )
    return Manifest(
        sha256=sha256(path),
        files={name: _entry(name, entry, path) for name, entry in files.items()},
        without=tuple(map(str, without)),
    )


def _entry(name: str, entry: Any, path: Path) -> tuple[str, int]:
    if not _NAME.fullmatch(name):
        raise InvalidValueError.of(
            str(path), "names of files in its folder", name[:80], _DO
        )
    digest, length = (
        entry.get(key) if isinstance(entry, dict) else None
        for key in ("sha256", "bytes")
    )
    if not (
        isinstance(digest, str)
        and _SHA256.fullmatch(digest)
        and type(length) is int
        and length >= 0
    ):
        raise InvalidValueError.of(
            str(path), f"sha256 and bytes of {name}", repr(entry)[:80], _DO
        )
    return digest, length


def file_in(folder: Path, name: object) -> Path:
    """The path of a file that a record of a folder names: below the folder, also where
    links lead.

    Args:
        folder: Folder of a result.
        name: A name of a file, or those of folders and of a file with / between, as the
            record has it; anything else that somebody may have written there is
            refused.

    Returns:
        The path; whether a file is there is not looked at.

    Raises:
        InvalidValueError: It is no such name.
        SplatFileError: A link leads out of the folder.
    """
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        expected = "names of files in its folder"
        raise InvalidValueError.of(str(folder), expected, one_line(repr(name), 80), _DO)
    path = folder / name
    _check_inside(os.path.realpath(folder), str(path))
    return path


def is_own_file(folder: Path, name: str) -> bool:
    """Whether a folder has a file of this name that is no link, and lies behind none
    that leads out of the folder.
    """
    try:
        path = file_in(folder, name)
    except MiSplatError:
        return False
    return path.is_file() and not path.is_symlink()


RECORD = "result.json"
"""The file that every folder of results holds."""
IN_FOLDERS = ("splat.ply", "attacked.ply")
"""Names by which a folder has one splat: of a training and of an attack."""


_ITERATION = re.compile(r"iteration_(\d{1,9})")
_OF_ITERATION = "point_cloud.ply"


def splat_in(folder: str | os.PathLike[str]) -> str | None:
    """The splat that a folder may stand for, of 3DGS that of its newest iteration; None
    if it has none, or is none.
    """
    files = (os.path.join(folder, name) for name in IN_FOLDERS)
    return next(filter(os.path.isfile, files), None) or _newest_iteration(folder)


def _newest_iteration(folder: str | os.PathLike[str]) -> str | None:
    """point_cloud/iteration_N/point_cloud.ply of the largest N, as 3DGS and what came
    from it write; None without.
    """
    around = os.path.join(folder, "point_cloud")
    try:
        names = os.listdir(around)
    except OSError:
        return None
    numbers = {
        int(match[1]): name for name in names if (match := _ITERATION.fullmatch(name))
    }
    files = (
        os.path.join(around, numbers[number], _OF_ITERATION)
        for number in sorted(numbers, reverse=True)
    )
    return next(filter(os.path.isfile, files), None)


def check_writable(out: str | os.PathLike[str]) -> None:
    """Raise, before any work is done, unless files can be written into a folder at
    `out`, which need not be there.

    Temporary files that killed programs left there are swept.
    """
    around = _existing_parent(Path(out))
    if not around.is_dir():
        raise SplatFileError.of(
            str(out),
            "a folder, or a free name",
            f"the file {around}",
            "pass another name",
        )
    if not os.access(around, os.W_OK | os.X_OK):
        do = "pass a folder that you may write"
        raise SplatFileError.of(
            str(out), "a folder that can be written", f"read-only {around}", do
        )
    sweep_temporary(out)


def check_new_file(
    path: Path, endings: Sequence[str], *, force: bool | None = False
) -> None:
    """Raise, before any work is done, unless a file can be written at `path`, in a
    folder that is there.
    """
    if path.suffix.lower() not in endings:
        expected = f"a name that ends in {' or '.join(endings)}"
        got = path.suffix or "no ending"
        raise InvalidValueError.of(str(path), expected, got, "change the ending")
    check_free_file(path, force=force)
    if not path.absolute().parent.is_dir():
        raise InvalidValueError.of(
            str(path), "a folder to write into", "none", "make the folder first"
        )


def check_free_file(path: Path, *, force: bool | None = False) -> None:
    """Raise, before any work is done, unless a file can be written at `path`, whose
    folder may have to be made.

    A file that is there is replaced with `force`; nothing else is. Without a way to
    force it (None), the message names none.
    """
    check_writable(path.parent)
    if not os.path.lexists(path) or (force and path.is_file()):
        return
    final = path.is_dir() or force is None
    if final:
        do = "choose another name"
    else:
        do = "choose another name, or replace it with force"
    error = InvalidValueError.of(
        str(path), "a free name", "something that is there", do
    )
    raise error if final else error.hinted("--force")


def check_not_input(
    out: str | os.PathLike[str], *inputs: str | os.PathLike[str] | None
) -> None:
    """Raise, before any work is done, if a file that will be written is one of those
    that are read.
    """
    for given in inputs:
        source = given if given is None else splat_in(given) or given
        if (
            source is not None
            and os.path.exists(out)
            and os.path.exists(source)
            and os.path.samefile(out, source)
        ):
            raise SplatFileError.of(
                str(out),
                "another file than the input",
                "the input itself",
                "choose another name",
            )


@contextlib.contextmanager
def own_folder(out: str | os.PathLike[str], *records: str) -> Iterator[None]:
    """The folder of a job that goes on where it stopped, for this process alone; see
    `locked_folder`.
    """
    check_own_folder(out, *records)
    with locked_folder(out):
        check_own_folder(out, *records)  # as whoever had it before us left it
        yield


def check_own_folder(out: str | os.PathLike[str], *records: str) -> None:
    """Raise, before any work is done, unless a folder is new, empty, or known by one of
    `records`; see `own_folder`.
    """
    check_writable(out)
    names = _names_in(Path(out))
    if names and not set(records) & set(names):
        held = _listed(names)
        raise SplatFileError.of(
            str(out),
            "a new or an empty folder",
            f"one that holds {held}",
            "pass another",
        )


def check_new_folder(
    out: str | os.PathLike[str], *, force: bool = False, record: str = RECORD
) -> None:
    """Raise, before any work is done, unless a folder of results can be written at
    `out`.

    With `force` it may hold an older result, of which every file is as its manifest
    lists it. An older result that a kill left without its name gets it back first.
    """
    check_writable(out)
    target = Path(os.path.realpath(out))
    for folder, name in (
        (Path.cwd(), "the working directory"),
        (Path("~").expanduser(), "the home directory"),
    ):
        inner = Path(os.path.realpath(folder))
        if inner.is_relative_to(target):
            got = name if inner == target else f"a folder above {name}"
            raise SplatFileError.of(
                str(out), "a folder for the result only", got, "pass another folder"
            )
    sweep_temporary(target.parent)
    restore(target)
    check_unlocked(out)
    names = _names_in(Path(out))
    if not names:
        return
    held = _listed(names)
    if not force:
        do = "pass another folder" + (
            ", or replace this result with force" if record in names else ""
        )
        error = SplatFileError.of(
            str(out), "a new or an empty folder", f"one that holds {held}", do
        )
        raise error.hinted("--force") if record in names else error
    if record not in names:
        do = "delete the folder yourself, or pass another"
        raise SplatFileError.of(
            str(out),
            f"an older result ({record}) to replace",
            f"one that holds {held}",
            do,
        )
    foreign = _foreign_files(Path(out))
    if foreign:
        expected = f"nothing but what its {MANIFEST} lists"
        do = "move it elsewhere, or pass another folder"
        raise SplatFileError.of(str(out), expected, f"also {_listed(foreign)}", do)


def _foreign_files(folder: Path) -> list[str]:
    """What in a folder is not as its manifest says that this program wrote it."""
    if (folder / ".git").exists():
        return [".git"]
    try:
        listed = read_manifest(folder).files
    except MiSplatError:
        listed = {}
    return [
        name
        for name, path in files_in(folder)
        if name not in listed
        or path.is_symlink()
        or not path.is_file()
        or path.stat().st_size != listed[name][1]
    ]


@contextlib.contextmanager
def new_folder(
    out: str | os.PathLike[str],
    *,
    force: bool = False,
    record: str = RECORD,
    manifest: bool = True,
) -> Iterator[Path]:
    """Write a folder of results whole or not at all.

    The body writes into a temporary folder beside `out`, which gets a manifest.json and
    takes the name `out` when the body ends. When it raises, the temporary folder is
    removed and `out` is as it was. After a kill or a power cut, the old result is there
    or the new one, whole; see `mi_splat.io.documents.publish`.

    What another process has put at `out` meanwhile stays there unless `force` replaces
    it. A finished result that cannot have the name `out` is kept beside it, under the
    first free name of `out`-2, `out`-3 and so on, which the error tells.
    """
    check_new_folder(out, force=force, record=record)
    target = Path(os.path.realpath(out))
    with temporary_folder(target.parent) as made:
        yield made
        try:
            if manifest:
                write_manifest(made)
            check_new_folder(target, force=force, record=record)
            publish(made, target, replace=force)
        except (SplatFileError, OSError) as error:
            raise _kept_elsewhere(made, target, error) from error


def _kept_elsewhere(made: Path, target: Path, error: Exception) -> SplatFileError:
    """Give a finished folder that cannot have its name the first free one like it; the
    error that says so.
    """
    names = (
        target.with_name(f"{target.name}-{number}") for number in itertools.count(2)
    )
    other = next(name for name in names if not os.path.lexists(name))
    try:
        publish(made, other)
    except OSError as second:
        return from_os_error(str(target), "a folder that can be written", second)
    meanwhile = "something that another process wrote there meanwhile"
    got = error.strerror or str(error) if isinstance(error, OSError) else meanwhile
    return SplatFileError.of(
        str(target),
        "a name that this result can have",
        got,
        f"see {other}, where this result is",
    )


def _names_in(folder: Path) -> list[str]:
    if folder.exists():
        return sorted(
            entry.name for entry in folder.iterdir() if not is_temporary(entry.name)
        )
    return []


def _listed(names: list[str]) -> str:
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")


def _existing_parent(path: Path) -> Path:
    path = Path(os.path.abspath(path))
    while not os.path.lexists(path):
        path = path.parent
    return Path(os.path.realpath(path))
