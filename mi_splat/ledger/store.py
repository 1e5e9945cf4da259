"""The folder of results: one folder for each finished job, which appears whole or not
at all.
"""

import contextlib
import functools
import os
import platform
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mi_splat import provenance
from mi_splat.errors import InvalidValueError
from mi_splat.io.documents import (
    publish,
    save_json,
    sha256,
    sweep_temporary,
    temporary_folder,
)
from mi_splat.io.errors import SplatFileError, from_os_error
from mi_splat.io.folders import LockedError, is_locked, locked_file, locked_folder
from mi_splat.io.parsing import DocumentReader
from mi_splat.ledger.job import Done, Row, Task, canonical, digest, key_of

RECORD = "job.json"
FILES = "files"
TRIES = 3  # how often a job may fail
AGAIN = "delete its folder, so that it is made again"
_RECORDS = DocumentReader(expected="the record of a job", do=AGAIN, most=1 << 28)
_KEY = re.compile(r"[0-9a-f]{32}")
_versions = functools.cache(provenance.versions)
_commit = functools.cache(provenance.commit)


@dataclass(frozen=True, eq=False)
class Store:
    """A folder of results; any number of processes of any number of machines may use it
    at once.

    Below it are `jobs/ab/KEY` (`job.json`, `files`), `locks` (of the jobs that are
    being done), `tmp` (what is being made), `partial` (what a job goes on with), and
    `failed`.
    """

    folder: Path

    def path(self, *parts: str) -> Path:
        """A path below the folder, no part of which may be a link: it could lead out of
        the folder.
        """
        path = self.folder
        for part in parts:
            path /= part
            if path.is_symlink():
                do = "put what it leads to in its place, or use another store"
                raise InvalidValueError.of(
                    str(path), "a part of the store", "a symbolic link", do
                )
        return path

    def folder_of(self, key: str) -> Path:
        """The folder of a job, whether or not it is there."""
        return self.path("jobs", checked_key(key)[:2], key)

    def has(self, key: str) -> bool:
        """Whether a job is done."""
        return (self.folder_of(key) / RECORD).is_file()

    def keys(self) -> set[str]:
        """Keys of all jobs that are done."""
        jobs = self.folder / "jobs"
        return {
            name
            for shelf in _names(jobs)
            for name in _names(jobs / shelf)
            if _KEY.fullmatch(name)
        }

    def record(self, key: str) -> dict[str, Any]:
        """What job.json of a finished job says, without a look at its files."""
        path = self.folder_of(key) / RECORD
        record = _RECORDS.read_json(path)
        try:
            made = key_of(record["config"], record["inputs"], record["code"])
            whole = made == key and record["content"] == digest(
                [record["files"], record["rows"]]
            )
            whole = whole and _is_well_formed(record)
        except (KeyError, TypeError, AttributeError):
            whole = False
        if not whole:
            raise InvalidValueError.of(
                str(path), f"the record of job {key}", "another one", AGAIN
            )
        return record

    def recorded(self, key: str) -> Done | None:
        """A finished job, without a look at its files; None if there is none."""
        if self.has(key):
            return Done(
                key=key, folder=self.folder_of(key) / FILES, record=self.record(key)
            )
        return None

    def done(self, key: str) -> Done | None:
        """A finished job, whose files are what it wrote; None if there is none."""
        done = self.recorded(key)
        if done is not None and (present := hashes(done.folder)) != (
            written := done.record["files"]
        ):
            changed = sorted(
                name
                for name in {**present, **written}
                if present.get(name) != written.get(name)
            )
            got = f"another {', '.join(changed[:3])}"
            raise InvalidValueError.of(
                f"job {self.folder_of(key)}", "the files that it wrote", got, AGAIN
            )
        return done

    def existing(self, key: str) -> Done:
        """A finished job that has to be there; see `done`."""
        done = self.done(key)
        if done is None:
            do = "leave the folder alone while it is used"
            raise InvalidValueError.of(
                str(self.folder_of(key)), "a finished job", "none", do
            )
        return done

    def held(
        self, key: str
    ) -> contextlib.AbstractContextManager[Mapping[str, Any] | None]:
        """Have a job for this process alone; `HeldError` if another one has it.

        Returns:
            What gives the record of a process that has ended while it had the job, or
            None.
        """
        self.path("locks").mkdir(parents=True, exist_ok=True)
        return locked_file(str(self.path("locks", checked_key(key))), f"job {key}")

    def release(self, key: str) -> None:
        """Give a job up that this process has."""
        self.path("locks", checked_key(key)).unlink(missing_ok=True)

    def is_held(self, key: str) -> bool:
        """Whether a process does a job now."""
        return is_locked(str(self.path("locks", checked_key(key))))

    @contextlib.contextmanager
    def making(self, key: str) -> Iterator[tuple[Path, Path]]:
        """Folders for who has a job: a new one for its result, and the one that it goes
        on with.
        """
        partial = self.path("partial", checked_key(key))
        with temporary_folder(self.path("tmp")) as temporary:
            (temporary / FILES).mkdir()
            try:
                yield temporary, partial
            finally:
                with contextlib.suppress(OSError):
                    partial.rmdir()  # nothing was written into it

    def publish(self, temporary: Path, record: Mapping[str, Any], key: str) -> None:
        """Give a finished folder its name, unless another process has made the job,
        too, on a disk without locks.
        """
        files = {name: sha256(path) for name, path in _files(temporary / FILES).items()}
        target = self.folder_of(key)
        try:
            (temporary / RECORD).write_text(record_text(record, files), "utf-8")
            if not files:
                (temporary / FILES).rmdir()
            if not self.has(key):
                target.parent.mkdir(parents=True, exist_ok=True)
                publish(temporary, target)
        except OSError as error:
            raise from_os_error(
                str(target), "a folder that can be written", error
            ) from error
        shutil.rmtree(self.path("partial", key), ignore_errors=True)
        self.forgive(key)

    def keep(
        self, task: Task, rows: Sequence[Row], documents: Mapping[str, Any]
    ) -> None:
        """Put what another process has found into the store: rows, and JSON documents
        by their names.
        """
        with temporary_folder(self.path("tmp")) as temporary:
            files = temporary / FILES
            files.mkdir()
            for name, document in documents.items():
                save_json(document, files / name)
            record = {**task.as_json, **origin(), "varies": [], "rows": list(rows)}
            try:
                self.publish(temporary, record, task.key)
            except SplatFileError:
                # else another process was first, with the same result
                if not self.has(task.key):
                    raise

    def failures(self, key: str) -> list[dict[str, Any]]:
        """The tries of a job that failed: `error`, and what ran it."""
        path = self._failures(key)
        if not path.is_file():
            return []
        tries: list[dict[str, Any]] = _RECORDS.read_json(path)["tries"]
        return tries

    def failed(self) -> set[str]:
        """Keys of the jobs that have failed for good."""
        keys = (name.removesuffix(".json") for name in _names(self.folder / "failed"))
        return {
            key
            for key in keys
            if _KEY.fullmatch(key) and len(self.failures(key)) >= TRIES
        }

    def note_failure(self, task: Task, error: str, seconds: float) -> int:
        """Write down that a job failed."""
        path = self._failures(task.key)
        path.parent.mkdir(parents=True, exist_ok=True)
        tries = [
            *self.failures(task.key),
            {"error": error, "seconds": seconds, "versions": _versions()},
        ]
        save_json({**task.as_json, "tries": tries}, path)
        return len(tries)

    def _failures(self, key: str) -> Path:
        return self.path("failed", f"{checked_key(key)}.json")

    def forgive(self, key: str) -> bool:
        """Forget the failures of a job, so that it is tried again."""
        path = self._failures(key)
        with contextlib.suppress(FileNotFoundError):
            path.unlink()
            return True
        return False

    def remove(self, key: str) -> None:
        """Delete a finished job and its failures, in one step for all who look."""
        folder = self.folder_of(key)
        with (
            temporary_folder(self.path("tmp")) as aside,
            contextlib.suppress(FileNotFoundError),
        ):
            os.rename(folder, aside / "job")
        self.forgive(key)

    def free_kernels(self, numbers: Iterator[int], held: contextlib.ExitStack) -> Path:
        """The first folder for compiled kernels that no other process of this machine
        uses.
        """
        for number in numbers:
            cache = self.folder / "kernels" / f"{platform.node()}-{number}"
            # any other error is one of the disk, and comes again
            with contextlib.suppress(LockedError):
                held.enter_context(locked_folder(cache))
                return cache.absolute()
        raise AssertionError("numbers do not end")

    def sweep(self) -> None:
        """Remove what killed processes have left: locks, temporary files, and `partial`
        of jobs that are done.
        """
        for key in filter(_KEY.fullmatch, _names(self.path("locks"))):
            self.is_held(key)
        for name in ("tmp", "failed"):
            sweep_temporary(self.path(name))
        for key in filter(_KEY.fullmatch, _names(self.path("partial"))):
            if self.has(key) and not self.is_held(key):
                shutil.rmtree(self.path("partial", key), ignore_errors=True)


