"""Image files of unknown origin: how many pixels they have is known, and limited,
before one is decoded.

A PNG of 500 kB may hold so many pixels of one colour that they take gigabytes in
memory.
"""

import io
import re
import struct
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from PIL import ExifTags, Image, UnidentifiedImageError

from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.io.errors import LFS_ADVICE, LFS_POINTER, from_os_error

MOST_PIXELS = 50_000_000
"""Pixels that an image may have unless more are allowed: cameras of 2026 take up to 50
million, as floats 600 MB.
"""

FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF")
"""Kinds of files that are read: those that the endings of the names promise, whatever
else Pillow knows.
"""

BROKEN = (
    *(
        OSError,
        SyntaxError,
        ValueError,
        EOFError,
        LookupError,
        TypeError,
        struct.error,
        OverflowError,
        MemoryError,
    ),
    *(AttributeError, ImportError, Warning),
)
"""What Pillow raises for files that are broken in one way or another.

ImportError: ultralytics, once it is loaded, lets Pillow look for a plugin that is not
installed. Warning: where the caller has made errors of warnings.
"""

MOST_SCANS = 100
MOST_JPEG = 1 << 28
"""Scans that a JPEG may have (encoders write about ten, and each goes over all pixels
again), and its bytes.
"""
_MARKER = re.compile(rb"\xff[^\x00\x01\xff\xd0-\xd7]", re.DOTALL)
"""A marker with a length after it, or the end: not a stuffed byte, a fill byte or a
restart.
"""

_ANIMATED = ("PNG", "WEBP")
_UPRIGHT = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
"""What makes an image upright, by its EXIF orientation."""
_lock = threading.RLock()
_most = MOST_PIXELS


class PictureFileError(MiSplatError):
    """An image cannot be read; the message names the file and says what to do."""


@contextmanager
def pixel_limit(most: int) -> Iterator[None]:
    """Another number of pixels that an image may have while the block runs, in all
    threads.
    """
    global _most
    if most < 1:
        raise InvalidValueError.of(
            "max-pixels", "a number of pixels, 1 or more", most, "50000000 is usual"
        )
    before = _most
    _most = most
    try:
        yield
    finally:
        _most = before


@contextmanager
def pixels_bounded() -> Iterator[None]:
    """Let Pillow raise for every image that is opened in this block and has more
    pixels than it may have.

    For libraries that open images themselves; what has to be decoded is decoded
    later.
    """
    with _pillow_limit(_most), warnings.catch_warnings():
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        yield


@contextmanager
def _pillow_limit(most: int | None) -> Iterator[None]:
    """Another limit of Pillow's own, of which it warns, and raises at twice as many;
    None is none.
    """
    with _lock:
        before = Image.MAX_IMAGE_PIXELS
        Image.MAX_IMAGE_PIXELS = most
        try:
            yield
        finally:
            Image.MAX_IMAGE_PIXELS = before


def picture_header(
    source: Path | bytes, what: str = "", *, formats: Sequence[str] = FORMATS
) -> tuple[tuple[int, int], str]:
    """Width and height of an image and Pillow's name of its mode, from its header."""
    with _opened(source, what or str(source), formats) as picture:
        return picture.size, picture.mode


def picture_orientation(source: Path | bytes, what: str = "") -> int:
    """The EXIF orientation of an image, 1 to 8; 1, as it is stored, if it has none."""
    with _opened(source, what or str(source), FORMATS) as picture:
        return _orientation(picture)


def _orientation(picture: Image.Image) -> int:
    """1 also where EXIF is broken, which programs that show images ignore, too."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            value = picture.getexif().get(ExifTags.Base.Orientation)
    except (*BROKEN, ArithmeticError):
        return 1
    if isinstance(value, int) and 1 <= value <= 8:
        return value
    return 1


def made_upright(picture: Image.Image, orientation: int) -> Image.Image:
    """A decoded image, turned or mirrored as an EXIF orientation says."""
    turn = _UPRIGHT.get(orientation)
    if turn is None:
        return picture
    return picture.transpose(turn)


def focal_length_35mm(picture: Image.Image) -> float | None:
    """The focal length that a camera has written into an image, in millimetres for the
    diagonal of 35 mm film.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            written = (
                picture.getexif()
                .get_ifd(ExifTags.IFD.Exif)
                .get(ExifTags.Base.FocalLengthIn35mmFilm)
            )
        length = float(written or 0)
    except (*BROKEN, ArithmeticError):
        return None
    if 1 <= length <= 2000:
        return length
    return None


