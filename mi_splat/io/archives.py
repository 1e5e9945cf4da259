"""ZIP archives as phones and web sites pack splats into: the one splat inside is read,
and nothing is written.

What an archive claims is bounded before it is unpacked: the members of its directory,
and what each of them becomes.
"""

from __future__ import annotations

import contextlib
import io
import os
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Iterator, Sequence

from mi_splat.io.errors import SplatFileError

MOST_MEMBERS = 10_000
"""Members that an archive may have; a scan with its photographs has some hundreds."""
MOST_BYTES = 8 << 30
"""What a splat may become, whatever its archive holds: 30 million Gaussians."""
_FREE_BYTES = 16 << 20
_MOST_RATIO = 20
"""What any member may become, and the factor by which one beyond that may grow: splats
shrink to a half at best.
"""
_PART = 1 << 20
_END = struct.Struct("<4s4H2LH")
_END64 = b"PK\x06\x07"
_LONGEST_COMMENT = 0xFFFF
_BYTES_A_MEMBER = 1024
_AGAIN = "write or download it again"
_SHOWN = 6

ZIP_ERRORS = (
    *(
        zipfile.BadZipFile,
        zlib.error,
        EOFError,
        NotImplementedError,
        RuntimeError,
        ValueError,
        struct.error,
    ),
    *(OverflowError, OSError),
)
"""What `zipfile` raises for archives that are damaged."""


def check_directory(file: io.FileIO, path: str, *, most: int) -> None:
    """Raise unless the end of an archive claims a small directory, which `zipfile`
    reads as a whole.
    """
    size = os.fstat(file.fileno()).st_size
    start = max(0, size - _END.size - _LONGEST_COMMENT)
    tail = os.pread(file.fileno(), size - start, start)
    offset = tail.rfind(b"PK\x05\x06")
    if offset < 0 or len(tail) - offset < _END.size:
        raise SplatFileError.of(
            path, "a zip archive with its directory", "none: it is truncated", _AGAIN
        )
    fields = _END.unpack_from(tail, offset)
    members = fields[4]
    length = fields[5]
    is_large = tail[max(0, offset - 20) :][:4] == _END64
    if members > most or length > most * _BYTES_A_MEMBER or is_large:
        got = f"{members} in {length} bytes"
        raise SplatFileError.of(
            path, f"a zip archive of at most {most} members", got, _AGAIN
        )


@contextlib.contextmanager
def splat_of(
    file: io.FileIO, path: str, endings: Sequence[str]
) -> Iterator[tuple[io.FileIO, str]]:
    """The one splat of an archive as a file in memory, and its name with that of the
    archive.

    Args:
        file: The archive.
        path: Its name.
        endings: Of members that are splats; an archive in the archive is none.

    Yields:
        The open file, and a name for messages that ends as the member does.

    Raises:
        SplatFileError: There is no splat or there are several, it is packed too
            tightly, or the archive is damaged.
    """
    check_directory(file, path, most=MOST_MEMBERS)
    file.seek(0)
    try:
        archive = zipfile.ZipFile(file)
    except ZIP_ERRORS as error:
        raise SplatFileError.of(
            path, "a zip archive", str(error)[:100], _AGAIN
        ) from None
    with archive, _anonymous_file() as unpacked:
        member = _only_splat(archive, path, endings)
        where = f"{path}/{_plain(member.filename)}"
        _check_size(member, where)
        try:
            _unpack(archive, member, unpacked)
        except ZIP_ERRORS as error:
            raise SplatFileError.of(
                where, "an intact member", str(error)[:100], _AGAIN
            ) from None
        yield unpacked, where


def member_names(file: io.FileIO, path: str) -> list[str]:
    """The names in an archive, fit to be printed."""
    check_directory(file, path, most=MOST_MEMBERS)
    file.seek(0)
    try:
        with zipfile.ZipFile(file) as archive:
            return [_plain(name) for name in archive.namelist()]
    except ZIP_ERRORS as error:
        raise SplatFileError.of(
            path, "a zip archive", str(error)[:100], _AGAIN
        ) from None


def _only_splat(
    archive: zipfile.ZipFile, path: str, endings: Sequence[str]
) -> zipfile.ZipInfo:
    members = [
        member
        for member in archive.infolist()
        if not member.is_dir() and not _is_hidden(member.filename)
    ]
    splats = [
        member for member in members if member.filename.lower().endswith(tuple(endings))
    ]
    expected = f"a zip archive with one splat ({', '.join(endings)})"
    if not splats:
        got = _listed([member.filename for member in members]) or "an empty one"
        raise SplatFileError.of(
            path, expected, got, "pass the splat itself, or another download"
        )
    if len(splats) > 1:
        got = _listed([member.filename for member in splats])
        raise SplatFileError.of(path, expected, got, "unpack it, and pass one of these")
    return splats[0]


def _is_hidden(name: str) -> bool:
    """Whether a member is what macOS puts beside files."""
    return any(part.startswith((".", "__MACOSX")) for part in name.split("/"))


def _listed(names: Sequence[str]) -> str:
    rest = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(map(_plain, names[:_SHOWN])) + rest


def _plain(name: str) -> str:
    """A name from an archive, of which nothing is obeyed: it is shown only."""
    return "".join(letter if letter.isprintable() else "?" for letter in name)[:100]


def _check_size(member: zipfile.ZipInfo, where: str) -> None:
    if member.flag_bits & 1:
        raise SplatFileError.of(
            where,
            "a member without a password",
            "one with it",
            "unpack it, and pass the splat",
        )
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise SplatFileError.of(
            where,
            "a member that is stored or deflated",
            "another packing",
            "unpack it first",
        )
    most = min(MOST_BYTES, max(_FREE_BYTES, _MOST_RATIO * member.compress_size))
    if member.file_size > most:
        expected = f"at most {most:,} bytes out of {member.compress_size:,}"
        got = f"{member.file_size:,}: this may be a decompression bomb"
        raise SplatFileError.of(where, expected, got, "unpack it, where you trust it")


def _unpack(
    archive: zipfile.ZipFile, member: zipfile.ZipInfo, unpacked: io.FileIO
) -> None:
    left = member.file_size
    with archive.open(member) as packed:
        while part := packed.read(min(_PART, left + 1)):
            left -= len(part)
            if left < 0:
                raise ValueError("it is larger than the directory says")
            unpacked.write(part)
    if left:
        raise ValueError("it is smaller than the directory says")
    unpacked.seek(0)


@contextlib.contextmanager
def _anonymous_file() -> Iterator[io.FileIO]:
    """A file without a name: in memory where the system has such files, else one that
    is deleted already.
    """
    if hasattr(os, "memfd_create"):
        with io.FileIO(os.memfd_create("splat"), "r+") as file:
            yield file
    else:
        with tempfile.TemporaryFile(buffering=0) as file:
            yield file