def _is_well_formed(record: Mapping[str, Any]) -> bool:
    """Whether what a record says of files and rows is of the kinds that whoever reads
    it counts on.
    """
    files = record["files"]
    rows = record["rows"]
    varies = record["varies"]
    return (
        isinstance(files, dict)
        and all(isinstance(content, str) for content in files.values())
        and isinstance(rows, list)
        and all(isinstance(row, dict) for row in rows)
        and isinstance(varies, list)
        and all(isinstance(name, str) for name in varies)
    )


def checked_key(key: str) -> str:
    """A key, which is 32 hexadecimal digits: as a part of a path, nothing else stays in
    the store.
    """
    if not _KEY.fullmatch(key):
        raise InvalidValueError.of(
            "key of a job", "32 hexadecimal digits", key[:80], "plan the study again"
        )
    return key


def record_text(record: Mapping[str, Any], files: Mapping[str, str]) -> str:
    """job.json of a record and the SHA-256 of its files, a line for each value."""
    whole = {**record, "files": files, "content": digest([files, record["rows"]])}
    return (
        "{\n"
        + ",\n".join(
            f"{canonical(name)}: {canonical(value)}" for name, value in whole.items()
        )
        + "\n}\n"
    )


def origin() -> dict[str, Any]:
    """What every record says of what made it."""
    return {
        "versions": _versions(),
        "commit": _commit(),
        "torch": provenance.torch_arithmetic(),
    }


