"""Picture files of unknown origin: how many pixels they have is known, and limited, before one is decoded.

A PNG of 500 kB may hold so many pixels of one colour that they take gigabytes in memory.
"""

import io
import re
import struct
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from PIL import ExifTags, Image, ImageOps, UnidentifiedImageError

from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.io.errors import LFS_ADVICE, LFS_POINTER

MOST_PIXELS = 50_000_000
"""Pixels that a picture may have unless more are allowed: cameras of 2026 take up to 50 million, as floats 600 MB."""

FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF")
"""Kinds of files that are read: those that the endings of the names promise, whatever else Pillow knows."""

BROKEN = (
    *(OSError, SyntaxError, ValueError, EOFError, LookupError, TypeError, struct.error, OverflowError, MemoryError),
    *(AttributeError, ImportError, Warning),
)
"""What Pillow raises for files that are broken in one way or another.

ImportError: ultralytics, once it is loaded, lets Pillow look for a plugin that is not installed. Warning: where the
caller has made errors of warnings.
"""

MOST_SCANS = 100
"""Scans that a JPEG may have; encoders write about ten, and each goes over all pixels again."""
_MARKER = re.compile(rb"\xff[^\x00\x01\xff\xd0-\xd7]", re.DOTALL)
"""A marker with a length after it, or the end: not a stuffed byte, a fill byte or a restart."""

_ANIMATED = ("PNG", "WEBP")
_lock = threading.RLock()
_most = MOST_PIXELS


class PictureFileError(MiSplatError):
    """A picture cannot be read; the message names the file and says what to do."""


@contextmanager
def pixel_limit(most: int) -> Iterator[None]:
    """Another number of pixels that a picture may have while the block runs, in all threads."""
    global _most
    if most < 1:
        raise InvalidValueError.of("max-pixels", "a number of pixels, 1 or more", most, "50000000 is usual")
    before, _most = _most, most
    try:
        yield
    finally:
        _most = before


@contextmanager
def pixels_bounded() -> Iterator[None]:
    """Let Pillow raise for every picture that is opened in this block and has more pixels than it may have.

    For libraries that open pictures themselves; what has to be decoded is decoded later.
    """
    with _pillow_limit(_most), warnings.catch_warnings():
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        yield


@contextmanager
def _pillow_limit(most: int | None) -> Iterator[None]:
    """Another limit of Pillow's own, of which it warns, and raises at twice as many; None is none."""
    with _lock:
        before, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, most
        try:
            yield
        finally:
            Image.MAX_IMAGE_PIXELS = before


def picture_header(path: Path, what: str = "", *, formats: Sequence[str] = FORMATS) -> tuple[tuple[int, int], str]:
    """Width and height of a picture and Pillow's name of its mode, from its header."""
    with _opened(path, what or str(path), formats) as picture:
        return picture.size, picture.mode


def lies_on_its_side(path: Path) -> bool:
    """Whether a picture's EXIF orientation swaps its width and height."""
    with _opened(path, str(path), FORMATS) as picture:
        return picture.getexif().get(ExifTags.Base.Orientation) in (5, 6, 7, 8)


