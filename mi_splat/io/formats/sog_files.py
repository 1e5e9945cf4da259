"""The files of a SOG: members of a zip archive or of a folder, and lossless WebP pictures that hold bytes.

Sizes are read from the archive's directory and from the pictures' headers, before anything is decompressed.
"""

import io
import os
import struct
import zipfile
import zlib
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mi_splat.io.errors import SplatFileError
from mi_splat.io.loaded import open_regular
from mi_splat.io.picture_files import PictureFileError, load_picture

Files = Callable[[str, int], bytes]
"""Bytes of the member `name`, which may have at most so many."""

_MOST_MEMBERS = 64
_END, _END64 = struct.Struct("<4s4H2LH"), b"PK\x06\x07"
_MOST_PIXELS = 1 << 26
_SPREAD = 1 << 16
_AGAIN = "write or download it again"


def archive_files(data: bytes, path: str) -> Files:
    """The members of a zip archive."""
    _check_directory(data, path)
    try:
        archive = zipfile.ZipFile(io.BytesIO(data))
    except _ZIP_ERRORS as error:
        raise SplatFileError.of(path, "a zip archive", str(error)[:100], _AGAIN) from None

    def read(name: str, most: int) -> bytes:
        try:
            member = archive.getinfo(name)
            if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise SplatFileError.of(f"{path}: {name}", "a stored or deflated member", "another", _AGAIN)
            if member.file_size > most:
                raise SplatFileError.of(f"{path}: {name}", f"at most {most} bytes", f"{member.file_size} bytes", _AGAIN)
            with archive.open(member) as file:
                plain = file.read(most + 1)
        except KeyError:
            got = ", ".join(archive.namelist())[:100] or "an empty archive"
            raise SplatFileError.of(path, f"a member {name}", got, _AGAIN) from None
        except _ZIP_ERRORS as error:
            raise SplatFileError.of(f"{path}: {name}", "an intact member", str(error)[:100], _AGAIN) from None
        if len(plain) > most:
            raise SplatFileError.of(f"{path}: {name}", f"at most {most} bytes", "more", _AGAIN)
        return plain

    return read


_ZIP_ERRORS = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError, struct.error,
               OverflowError, OSError)  # fmt: skip


def folder_files(folder: str) -> Files:
    """The files in a folder, by plain names only."""

    def read(name: str, most: int) -> bytes:
        path = os.path.join(folder, name)
        if os.path.basename(name) != name or name in ("", ".", ".."):
            raise SplatFileError.of(folder, "plain names of pictures", repr(name[:60]), _AGAIN)
        with open_regular(path) as file:
            plain = file.read(most + 1)
        if plain is None or len(plain) > most:
            raise SplatFileError.of(path, f"at most {most} bytes", "more", _AGAIN)
        return plain

    return read


def _check_directory(data: bytes, path: str) -> None:
    """Raise unless the end of the archive claims a small directory, which zipfile reads as a whole."""
    offset = data.rfind(b"PK\x05\x06", max(0, len(data) - _END.size - 0xFFFF))
    if offset < 0 or len(data) - offset < _END.size:
        raise SplatFileError.of(path, "a zip archive with its directory", "none: it is truncated", _AGAIN)
    fields = _END.unpack_from(data, offset)
    if fields[4] > _MOST_MEMBERS or fields[5] > _MOST_MEMBERS * 1024 or data[max(0, offset - 20) :][:4] == _END64:
        got = f"{fields[4]} in {fields[5]} bytes"
        raise SplatFileError.of(path, f"a zip archive of at most {_MOST_MEMBERS} members", got, _AGAIN)


def read_picture(data: bytes, where: str, *, least: int, width: int | None = None) -> NDArray[np.uint8]:
    """(H * W, 4) bytes of the pixels of a lossless WebP picture."""
    size = webp_size(data)
    if size is None:
        raise SplatFileError.of(where, "a lossless WebP picture (VP8L)", repr(data[:16]), "export the SOG again")
    pixels = size[0] * size[1]
    if pixels < least or pixels > min(4 * least + _SPREAD, _MOST_PIXELS) or width not in (None, size[0]):
        wanted = f"{least} to {min(4 * least + _SPREAD, _MOST_PIXELS)} pixels" + (f", {width} wide" if width else "")
        raise SplatFileError.of(where, wanted, f"{size[0]} x {size[1]}", "export the SOG again")
    try:
        picture = load_picture(data, where, formats=("WEBP",))
    except PictureFileError as error:
        raise SplatFileError(str(error)).hinted(error.hint) from None
    if picture.size != size:
        raise SplatFileError.of(where, "an intact WebP picture", f"another size, {picture.size}", _AGAIN)
    return np.asarray(picture.convert("RGBA")).reshape(-1, 4)


def webp_size(data: bytes) -> tuple[int, int] | None:
    """Width and height of a lossless WebP picture from its header (RFC 9649, section 3.4), None for other data."""
    if len(data) < 25 or data[:4] != b"RIFF" or data[8:16] != b"WEBPVP8L" or data[20] != 0x2F:
        return None
    bits = int.from_bytes(data[21:25], "little")
    return (bits & 0x3FFF) + 1, ((bits >> 14) & 0x3FFF) + 1


def picture_bytes(values: NDArray[np.uint8]) -> bytes:
    """A lossless WebP of (H, W, 4) bytes; colours under an alpha of zero are kept."""
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(values)).save(buffer, "WEBP", lossless=True, exact=True, quality=60, method=3)
    return buffer.getvalue()


def archive_bytes(members: dict[str, bytes]) -> bytes:
    """A zip archive of members that are compressed already, the same bytes each time."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, data in members.items():
            archive.writestr(zipfile.ZipInfo(name), data)
    return buffer.getvalue()