def content_of_path(path: Path) -> str:
    """SHA-256 of a file, or what stands for the names and bytes of all files in a
    folder.
    """
    if not path.exists():
        raise InvalidValueError.of(
            str(path), "a file or a folder to read", "nothing", "check the path"
        )
    try:
        present = hashes(path.absolute())
    except OSError as error:
        raise from_os_error(str(path), "a file that can be read", error) from error
    if path.is_dir():
        return digest(present)
    return present[""]


_HASHES: dict[Path, tuple[object, dict[str, str]]] = {}


def hashes(path: Path) -> dict[str, str]:
    """SHA-256 of every file below a folder by its name there, or of one file; none if
    there is nothing.
    """
    files = {"": path} if path.is_file() else _files(path)
    status = [(name, file.stat()) for name, file in files.items()]
    state = [(name, s.st_mtime_ns, s.st_size, s.st_ino) for name, s in status]
    known = _HASHES.get(path)
    if known is None or known[0] != state:
        known = _HASHES[path] = (
            state,
            {name: sha256(file) for name, file in files.items()},
        )
    return known[1]


def _names(folder: Path) -> list[str]:
    try:
        return sorted(os.listdir(folder))
    except FileNotFoundError:
        return []


def _files(folder: Path) -> dict[str, Path]:
    """Every file below a folder by its name there; none if the folder is not there."""
    paths = (Path(base, name) for base, _, names in os.walk(folder) for name in names)
    return dict(sorted((path.relative_to(folder).as_posix(), path) for path in paths))
