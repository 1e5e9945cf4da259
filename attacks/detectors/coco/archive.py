"""A few files out of a package of npm, a gzipped tar file that may be anything: in bounded memory and time.

Nothing is unpacked to the disk. A member counts if it has exactly the name and the size that are asked for and is a
regular file; the archive as a whole may hold no second one of that name.
"""

from __future__ import annotations

import gzip
import tarfile
import zlib
from collections.abc import Iterable
from pathlib import Path

from attacks.detectors.coco.sources import PublishedFile
from attacks.detectors.errors import DetectorError
from mi_splat.errors import message

LARGEST = 1 << 29
"""Bytes that an archive may have unpacked; the largest package here has 190 million."""
HEADERS = 1 << 22
"""Bytes of headers that an archive may have, all together: 8,192 members with plain ones."""
_BLOCK = 1 << 20


def read_members(archive: Path, wanted: Iterable[PublishedFile]) -> dict[str, bytes]:
    """Content of those of some files that an archive holds, by name.

    Args:
        archive: A gzipped tar file.
        wanted: The files; their names and sizes count, their hashes are the caller's to check.

    Raises:
        DetectorError: It is no such archive, it is too large, or a member of a wanted name is not a regular file of
            the wanted size, or stands there twice.
    """
    sizes = {file.member: file.size for file in wanted}
    try:
        with gzip.open(archive) as unzipped:
            stream = _Forward(unzipped, archive, HEADERS + sum(sizes.values()))
            with tarfile.open(fileobj=stream, mode="r:") as members:  # type: ignore[call-overload]  # all that it needs
                return _members(members, sizes, archive)
    except (tarfile.TarError, zlib.error, EOFError, ValueError, OverflowError, RecursionError) as error:
        raise _wrong(archive, "a whole .tgz file of npm", str(error) or type(error).__name__) from error
    except gzip.BadGzipFile as error:
        raise _wrong(archive, "a gzipped tar file", str(error)) from error
    except OSError as error:
        raise _wrong(archive, "a file that can be read", error.strerror or str(error)) from error


def _members(members: tarfile.TarFile, sizes: dict[str, int], archive: Path) -> dict[str, bytes]:
    """Read an open archive to its end."""
    found: dict[str, bytes] = {}
    for member in members:
        if member.name not in sizes:
            continue
        if member.name in found:
            raise _wrong(archive, f"one file {member.name}", "two")
        if not member.isreg() or member.issparse():
            raise _wrong(archive, f"a regular file {member.name}", "a link or something else")
        if member.size != sizes[member.name]:
            raise _wrong(archive, f"{member.name} of {sizes[member.name]:,} bytes", f"{member.size:,}")
        file = members.extractfile(member)
        assert file is not None  # a regular file has content
        found[member.name] = file.read(member.size)
    return found


class _Forward:
    """The part of a file that `tarfile` needs, read once from front to back, and not more of it than is allowed.

    What is skipped is unpacked block by block; what is read, headers and wanted files, has a budget.
    """

    def __init__(self, stream: gzip.GzipFile, archive: Path, budget: int) -> None:
        self._stream, self._archive, self._budget = stream, archive, budget
        self._at = self._done = 0

    def tell(self) -> int:
        return self._at

    def seek(self, position: int, whence: int = 0) -> int:
        if whence or position < self._done:
            raise _wrong(self._archive, "members one after the other", "one that lies before another")
        if position > LARGEST:
            raise _wrong(self._archive, f"at most {LARGEST:,} bytes unpacked", "more")
        self._at = position
        return position

    def read(self, size: int = -1) -> bytes:
        while self._done < self._at:
            skipped = len(self._stream.read(min(_BLOCK, self._at - self._done)))
            if not skipped:
                return b""
            self._done += skipped
        if not 0 <= size <= self._budget:
            raise _wrong(self._archive, f"at most {HEADERS:,} bytes of headers", "more")
        data = self._stream.read(size)
        self._budget -= len(data)
        self._done += len(data)
        self._at = self._done
        return data


def _wrong(archive: Path, expected: str, got: str) -> DetectorError:
    do = "get the package again, by `npm pack` or from npm's site"
    return DetectorError(message(f"package {archive}", expected, got, do))