def check_scans(picture: Image.Image, what: str) -> None:
    """Raise if an image, opened and not yet decoded, is a JPEG of so many scans that
    decoding takes minutes.
    """
    if picture.format == "TIFF" and "jpeg" in str(picture.info.get("compression")):
        raise PictureFileError.of(
            what, "a TIFF without JPEG inside", "one with it", "save it as JPEG or PNG"
        )
    file = getattr(picture, "fp", None)
    if picture.format not in ("JPEG", "MPO") or file is None:
        return
    offset = file.tell()
    file.seek(0)
    data = file.read(MOST_JPEG + 1)
    file.seek(offset)
    if len(data) > MOST_JPEG:
        raise PictureFileError.of(
            what, f"a JPEG of at most {MOST_JPEG:,} bytes", "more", "save it again"
        )
    scans = _scans(data)
    if scans > MOST_SCANS:
        raise PictureFileError.of(
            what, f"a JPEG of at most {MOST_SCANS} scans", "more", "save it again"
        )


def _scans(data: bytes) -> int:
    """How many scans a JPEG has; the count ends one above `MOST_SCANS`."""
    offset = scans = 0
    while scans <= MOST_SCANS and (marker := _MARKER.search(data, offset)) is not None:
        kind = marker[0][1]
        offset = marker.end()
        if kind == 0xD9:  # end of image; what follows is a video or another image
            break
        if kind != 0xD8:
            offset += int.from_bytes(data[offset : offset + 2], "big")
        scans += kind == 0xDA
    return scans


def load_picture(
    source: Path | bytes,
    what: str = "",
    *,
    formats: Sequence[str] = FORMATS,
    upright: bool = False,
) -> Image.Image:
    """A whole image, decoded; turned as its EXIF orientation says if it is to be
    upright.
    """
    with _opened(source, what or str(source), formats) as picture:
        if picture.format in _ANIMATED and getattr(picture, "is_animated", False):
            raise PictureFileError.of(
                what or str(source),
                "one image",
                "an animation",
                "save one image of it",
            )
        check_scans(picture, what or str(source))
        picture.load()
        return made_upright(picture, _orientation(picture) if upright else 1).copy()


@contextmanager
def _opened(
    source: Path | bytes, what: str, formats: Sequence[str]
) -> Iterator[Image.Image]:
    """An image whose header is right; what Pillow raises in the block is said in our
    words.
    """
    file = io.BytesIO(source) if isinstance(source, bytes) else source
    try:
        with _pillow_limit(None), Image.open(file, formats=tuple(formats)) as opened:
            check_pixels(
                what, *opened.size, most=_most // _COPIES.get(opened.format or "", 1)
            )
            yield opened
    except FileNotFoundError as error:
        do = "put the image there or take it off the list"
        raise PictureFileError.of(what, "an image", "no such file", do) from error
    except UnidentifiedImageError as error:
        if _beginning(source).startswith(LFS_POINTER):
            raise PictureFileError.of(what, "an image", *LFS_ADVICE) from error
        kind = _phone_format(source)
        if kind is not None:
            do = (
                "convert it, for instance with `magick mogrify -format jpg`"
                " (ImageMagick) or heif-convert (libheif)"
            )
            raise PictureFileError.of(
                what, f"an image as {', '.join(formats)}", kind, do
            ) from error
        kinds = f"an image that can be read ({', '.join(formats)})"
        raise PictureFileError.of(
            what, kinds, "something else", "save it as one of these"
        ) from error
    except BROKEN as error:
        # of the system, and not of Pillow
        if isinstance(error, OSError) and error.errno is not None:
            raise PictureFileError(
                str(from_os_error(what, "an image", error))
            ) from error
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        do = "write or download it again"
        raise PictureFileError.of(
            what, "an image that can be read", reason, do
        ) from error


def _phone_format(source: Path | bytes) -> str | None:
    """HEIC or AVIF, if the file is an image of these; its first box names its brand
    (ISO/IEC 23008-12).
    """
    head = _beginning(source)
    if head[4:8] != b"ftyp":
        return None
    return {
        b"avi": "AVIF",
        b"hei": "HEIC",
        b"hev": "HEIC",
        b"mif": "HEIC",
        b"msf": "HEIC",
    }.get(head[8:11])


def _beginning(source: Path | bytes) -> bytes:
    if isinstance(source, bytes):
        return source[:32]
    with source.open("rb") as file:
        return file.read(32)


_COPIES = {"WEBP": 2}
"""How many times as much memory as for others Pillow takes for images of a kind: it
decodes WebP as animations.
"""


