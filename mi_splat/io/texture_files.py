"""Pictures that Mitsuba decodes (OpenEXR, Radiance HDR, PFM and what Pillow knows): their size, from the header."""

import re
import struct
from pathlib import Path

from mi_splat.io.errors import from_os_error
from mi_splat.io.picture_files import FORMATS, PictureFileError, check_picture, check_pixels

_EXR = b"\x76\x2f\x31\x01"
_HEADER = 1 << 20
"""Bytes of a file in which its header has to end; that of an OpenEXR picture may hold a small preview."""
_USUAL_CHANNELS, _CHANNEL_BYTES = 4, 16
_RADIANCE = (b"#?RADIANCE", b"#?RGBE")
_RESOLUTION = re.compile(rb"^[-+][XY][ \t]+(\d{1,9})[ \t]+[-+][XY][ \t]+(\d{1,9})", re.MULTILINE)
"""The first such line is the one that counts, wherever the header ends."""
_PFM = re.compile(rb"P[Ff]\s+(\d{1,9})\s+(\d{1,9})\s")


_BEGINNINGS = (
    *(_EXR, *_RADIANCE, b"\x89PNG", b"\xff\xd8", b"BM", b"II*\0", b"MM\0*", b"RIFF"),
    *(b"PF", b"Pf", b"P1", b"P2", b"P3", b"P4", b"P5", b"P6"),
)
"""First bytes of pictures, by which Mitsuba knows them whatever the names of their files."""


def is_texture(path: Path) -> bool:
    """Whether a file begins as a picture does."""
    try:
        with path.open("rb") as file:
            return file.read(16).startswith(_BEGINNINGS)
    except OSError as error:
        raise from_os_error(str(path), "a file that can be read", error) from error


def check_texture(path: Path, what: str = "") -> None:
    """Raise if a picture has more pixels than it may have, or no header that says how many.

    Of an OpenEXR picture with more than four channels, each further four count as a picture.
    """
    what = what or str(path)
    try:
        with path.open("rb") as file:
            head = file.read(_HEADER)
    except OSError as error:
        raise from_os_error(what, "a picture", error) from error
    if head.startswith(_EXR):
        return _check_exr(head, what)
    radiance = head.startswith(_RADIANCE)
    match = _RESOLUTION.search(head) if radiance else _PFM.match(head)
    if match is not None:
        return check_pixels(what, int(match[1]), int(match[2]))
    if radiance:
        raise _broken(what, "Radiance HDR")
    check_picture(path, what, formats=(*FORMATS, "PPM", "TGA"))
    return None


def _check_exr(head: bytes, what: str) -> None:
    """Raise if a part of an OpenEXR picture has too many pixels; several parts are several headers."""
    several = bool(head[5:6] and head[5] & 0x10)
    offset, sizes = 8, list[tuple[int, int]]()
    try:
        while not sizes or (several and head[offset]):
            offset, size = _exr_part(head, offset)
            sizes.append(size)
    except (ValueError, IndexError, struct.error):
        raise _broken(what, "OpenEXR") from None
    check_pixels(what, sum(width for width, _ in sizes), max(height for _, height in sizes))


def _exr_part(head: bytes, offset: int) -> tuple[int, tuple[int, int]]:
    """Where a header that begins at a place ends, and the width and height of its picture."""
    window, channels = None, 0
    while head[offset]:
        name_end = head.index(b"\0", offset)
        start = head.index(b"\0", name_end + 1) + 5
        (length,) = struct.unpack_from("<I", head, start - 4)
        name, end = head[offset:name_end], start + length
        if name == b"dataWindow":
            x0, y0, x1, y1 = struct.unpack_from("<4i", head, start)
            window = (x1 - x0 + 1, y1 - y0 + 1)
        elif name == b"channels":
            while head[start]:
                start, channels = head.index(b"\0", start) + 1 + _CHANNEL_BYTES, channels + 1
        offset = end
    if window is None or channels < 1:
        raise ValueError("no window or no channels")
    return offset + 1, (window[0] * -(-channels // _USUAL_CHANNELS), window[1])


def _broken(what: str, kind: str) -> PictureFileError:
    """The error for a header that says no size."""
    return PictureFileError.of(what, f"a header of {kind} with a size", "none", "write or download it again")