def focal_length_35mm(picture: Image.Image) -> float | None:
    """The focal length that a camera has written into a picture, in millimetres for the diagonal of 35 mm film."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            written = picture.getexif().get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.FocalLengthIn35mmFilm)
        length = float(written or 0)
    except (*BROKEN, ArithmeticError):
        return None
    return length if 1 <= length <= 2000 else None


def check_picture(path: Path, what: str, *, formats: Sequence[str]) -> None:
    """Raise if another library must not decode a picture."""
    with _opened(path, what, formats) as picture:
        check_scans(picture, what)


def check_scans(picture: Image.Image, what: str) -> None:
    """Raise if a picture, opened and not yet decoded, is a JPEG of so many scans that decoding takes minutes."""
    if picture.format == "TIFF" and "jpeg" in str(picture.info.get("compression")):
        raise PictureFileError.of(what, "a TIFF without JPEG inside", "one with it", "save it as JPEG or PNG")
    file = getattr(picture, "fp", None)
    if picture.format not in ("JPEG", "MPO") or file is None:
        return
    offset = file.tell()
    file.seek(0)
    scans = _scans(file.read())
    file.seek(offset)
    if scans > MOST_SCANS:
        raise PictureFileError.of(what, f"a JPEG of at most {MOST_SCANS} scans", "more", "save it again")


def _scans(data: bytes) -> int:
    """How many scans a JPEG has; the count ends one above `MOST_SCANS`."""
    offset = scans = 0
    while scans <= MOST_SCANS and (marker := _MARKER.search(data, offset)) is not None:
        kind, offset = marker[0][1], marker.end()
        if kind == 0xD9:  # end of image; what follows is a video or another picture
            break
        if kind != 0xD8:
            offset += int.from_bytes(data[offset : offset + 2], "big")
        scans += kind == 0xDA
    return scans


def load_picture(
    source: Path | bytes, what: str = "", *, formats: Sequence[str] = FORMATS, upright: bool = False
) -> Image.Image:
    """A whole picture, decoded."""
    with _opened(source, what or str(source), formats) as picture:
        if picture.format in _ANIMATED and getattr(picture, "is_animated", False):
            raise PictureFileError.of(what or str(source), "one picture", "an animation", "save one picture of it")
        check_scans(picture, what or str(source))
        picture.load()
        return ImageOps.exif_transpose(picture) if upright else picture.copy()


@contextmanager
def _opened(source: Path | bytes, what: str, formats: Sequence[str]) -> Iterator[Image.Image]:
    """A picture whose header is right; what Pillow raises in the block is said in our words."""
    file = io.BytesIO(source) if isinstance(source, bytes) else source
    try:
        with _pillow_limit(None), Image.open(file, formats=tuple(formats)) as opened:
            check_pixels(what, *opened.size)
            yield opened
    except FileNotFoundError as error:
        do = "put the picture there or take it off the list"
        raise PictureFileError.of(what, "a picture", "no such file", do) from error
    except UnidentifiedImageError as error:
        if _beginning(source).startswith(LFS_POINTER):
            raise PictureFileError.of(what, "a picture", *LFS_ADVICE) from error
        if (kind := _of_phones(source)) is not None:
            do = "convert it, for instance with `magick mogrify -format jpg` (ImageMagick) or heif-convert (libheif)"
            raise PictureFileError.of(what, f"a picture as {', '.join(formats)}", kind, do) from error
        kinds = f"a picture that can be read ({', '.join(formats)})"
        raise PictureFileError.of(what, kinds, "something else", "save it as one of these") from error
    except BROKEN as error:
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        do = "write or download it again"
        raise PictureFileError.of(what, "a picture that can be read", reason, do) from error


def _of_phones(source: Path | bytes) -> str | None:
    """HEIC or AVIF, if the file is a picture of these; its first box names its brand (ISO/IEC 23008-12)."""
    head = _beginning(source)
    if head[4:8] != b"ftyp":
        return None
    return {b"avi": "AVIF", b"hei": "HEIC", b"hev": "HEIC", b"mif": "HEIC", b"msf": "HEIC"}.get(head[8:11])


def _beginning(source: Path | bytes) -> bytes:
    if isinstance(source, bytes):
        return source[:32]
    with source.open("rb") as file:
        return file.read(32)


def check_pixels(what: str, width: int, height: int) -> None:
    """Raise if a picture that another library decodes has too many pixels, or none."""
    if width < 1 or height < 1:
        raise PictureFileError.of(what, "a picture with pixels", f"{width} x {height}", "write it again")
    if width * height > _most:
        expected, got = f"at most {_most:,} pixels", f"{width * height:,}"
        error = PictureFileError.of(what, expected, got, "make it smaller, or allow more")
        raise error.hinted("--max-pixels")
