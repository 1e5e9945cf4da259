"""How large meshes and volumes are that Mitsuba reads, from their headers: it takes
memory for what these state.

A `serialized` mesh is compressed, so that a file of 2 MB may hold 150 million vertices.
What the header of a PLY or a volume states has to be in the file, byte for byte.
"""

import io
import os
import re
import struct
import zlib
from pathlib import Path

from mi_splat.errors import InvalidValueError
from mi_splat.io.errors import from_os_error

_SERIALIZED = b"\x1c\x04"  # 0x041C, little-endian, as Mitsuba's loader checks it
_VERTEX_BYTES = 40
_FACE_BYTES = 12
"""Of a position, a normal, texture coordinates and a colour; and of three numbers of
vertices.
"""
_MOST_MESHES = 10_000  # in one serialized file
_LONGEST_NAME = 1 << 12
_HEADER = 1 << 16
_COUNT = re.compile(rb"^element[ \t]+\S+[ \t]+(\d+)", re.MULTILINE)
_VOLUME_HEADER = 48
_BROKEN = (ValueError, struct.error, zlib.error, OverflowError)


def stated_bytes(path: Path) -> int:
    """The memory that Mitsuba would take for a file that a scene names, about.

    Args:
        path: The file; of what is no mesh and no volume, its length counts.

    Returns:
        Bytes.

    Raises:
        InvalidValueError: It states more than it holds, or is damaged.
        SplatFileError: It cannot be read.
    """
    try:
        with path.open("rb") as file:
            length = os.fstat(file.fileno()).st_size
            head = file.read(_HEADER)
            if head.startswith(_SERIALIZED):
                return max(length, _of_serialized(file, length))
    except OSError as error:
        raise from_os_error(str(path), "a file that can be read", error) from error
    except _BROKEN as error:
        got = " ".join(str(error).split()) or type(error).__name__
        raise InvalidValueError.of(
            str(path), "a serialized mesh", got, "export it again"
        ) from error
    if head.startswith(b"ply"):
        _check_ply(path, head, length)
    if head.startswith(b"VOL"):
        _check_volume(path, head, length)
    return length


def _check_ply(path: Path, head: bytes, length: int) -> None:
    """Raise if a PLY states more vertices or faces than it has bytes."""
    counts = [
        int(digits[:20]) for digits in _COUNT.findall(head.partition(b"end_header")[0])
    ]
    if sum(counts) > length:
        raise _lies(path, f"{sum(counts):,} elements", length)


def _check_volume(path: Path, head: bytes, length: int) -> None:
    """Raise if a volume (VOL, version 3) states more values than it has."""
    if len(head) < _VOLUME_HEADER:
        raise InvalidValueError.of(
            str(path), "a volume", "a shorter file", "export it again"
        )
    sizes = struct.unpack_from("<4i", head, 8)
    values = 1
    for size in sizes:
        values *= max(size, 0)
    if values > length:  # a byte each, at least
        raise _lies(path, f"{values:,} values", length)


def _lies(path: Path, got: str, length: int) -> InvalidValueError:
    return InvalidValueError.of(
        str(path), f"no more than its {length:,} bytes hold", got, "export it again"
    )


def _of_serialized(file: io.BufferedReader, length: int) -> int:
    """Memory for all meshes of a serialized file: a dictionary at its end says where
    each begins.
    """
    _, version = struct.unpack("<HH", _at(file, 0, 4))
    (count,) = struct.unpack("<I", _at(file, length - 4, 4))
    if not 0 < count <= _MOST_MESHES:
        raise ValueError(f"{count:,} meshes")
    # Offsets have 64 bits since version 4.
    letter, width = ("Q", 8) if version >= 4 else ("I", 4)
    table = _at(file, length - 4 - width * count, width * count)
    return sum(
        _of_mesh(file, offset, version)
        for offset in struct.unpack(f"<{count}{letter}", table)
    )


def _of_mesh(file: io.BufferedReader, offset: int, version: int) -> int:
    """Memory for one mesh, which begins with a header of its own, flags, a name and the
    two counts.
    """
    data = _at(file, offset + 4, _HEADER, exactly=False)
    plain = zlib.decompressobj().decompress(data, 4 + _LONGEST_NAME + 16)
    start = plain.index(b"\0", 4) + 1 if version >= 4 else 4
    vertices, faces = struct.unpack_from("<QQ", plain, start)
    return int(_VERTEX_BYTES * vertices + _FACE_BYTES * faces)


def _at(
    file: io.BufferedReader, offset: int, size: int, *, exactly: bool = True
) -> bytes:
    if offset < 0:
        raise ValueError("a file that is cut off")
    file.seek(offset)
    data = file.read(size)
    if exactly and len(data) != size:
        raise ValueError("a file that is cut off")
    return data
