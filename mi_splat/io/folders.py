"""Folders of results that appear whole or not at all."""

import contextlib
import itertools
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.io.atomic import is_temporary, publish, restore, sweep_temporary, temporary_folder
from mi_splat.io.errors import SplatFileError, from_os_error
from mi_splat.io.formats.detection import META
from mi_splat.io.locks import check_unlocked, locked_folder
from mi_splat.io.manifest import MANIFEST, files_in, read_manifest, write_manifest

RECORD = "result.json"
"""The file that every folder of results holds."""
IN_FOLDERS = ("splat.ply", "attacked.ply", META)
"""Names by which a folder has one splat: of a training, of an attack, and of an unbundled SOG."""


def splat_in(folder: str | os.PathLike[str]) -> str | None:
    """The splat that a folder may stand for; None if it has none, or is none."""
    files = (os.path.join(folder, name) for name in IN_FOLDERS)
    return next(filter(os.path.isfile, files), None)


def check_writable(out: str | os.PathLike[str]) -> None:
    """Raise, before any work is done, unless files can be written into a folder at `out`, which need not be there.

    Temporary files that killed programs left there are swept.
    """
    around = _existing_parent(Path(out))
    if not around.is_dir():
        raise SplatFileError.of(str(out), "a folder, or a free name", f"the file {around}", "pass another name")
    if not os.access(around, os.W_OK | os.X_OK):
        do = "pass a folder that you may write"
        raise SplatFileError.of(str(out), "a folder that can be written", f"read-only {around}", do)
    sweep_temporary(out)


def check_new_file(path: Path, endings: Sequence[str], *, force: bool | None = False) -> None:
    """Raise, before any work is done, unless a file can be written at `path`."""
    if path.suffix.lower() not in endings:
        expected, got = f"a name that ends in {' or '.join(endings)}", path.suffix or "no ending"
        raise InvalidValueError.of(str(path), expected, got, "change the ending")
    if path.exists() and not (force and path.is_file()):
        final = path.is_dir() or force is None
        do = "choose another name" if final else "choose another name, or replace it with force"
        error = InvalidValueError.of(str(path), "a free name", "something that is there", do)
        raise error if final else error.hinted("--force")
    if not path.absolute().parent.is_dir():
        raise InvalidValueError.of(str(path), "a folder to write into", "none", "make the folder first")
    check_writable(path.parent)


def check_not_input(out: str | os.PathLike[str], *inputs: str | os.PathLike[str] | None) -> None:
    """Raise, before any work is done, if a file that will be written is one of those that are read."""
    for given in inputs:
        source = given if given is None else splat_in(given) or given
        if source is not None and os.path.exists(out) and os.path.exists(source) and os.path.samefile(out, source):
            raise SplatFileError.of(str(out), "another file than the input", "the input itself", "choose another name")


@contextlib.contextmanager
def own_folder(out: str | os.PathLike[str], *records: str) -> Iterator[None]:
    """The folder of a job that goes on where it stopped, for this process alone; see `locked_folder`."""
    check_own_folder(out, *records)
    with locked_folder(out):
        check_own_folder(out, *records)  # as whoever had it before us left it
        yield


def check_own_folder(out: str | os.PathLike[str], *records: str) -> None:
    """Raise, before any work is done, unless a folder is new, empty, or known by one of `records`; see `own_folder`."""
    check_writable(out)
    names = _names_in(Path(out))
    if names and not set(records) & set(names):
        held = _listed(names)
        raise SplatFileError.of(str(out), "a new or an empty folder", f"one that holds {held}", "pass another")


def check_new_folder(out: str | os.PathLike[str], *, force: bool = False, record: str = RECORD) -> None:
    """Raise, before any work is done, unless a folder of results can be written at `out`.

    With `force` it may hold an older result, of which every file is as its manifest lists it. An older result that a
    kill left without its name gets it back first.
    """
    check_writable(out)
    target = Path(os.path.realpath(out))
    for folder, name in ((Path.cwd(), "the working directory"), (Path("~").expanduser(), "the home directory")):
        inner = Path(os.path.realpath(folder))
        if inner.is_relative_to(target):
            got = name if inner == target else f"a folder above {name}"
            raise SplatFileError.of(str(out), "a folder for the result alone", got, "pass another folder")
    sweep_temporary(target.parent)
    restore(target)
    check_unlocked(out)
    names = _names_in(Path(out))
    if not names:
        return
    held = _listed(names)
    if not force:
        do = "pass another folder" + (", or replace this result with force" if record in names else "")
        error = SplatFileError.of(str(out), "a new or an empty folder", f"one that holds {held}", do)
        raise error.hinted("--force") if record in names else error
    if record not in names:
        do = "delete the folder yourself, or pass another"
        raise SplatFileError.of(str(out), f"an older result ({record}) to replace", f"one that holds {held}", do)
    if foreign := _foreign_files(Path(out)):
        expected, do = f"nothing but what its {MANIFEST} lists", "move it elsewhere, or pass another folder"
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
        if name not in listed or not _is_regular(path) or path.stat().st_size != listed[name][1]
    ]


def _is_regular(path: Path) -> bool:
    return path.is_file() and not path.is_symlink()


@contextlib.contextmanager
def new_folder(
    out: str | os.PathLike[str], *, force: bool = False, record: str = RECORD, manifest: bool = True
) -> Iterator[Path]:
    """Write a folder of results whole or not at all.

    The body writes into a temporary folder beside `out`, which gets a manifest.json and takes the name `out` when the
    body ends. When it raises, the temporary folder is removed and `out` is as it was. After a kill or a power cut, the
    old result is there or the new one, whole; see `mi_splat.io.atomic.publish`.

    What another process has put at `out` meanwhile stays there unless `force` replaces it. A finished result that
    cannot have the name `out` is kept beside it, under the first free name of `out`-2, `out`-3 and so on, which the
    error tells.
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
            raise _kept_beside(made, target, error) from error


def _kept_beside(made: Path, target: Path, error: Exception) -> SplatFileError:
    """Give a finished folder that cannot have its name the first free one like it; the error that says so."""
    names = (target.with_name(f"{target.name}-{number}") for number in itertools.count(2))
    beside = next(name for name in names if not os.path.lexists(name))
    try:
        publish(made, beside)
    except OSError as second:
        return from_os_error(str(target), "a folder that can be written", second)
    meanwhile = "something that another process wrote there meanwhile"
    got = error.strerror or str(error) if isinstance(error, OSError) else meanwhile
    return SplatFileError.of(
        str(target), "a name that this result can have", got, f"see {beside}, where this result is"
    )


def _names_in(folder: Path) -> list[str]:
    """What is in a folder, temporary files apart; nothing if it is not there."""
    return sorted(entry.name for entry in folder.iterdir() if not is_temporary(entry.name)) if folder.exists() else []


def _listed(names: list[str]) -> str:
    """A few of the names."""
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")


def _existing_parent(path: Path) -> Path:
    """The nearest of a path and those above it that is there."""
    path = Path(os.path.abspath(path))
    while not os.path.lexists(path):
        path = path.parent
    return Path(os.path.realpath(path))