def check_pixels(
    what: str, width: int, height: int, *, most: int | None = None
) -> None:
    """Raise if an image that another library decodes has too many pixels, or none."""
    most = _most if most is None else most
    if width < 1 or height < 1:
        raise PictureFileError.of(
            what, "an image with pixels", f"{width} x {height}", "write it again"
        )
    if width * height > most:
        expected = f"at most {most:,} pixels"
        got = f"{width * height:,}"
        error = PictureFileError.of(
            what, expected, got, "make it smaller, or allow more"
        )
        raise error.hinted("--max-pixels")


# Images that Mitsuba decodes: OpenEXR, Radiance HDR, PFM and what Pillow knows.

_EXR = b"\x76\x2f\x31\x01"
_HEADER = 1 << 20
"""Bytes of a file in which its header has to end; that of an OpenEXR image may hold a
small preview.
"""
_USUAL_CHANNELS = 4
_CHANNEL_BYTES = 16
_RADIANCE = (b"#?RADIANCE", b"#?RGBE")
_RESOLUTION = re.compile(
    rb"^[-+][XY][ \t]+(\d{1,9})[ \t]+[-+][XY][ \t]+(\d{1,9})", re.MULTILINE
)
"""The first such line is the one that counts, wherever the header ends."""
_PFM = re.compile(rb"P[Ff]\s+(\d{1,9})\s+(\d{1,9})\s")


_BEGINNINGS = (
    *(_EXR, *_RADIANCE, b"\x89PNG", b"\xff\xd8", b"BM", b"II*\0", b"MM\0*", b"RIFF"),
    *(b"PF", b"Pf", b"P1", b"P2", b"P3", b"P4", b"P5", b"P6"),
)
"""First bytes of images, by which Mitsuba knows them whatever the names of their
files.
"""


def is_texture(path: Path) -> bool:
    """Whether a file begins as an image does."""
    try:
        with path.open("rb") as file:
            return file.read(16).startswith(_BEGINNINGS)
    except OSError as error:
        raise from_os_error(str(path), "a file that can be read", error) from error


def check_texture(path: Path, what: str = "") -> None:
    """Raise if an image has more pixels than it may have, or no header that says how
    many.

    Of an OpenEXR image with more than four channels, each further four count as an
    image.
    """
    what = what or str(path)
    try:
        with path.open("rb") as file:
            head = file.read(_HEADER)
    except OSError as error:
        raise from_os_error(what, "an image", error) from error
    if head.startswith(_EXR):
        return _check_exr(head, what)
    radiance = head.startswith(_RADIANCE)
    match = _RESOLUTION.search(head) if radiance else _PFM.match(head)
    if match is not None:
        return check_pixels(what, int(match[1]), int(match[2]))
    if radiance:
        raise _broken(what, "Radiance HDR")
    with _opened(path, what, (*FORMATS, "PPM", "TGA")) as picture:
        check_scans(picture, what)
    return None


def _check_exr(head: bytes, what: str) -> None:
    """Raise if a part of an OpenEXR image has too many pixels; several parts are
    several headers.
    """
    several = bool(head[5:6] and head[5] & 0x10)
    offset = 8
    sizes = list[tuple[int, int]]()
    try:
        while not sizes or (several and head[offset]):
            offset, size = _exr_part(head, offset)
            sizes.append(size)
    except (ValueError, IndexError, struct.error):
        raise _broken(what, "OpenEXR") from None
    check_pixels(
        what, sum(width for width, _ in sizes), max(height for _, height in sizes)
    )


def _exr_part(head: bytes, offset: int) -> tuple[int, tuple[int, int]]:
    """Where a header that begins at a place ends, and the width and height of its
    image.
    """
    window = None
    channels = 0
    while head[offset]:
        name_end = head.index(b"\0", offset)
        start = head.index(b"\0", name_end + 1) + 5
        (length,) = struct.unpack_from("<I", head, start - 4)
        name = head[offset:name_end]
        end = start + length
        if name == b"dataWindow":
            x0, y0, x1, y1 = struct.unpack_from("<4i", head, start)
            window = (x1 - x0 + 1, y1 - y0 + 1)
        elif name == b"channels":
            while head[start]:
                start = head.index(b"\0", start) + 1 + _CHANNEL_BYTES
                channels = channels + 1
        offset = end
    if window is None or channels < 1:
        raise ValueError("no window or no channels")
    return offset + 1, (window[0] * -(-channels // _USUAL_CHANNELS), window[1])


def _broken(what: str, kind: str) -> PictureFileError:
    return PictureFileError.of(
        what, f"a header of {kind} with a size", "none", "write or download it again"
    )
